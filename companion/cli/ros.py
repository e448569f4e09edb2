"""`companion topic package`: our messages as a ROS 2 package."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from companion.runtime.tools.ros_package import PACKAGE, write_package


def package(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where to put it, say the src of a colcon workspace.")],
) -> None:
    """Write understory_msgs, a ROS 2 package with our messages, into DIR. Example: companion topic package ~/ws/src

    A ROS machine that has built it shows our own messages in `ros2 topic echo` and rosbag2; standard
    types (clouds, odom, path, /tf) need nothing.
    """
    names = write_package(folder)
    console = Console(highlight=False, soft_wrap=True)
    console.print(f"{folder / PACKAGE}: {len(names)} messages; build it with: colcon build --packages-select {PACKAGE}")
