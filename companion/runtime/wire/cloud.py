"""LidarScan as sensor_msgs/PointCloud2, and any driver's PointCloud2 as LidarScan.

Ours: seven float32 per point, `x y z age_s beam_x beam_y beam_z`. Returns come first, with
beam 0; then the beams without return, NaN at x y z and their unit direction in beam.

A foreign cloud needs `x y z` (float32 or float64) anywhere in the point; points that are not
finite or exactly zero (no return) are dropped. Its time field may be, in order of preference
and as drivers are known to write it:
- `age_s`: seconds before the stamp, ours;
- `time`, `t`, `timestamp`, `time_stamp`, `offset_time`, `time_offset`: float32 seconds after the stamp
  (Velodyne; negative if the stamp is the sweep's end), integers nanoseconds after it (Ouster
  `t`, Livox `offset_time`), float64 the time itself, seconds or nanoseconds of an epoch (Hesai,
  RoboSense; Livox `timestamp`) or seconds after the stamp, told apart by their size.
The scan's stamp moves to its newest point if that is later, since ours is the sweep's end. A
clock that is over 10 s from the header's is another clock: then the newest point is at the stamp.
Without a time field the age is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from companion.core.messages import Array, Array32, LidarScan, freeze
from companion.runtime.wire.errors import WireError
from companion.runtime.wire.parts import header_of, stamp_of

FIELDS = ("x", "y", "z", "age_s", "beam_x", "beam_y", "beam_z")
TIME_FIELDS = ("time", "t", "timestamp", "time_stamp", "offset_time", "time_offset")
_WANTED = (*FIELDS, *TIME_FIELDS)
_DTYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}  # PointField
_FLOAT32 = 7
_POINT_BYTES = 4 * len(FIELDS)
_FIELDS_VALUE = [{"name": n, "offset": 4 * i, "datatype": _FLOAT32, "count": 1} for i, n in enumerate(FIELDS)]
_OWN = np.dtype([(name, "<f4") for name in FIELDS])
_OTHER_CLOCK_S = 10.0
_EPOCH_S, _EPOCH_NS = 1e6, 1e15  # from here on a float64 time is seconds, or nanoseconds, of an epoch


def cloud_of(scan: LidarScan) -> dict[str, Any]:
    """Value of a PointCloud2 in frame `lidar`."""
    returns, misses = len(scan.points_sensor), len(scan.miss_dirs_sensor)
    table = np.zeros((returns + misses, len(FIELDS)), np.float32)
    table[:returns, :3] = scan.points_sensor
    table[:returns, 3] = scan.point_age_s
    table[returns:, :3] = np.nan
    table[returns:, 3] = scan.miss_age_s
    table[returns:, 4:] = scan.miss_dirs_sensor
    return {
        "header": header_of(scan.stamp_ns, "lidar"),
        "height": 1,
        "width": len(table),
        "fields": _FIELDS_VALUE,
        "is_bigendian": False,
        "point_step": _POINT_BYTES,
        "row_step": _POINT_BYTES * len(table),
        "data": table.reshape(-1).view(np.uint8),
        "is_dense": False,
    }


def scan_of(cloud: dict[str, Any]) -> LidarScan:
    """LidarScan of any PointCloud2 with x, y and z."""
    stamp_ns = stamp_of(cloud["header"])
    points = point_table(cloud, _WANTED)
    names = points.dtype.names or ()
    if not {"x", "y", "z"} <= set(names):
        raise WireError(f"a cloud without x, y, z (fields: {', '.join(names) or 'none'})")
    if set(FIELDS) <= set(names):
        own = points.view("<f4").reshape(-1, len(FIELDS)) if points.dtype == _OWN else columns(points, *FIELDS)
        return _own(stamp_ns, own)
    xyz = columns(points, "x", "y", "z")
    kept = np.isfinite(xyz).all(axis=1) & (xyz != 0).any(axis=1)
    age_s, newest_ns = _ages(points[kept], stamp_ns)
    none = np.empty((0, 3), np.float32)
    return _scan(stamp_ns + newest_ns, xyz[kept], age_s, none, np.empty(0, np.float32))


def _own(stamp_ns: int, table: Array32) -> LidarScan:
    miss = (table[:, 4] != 0) | (table[:, 5] != 0) | (table[:, 6] != 0)
    returns = len(table) - int(np.count_nonzero(miss))
    if miss[:returns].any():  # someone mixed them
        table = table[np.argsort(miss, kind="stable")]
    hits, misses = table[:returns], table[returns:]
    return _scan(stamp_ns, hits[:, :3].copy(), hits[:, 3].copy(), misses[:, 4:].copy(), misses[:, 3].copy())


def _scan(stamp_ns: int, points: Array32, age_s: Array32, misses: Array32, miss_age_s: Array32) -> LidarScan:
    scan = LidarScan(
        stamp_ns=stamp_ns,
        points_sensor=points,
        point_age_s=age_s,
        miss_dirs_sensor=misses,
        miss_age_s=miss_age_s,
    )
    freeze(scan)
    return scan


def point_table(cloud: dict[str, Any], wanted: Sequence[str]) -> np.ndarray[Any, Any]:
    """The points as a struct array (N,) of those fields of `wanted` that the cloud has; WireError if it is none."""
    height, width = cloud["height"], cloud["width"]
    step, row = cloud["point_step"], cloud["row_step"]
    dtype = _point_dtype(cloud["fields"], wanted, step, ">" if cloud["is_bigendian"] else "<")
    data = cloud["data"]
    if height == 0 or width == 0:
        return np.empty(0, dtype)
    if row < step * width or row * (height - 1) + step * width > data.size:
        raise WireError(f"{data.size} bytes are no cloud of {height} x {width} points of {step} bytes")
    if height == 1 or row == step * width:
        return np.frombuffer(data, dtype, height * width)
    rows = np.lib.stride_tricks.as_strided(data, (height, step * width), (row, 1))
    return np.ascontiguousarray(rows).reshape(-1).view(dtype)


def _point_dtype(fields: list[dict[str, Any]], wanted: Sequence[str], step: int, order: str) -> np.dtype[Any]:
    names, formats, offsets = [], [], []
    for field in fields:
        name, code = field["name"], _DTYPES.get(field["datatype"])
        if name not in wanted or name in names:
            continue
        if code is None:
            raise WireError(f"field {name} of a cloud has data type {field['datatype']} (valid: 1..8)")
        if field["offset"] + int(code[1]) > step:
            raise WireError(f"field {name} at byte {field['offset']} of a point of {step} bytes")
        names.append(name)
        formats.append(order + code)
        offsets.append(field["offset"])
    if not step or step > 1 << 16:
        raise WireError(f"a cloud with {step} bytes per point")
    layout: Any = {"names": names, "formats": formats, "offsets": offsets, "itemsize": step}
    dtype: np.dtype[Any] = np.dtype(layout)
    return dtype


def columns(points: np.ndarray[Any, Any], *names: str) -> Array32:
    """Some fields of a point table, (N, K)."""
    out = np.empty((len(points), len(names)), np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for i, name in enumerate(names):
            out[:, i] = points[name]
    return out


def _ages(points: np.ndarray[Any, Any], stamp_ns: int) -> tuple[Array32, int]:
    """Age of each point before the newest, s, and how far the newest is behind the stamp, ns."""
    names = points.dtype.names or ()
    if "age_s" in names:
        age_s = np.nan_to_num(np.maximum(columns(points, "age_s")[:, 0], 0), nan=0.0, posinf=0.0)
        return age_s, 0
    name = next((n for n in TIME_FIELDS if n in names), None)
    if name is None or not len(points):
        return np.zeros(len(points), np.float32), 0
    time_s = _after_stamp_s(points[name], stamp_ns)
    valid = np.isfinite(time_s)
    latest = float(time_s[valid].max()) if valid.any() else 0.0
    other_clock = abs(latest) > _OTHER_CLOCK_S
    newest = latest if other_clock else max(latest, 0.0)
    age_s = np.where(valid, newest - time_s, 0.0).astype(np.float32)
    return age_s, 0 if other_clock else round(newest * 1e9)


def _after_stamp_s(times: np.ndarray[Any, Any], stamp_ns: int) -> Array:
    """Times of the points after the header's stamp, s."""
    seconds: Array = times.astype(np.float64)
    if times.dtype.kind in "iu":
        return seconds * 1e-9
    if times.dtype.itemsize == 4:
        return seconds
    finite = seconds[np.isfinite(seconds)]
    size = float(np.abs(finite).max()) if finite.size else 0.0
    if size > _EPOCH_NS:
        return (seconds - float(stamp_ns)) * 1e-9
    return seconds - stamp_ns * 1e-9 if size > _EPOCH_S else seconds
