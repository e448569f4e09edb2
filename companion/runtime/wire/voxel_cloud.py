"""Occupied voxels as sensor_msgs/PointCloud2 in `odom`: float32 x, y, z and intensity, which is the log-odds."""

from __future__ import annotations

from typing import Any

import numpy as np

from companion.core.messages import OccupiedVoxels, freeze
from companion.runtime.wire.cloud import columns, point_table
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.parts import header_of, stamp_of

_FIELDS = ("x", "y", "z", "intensity")
_FLOAT32 = 7  # PointField
_FIELDS_VALUE = [{"name": n, "offset": 4 * i, "datatype": _FLOAT32, "count": 1} for i, n in enumerate(_FIELDS)]
_POINT_BYTES = 4 * len(_FIELDS)


def cloud_of(voxels: OccupiedVoxels) -> dict[str, Any]:
    """Value of a PointCloud2."""
    table = np.empty((len(voxels.points_odom), len(_FIELDS)), np.float32)
    table[:, :3], table[:, 3] = voxels.points_odom, voxels.log_odds
    return {
        "header": header_of(voxels.stamp_ns, "odom"),
        "height": 1,
        "width": len(table),
        "fields": _FIELDS_VALUE,
        "is_bigendian": False,
        "point_step": _POINT_BYTES,
        "row_step": _POINT_BYTES * len(table),
        "data": table.reshape(-1).view(np.uint8),
        "is_dense": True,
    }


def voxels_of(cloud: dict[str, Any]) -> OccupiedVoxels:
    """Inverse of `cloud_of`, for any PointCloud2 with x, y, z and intensity."""
    table = point_table(cloud, _FIELDS)
    names = table.dtype.names or ()
    if len(names) < len(_FIELDS):
        raise WireError(f"a cloud without x, y, z, intensity (fields: {', '.join(names) or 'none'})")
    voxels = OccupiedVoxels(
        stamp_ns=stamp_of(cloud["header"]),
        points_odom=columns(table, "x", "y", "z"),
        log_odds=columns(table, "intensity")[:, 0].copy(),
    )
    freeze(voxels)
    return voxels
