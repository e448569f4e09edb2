"""Sensor messages as standard ROS 2 types, and back from any driver that publishes those."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from companion.core.messages import BaroReading, Bytes2D, CameraImage, ImuSample, RangeReading, freeze
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.parts import header_of, stamp_of

_ZERO_COVARIANCE = np.zeros(9)  # ROS: unknown
_NO_ORIENTATION = np.array([-1.0, *[0.0] * 8])  # ROS: the message says nothing of it
_UPRIGHT = {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}
_CHANNELS = {  # encoding to bytes per pixel and the channels of red, green, blue
    **dict.fromkeys(("mono8", "8UC1"), (1, (0, 0, 0))),
    **dict.fromkeys(("rgb8", "8UC3"), (3, (0, 1, 2))),
    "bgr8": (3, (2, 1, 0)),
    "rgba8": (4, (0, 1, 2)),
    "bgra8": (4, (2, 1, 0)),
}
# International Standard Atmosphere, troposphere (ISO 2533): p = p0 (1 - L h / T0)^(g M / (R L))
_P0_PA = 101_325.0
_T0_K = 288.15
_LAPSE_K_PER_M = 0.0065
_EXPONENT = 9.80665 * 0.0289644 / (8.31432 * _LAPSE_K_PER_M)


def imu_value(sample: ImuSample) -> dict[str, Any]:
    """sensor_msgs/Imu in base_link; linear_acceleration is the specific force, as ROS has it."""
    rate_x, rate_y, rate_z = sample.angular_velocity_body.tolist()
    force_x, force_y, force_z = sample.specific_force_body.tolist()
    return {
        "header": header_of(sample.stamp_ns, "base_link"),
        "orientation": _UPRIGHT,
        "orientation_covariance": _NO_ORIENTATION,
        "angular_velocity": {"x": rate_x, "y": rate_y, "z": rate_z},
        "angular_velocity_covariance": _ZERO_COVARIANCE,
        "linear_acceleration": {"x": force_x, "y": force_y, "z": force_z},
        "linear_acceleration_covariance": _ZERO_COVARIANCE,
    }


def imu_sample(value: dict[str, Any]) -> ImuSample:
    """Inverse of `imu_value`; an orientation is not looked at."""
    rate, force = value["angular_velocity"], value["linear_acceleration"]
    sample = ImuSample(
        stamp_ns=stamp_of(value["header"]),
        angular_velocity_body=np.array((rate["x"], rate["y"], rate["z"])),
        specific_force_body=np.array((force["x"], force["y"], force["z"])),
    )
    freeze(sample)
    return sample


def image_value(image: CameraImage) -> dict[str, Any]:
    """sensor_msgs/Image, mono8, in frame `camera`."""
    height, width = image.pixels.shape
    return {
        "header": header_of(image.stamp_ns, "camera"),
        "height": height,
        "width": width,
        "encoding": "mono8",
        "is_bigendian": 0,
        "step": width,
        "data": image.pixels,
    }


def camera_image(value: dict[str, Any]) -> CameraImage:
    """Grey image of a mono8 one, or of a colour one by the luma weights of ITU-R BT.601."""
    encoding = value["encoding"]
    if encoding not in _CHANNELS:
        raise WireError(f"an image with encoding {encoding[:40]!r} (valid: {', '.join(_CHANNELS)})")
    depth, colours = _CHANNELS[encoding]
    rows = _rows(value, depth)
    pixels = rows if depth == 1 else _grey(rows.reshape(len(rows), -1, depth), *colours)
    image = CameraImage(stamp_ns=stamp_of(value["header"]), pixels=pixels)
    freeze(image)
    return image


def range_value(reading: RangeReading) -> dict[str, Any]:
    """sensor_msgs/Range; no return is +Inf (ROS REP-117)."""
    return {
        "header": header_of(reading.stamp_ns, "range_finder"),
        "radiation_type": 1,  # infrared
        "field_of_view": 0.05,
        "min_range": 0.0,
        "max_range": math.inf,
        "range": math.inf if math.isnan(reading.range_m) else float(reading.range_m),
        "variance": 0.0,
    }


def range_reading(value: dict[str, Any]) -> RangeReading:
    """NaN for what is not within the sensor's own limits (+Inf too far, -Inf too near)."""
    range_m, low, high = value["range"], value["min_range"], value["max_range"]
    valid = math.isfinite(range_m) and (low <= range_m <= high or not low < high)
    return RangeReading(stamp_ns=stamp_of(value["header"]), range_m=range_m if valid else math.nan)


def pressure_value(reading: BaroReading) -> dict[str, Any]:
    """sensor_msgs/FluidPressure: the pressure that the standard atmosphere has at the altitude."""
    ratio = max(1.0 - _LAPSE_K_PER_M / _T0_K * reading.altitude_m, 0.0)
    return {
        "header": header_of(reading.stamp_ns, "base_link"),
        "fluid_pressure": _P0_PA * ratio**_EXPONENT if reading.altitude_m == reading.altitude_m else math.nan,
        "variance": 0.0,
    }


def baro_reading(value: dict[str, Any]) -> BaroReading:
    """Altitude of the pressure in the standard atmosphere; NaN for what is no pressure."""
    pressure = value["fluid_pressure"]
    altitude_m = math.nan
    if pressure >= 0 and math.isfinite(pressure):
        altitude_m = _T0_K / _LAPSE_K_PER_M * (1.0 - (pressure / _P0_PA) ** (1.0 / _EXPONENT))
    return BaroReading(stamp_ns=stamp_of(value["header"]), altitude_m=altitude_m)


def _rows(value: dict[str, Any], depth: int) -> Bytes2D:
    """The image's bytes, (H, W * depth), without the padding of its rows."""
    height, width, step, data = value["height"], value["width"] * depth, value["step"], value["data"]
    if step < width or height * step > data.size:
        raise WireError(f"{data.size} bytes are no image of {height} rows of {step} bytes, {width} used")
    rows = data[: height * step].reshape(height, step)[:, :width]
    return np.ascontiguousarray(rows)


def _grey(pixels: np.ndarray[Any, Any], red: int, green: int, blue: int) -> Bytes2D:
    wide = pixels.astype(np.uint16)  # 77 + 150 + 29 = 256
    grey = (77 * wide[..., red] + 150 * wide[..., green] + 29 * wide[..., blue]) >> 8
    return grey.astype(np.uint8)
