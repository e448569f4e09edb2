"""What can be done to a recorded flight: shorter sight, lost sensors, spoilt images, IMU faults.

spoil = fault("range_12,no_camera")
spoil = fault("lidar_gap_3@40")        # seconds, from the 40th on
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter

from companion.core import topics
from companion.core.errors import InputError
from companion.core.messages import CameraImage, ImuSample, LidarScan
from companion.core.node import Topic
from companion.runtime.bench.estimation_replay import Spoil

_BLUR_PX, _DARK = 25, 0.02
FAULTS = (
    "range_METRES", "no_camera", "lidar_gap_S@AT", "dark_S@AT", "blurred_S@AT", "frozen_S@AT",
    "imu_gap_S@AT", "imu_step_MS2@AT", "imu_saturated_S@AT", "clock_jump_S@AT",
)  # fmt: skip


def fault(text: str) -> Spoil:
    """Faults joined by commas; "none" leaves everything as it was. Raises InputError."""
    spoils = [_one(part) for part in text.split(",") if part != "none"]

    def spoil(topic: Topic[Any], message: Any) -> Any:
        for each in spoils:
            message = each(topic, message) if message is not None else None
        return message

    return spoil


def _one(text: str) -> Spoil:
    what, _, at = text.partition("@")
    name, _, size = what.rpartition("_")
    if what == "no_camera":
        return lambda topic, message: None if topic is topics.CAMERA else message
    try:
        value, begin_ns = float(size), round(float(at) * 1e9) if at else 0
    except ValueError:
        raise InputError(f"{text!r}", field="--fault", valid=", ".join(FAULTS)) from None
    makers: dict[str, Callable[[float, int], Spoil]] = {
        "range": lambda v, _: _shorter(v),
        "lidar_gap": lambda v, b: _while(b, v, topics.LIDAR, lambda m: None),
        "dark": lambda v, b: _while(b, v, topics.CAMERA, _darker),
        "blurred": lambda v, b: _while(b, v, topics.CAMERA, _blurred),
        "frozen": _frozen,
        "imu_gap": lambda v, b: _while(b, v, topics.IMU, lambda m: None),
        "imu_step": lambda v, b: _while(b, np.inf, topics.IMU, lambda m: _pushed(m, v)),
        "imu_saturated": lambda v, b: _while(b, v, topics.IMU, lambda m: _pushed(m, 200.0)),
        "clock_jump": lambda v, b: _while(b, np.inf, None, lambda m: _later(m, round(v * 1e9))),
    }
    if name not in makers:
        raise InputError(f"{text!r}", field="--fault", valid=", ".join(FAULTS))
    return makers[name](value, begin_ns)


def _while(begin_ns: int, duration_s: float, topic: Topic[Any] | None, change: Callable[[Any], Any]) -> Spoil:
    def spoil(of: Topic[Any], message: Any) -> Any:
        inside = begin_ns <= message.stamp_ns < begin_ns + duration_s * 1e9
        return change(message) if inside and (topic is None or of is topic) else message

    return spoil


def _shorter(range_m: float) -> Spoil:
    def spoil(topic: Topic[Any], message: Any) -> Any:
        if topic is not topics.LIDAR:
            return message
        near = (message.points_sensor**2).sum(axis=1) < range_m**2
        return dataclasses.replace(
            message, points_sensor=message.points_sensor[near], point_age_s=message.point_age_s[near]
        )

    return spoil


def _frozen(duration_s: float, begin_ns: int) -> Spoil:
    """The driver sends the last image again and again, with new stamps."""
    last: list[CameraImage] = []

    def spoil(topic: Topic[Any], message: Any) -> Any:
        if topic is not topics.CAMERA:
            return message
        if last and begin_ns <= message.stamp_ns < begin_ns + duration_s * 1e9:
            return dataclasses.replace(message, pixels=last[0].pixels)
        last[:] = [message]
        return message

    return spoil


def _darker(image: CameraImage) -> CameraImage:
    return dataclasses.replace(image, pixels=(image.pixels * _DARK).astype(np.uint8))


def _blurred(image: CameraImage) -> CameraImage:
    """A long exposure in motion along x."""
    return dataclasses.replace(image, pixels=uniform_filter(image.pixels, (1, _BLUR_PX)))


def _pushed(sample: ImuSample, by_m_s2: float) -> ImuSample:
    return dataclasses.replace(sample, specific_force_body=sample.specific_force_body + np.array([by_m_s2, 0.0, 0.0]))


def _later(message: ImuSample | LidarScan | CameraImage, by_ns: int) -> Any:
    return dataclasses.replace(message, stamp_ns=message.stamp_ns + by_ns)
