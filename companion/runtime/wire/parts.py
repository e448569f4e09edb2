"""Small ROS structs that many messages hold, from our numbers and back."""

from __future__ import annotations

from typing import Any

from companion.core.messages import Array


def time_of(stamp_ns: int) -> dict[str, int]:
    """builtin_interfaces/Time."""
    seconds, rest = divmod(stamp_ns, 1_000_000_000)
    return {"sec": seconds, "nanosec": rest}


def ns_of(time: dict[str, Any]) -> int:
    """Inverse of `time_of`."""
    return int(time["sec"]) * 1_000_000_000 + int(time["nanosec"])


def header_of(stamp_ns: int, frame: str) -> dict[str, Any]:
    """std_msgs/Header."""
    return {"stamp": time_of(stamp_ns), "frame_id": frame}


def stamp_of(header: dict[str, Any]) -> int:
    """Stamp of a std_msgs/Header, ns."""
    return ns_of(header["stamp"])


def quaternion_of(q: Array) -> dict[str, float]:
    """geometry_msgs/Quaternion of ours, wxyz."""
    w, x, y, z = q.tolist()
    return {"x": x, "y": y, "z": z, "w": w}
