"""Our message definitions as a ROS 2 package, so that a ROS machine can build and understand them."""

from __future__ import annotations

import shutil
from pathlib import Path

import companion
from companion.core.errors import InputError
from companion.runtime.wire.library import INTERFACES, Library

PACKAGE = "understory_msgs"


def write_package(folder: Path) -> list[str]:
    """Write `folder` / understory_msgs: package.xml, CMakeLists.txt and the .msg texts; returns their names.

    `colcon build` makes of it what `ros2 topic echo` needs. InputError if the package is there already.
    """
    root = folder / PACKAGE
    if root.exists():
        raise InputError(f"{root} is there already", field="DIR", valid="a folder without it")
    names = [name.rsplit("/", 1)[1] for name in Library().bundled if name.startswith(f"{PACKAGE}/msg/")]
    needed = _packages_of(names)
    (root / "msg").mkdir(parents=True)
    for name in names:
        shutil.copyfile(INTERFACES / PACKAGE / "msg" / f"{name}.msg", root / "msg" / f"{name}.msg")
    (root / "package.xml").write_text(_manifest(needed), encoding="utf-8")
    (root / "CMakeLists.txt").write_text(_cmake(names, needed), encoding="utf-8")
    return names


def _packages_of(names: list[str]) -> list[str]:
    """The other packages whose types the messages name, sorted."""
    library = Library()
    fields = [field for name in names for field in library.struct(f"{PACKAGE}/msg/{name}").fields]
    named = {field.type.base.split("/")[0] for field in fields if field.type.nested}
    return sorted(named - {PACKAGE})


def _manifest(needed: list[str]) -> str:
    depends = "".join(f"  <depend>{package}</depend>\n" for package in needed)
    return (
        '<?xml version="1.0"?>\n<package format="3">\n'
        f"  <name>{PACKAGE}</name>\n  <version>{companion.__version__}</version>\n"
        "  <description>Messages of the Understory companion stack</description>\n"
        '  <maintainer email="understory@example.org">Understory</maintainer>\n'
        "  <license>Apache-2.0</license>\n"
        "  <buildtool_depend>ament_cmake</buildtool_depend>\n"
        "  <buildtool_depend>rosidl_default_generators</buildtool_depend>\n"
        f"{depends}"
        "  <exec_depend>rosidl_default_runtime</exec_depend>\n"
        "  <member_of_group>rosidl_interface_packages</member_of_group>\n"
        "  <export><build_type>ament_cmake</build_type></export>\n</package>\n"
    )


def _cmake(names: list[str], needed: list[str]) -> str:
    finds = "".join(f"find_package({package} REQUIRED)\n" for package in needed)
    files = "\n".join(f'  "msg/{name}.msg"' for name in names)
    return (
        f"cmake_minimum_required(VERSION 3.14)\nproject({PACKAGE})\n"
        f"find_package(ament_cmake REQUIRED)\nfind_package(rosidl_default_generators REQUIRED)\n{finds}"
        f"rosidl_generate_interfaces(${{PROJECT_NAME}}\n{files}\n  DEPENDENCIES {' '.join(needed)}\n)\n"
        "ament_export_dependencies(rosidl_default_runtime)\nament_package()\n"
    )
