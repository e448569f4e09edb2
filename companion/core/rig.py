"""Where the sensors sit on the vehicle and how the camera projects: one calibration.

The simulator and the stack each get one, so a wrong calibration can be flown, too.
"""

from __future__ import annotations

import math

import msgspec
import numpy as np

from companion.core.messages import Array


class Mount(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Pose of a sensor in the body frame: position in m, roll-pitch-yaw in degrees (Z-Y-X)."""

    xyz_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    rpy_deg: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def p_body(self) -> Array:
        """Position in the body frame, m, (3,)."""
        return np.array(self.xyz_m)

    @property
    def R_body_sensor(self) -> Array:
        """Rotation that maps sensor vectors into the body frame, (3, 3)."""
        r, p, y = (math.radians(a) for a in self.rpy_deg)
        cr, sr, cp, sp, cy, sy = math.cos(r), math.sin(r), math.cos(p), math.sin(p), math.cos(y), math.sin(y)
        return np.array(
            [
                [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
                [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
                [-sp, cp * sr, cp * cr],
            ]
        )


class Pinhole(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Undistorted camera; optical frame: x right, y down, z forward."""

    width_px: int = 320
    height_px: int = 240
    focal_px: float = 200.0

    @property
    def center_px(self) -> tuple[float, float]:
        """Principal point; pixel (u, v) covers [u, u+1) x [v, v+1)."""
        return self.width_px / 2, self.height_px / 2


class Rig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """LiDAR, camera and range finder on the body. The IMU is the body's origin and axes."""

    lidar: Mount = Mount(xyz_m=(0.08, 0.0, 0.06), rpy_deg=(0.0, 15.0, 0.0))
    camera: Mount = Mount(xyz_m=(0.06, 0.0, -0.05), rpy_deg=(180.0, 0.0, -90.0))
    pinhole: Pinhole = Pinhole()
    range_finder: Mount = Mount(xyz_m=(0.0, 0.0, -0.06))
