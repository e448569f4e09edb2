"""What sensors say."""

from __future__ import annotations

from companion.core.messages.kind import Array, Array32, Bytes2D, message


@message
class ImuSample:
    """Mean over the sample interval that ends at the stamp."""

    stamp_ns: int
    angular_velocity_body: Array  # rad/s, (3,)
    specific_force_body: Array  # m/s2, (3,); +9.81 on z at rest and level


@message
class LidarScan:
    """One sweep, not deskewed. The stamp is the end of the sweep."""

    stamp_ns: int
    points_sensor: Array32  # returns, m, (N, 3), each in the sensor frame of its own time
    point_age_s: Array32  # (N,), >= 0: stamp minus the time of the point
    miss_dirs_sensor: Array32  # unit directions of beams without return, (M, 3)
    miss_age_s: Array32  # (M,)


@message
class CameraImage:
    """One global-shutter frame of the downward camera; the stamp is mid-exposure."""

    stamp_ns: int
    pixels: Bytes2D  # grey, (H, W)


@message
class RangeReading:
    """Downward range finder along body -z; NaN: no return."""

    stamp_ns: int
    range_m: float


@message
class BaroReading:
    """Barometric altitude above an arbitrary, slowly drifting zero."""

    stamp_ns: int
    altitude_m: float
