"""PointCloud2: our sweeps bit for bit, and the clouds of drivers as they are known to write them."""

from typing import Any

import numpy as np
import pytest

from companion.core import messages as m
from companion.core import topics
from companion.runtime.wire import WireError, codec_of

STAMP = 1_764_000_000_500_000_000
CODEC = codec_of(topics.LIDAR)
XYZ = np.array([[1, 2, 3], [4, 5, 6], [7, 8, 9]], np.float32)
DATATYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def sweep(returns: int, misses: int) -> m.LidarScan:
    rng = np.random.default_rng(returns + misses)
    dirs = rng.normal(size=(misses, 3))
    scan = m.LidarScan(
        stamp_ns=STAMP,
        points_sensor=rng.normal(size=(returns, 3)).astype(np.float32),
        point_age_s=rng.uniform(0, 0.1, returns).astype(np.float32),
        miss_dirs_sensor=(dirs / np.linalg.norm(dirs, axis=1, keepdims=True)).astype(np.float32),
        miss_age_s=rng.uniform(0, 0.1, misses).astype(np.float32),
    )
    m.freeze(scan)
    return scan


@pytest.mark.parametrize(("returns", "misses"), [(0, 0), (5, 0), (0, 4), (300, 200)])
def test_sweep_round_trip(returns: int, misses: int) -> None:
    scan = sweep(returns, misses)
    again = CODEC.decode(CODEC.encode(scan))
    assert again.stamp_ns == scan.stamp_ns
    for name in scan.__slots__[1:]:
        a, b = getattr(scan, name), getattr(again, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        assert b.flags.c_contiguous and b.flags.aligned and not b.flags.writeable


def test_a_mixed_sweep_is_sorted_again() -> None:
    scan = sweep(3, 2)
    value = CODEC.type.decode(CODEC.encode(scan))
    mixed = value["data"].view(np.float32).reshape(5, 7)[[3, 0, 1, 4, 2]]
    again = CODEC.decode(CODEC.type.encode(value | {"data": mixed.tobytes()}))
    for name in scan.__slots__[1:]:
        assert getattr(scan, name).tobytes() == getattr(again, name).tobytes()


def test_a_sweep_is_a_plain_cloud_for_others() -> None:
    value = CODEC.type.decode(CODEC.encode(sweep(3, 2)))
    assert [f["name"] for f in value["fields"]] == ["x", "y", "z", "age_s", "beam_x", "beam_y", "beam_z"]
    assert (value["height"], value["width"], value["point_step"], value["row_step"]) == (1, 5, 28, 140)
    table = value["data"].view(np.float32).reshape(5, 7)
    assert np.isnan(table[3:, :3]).all() and (table[:3, 4:] == 0).all() and not value["is_dense"]
    assert value["header"]["frame_id"] == "lidar"


def cloud(points: np.ndarray[Any, Any], *, order: str = "<", height: int = 1, padding: int = 0) -> m.LidarScan:
    """Decode a cloud of a struct array as a driver would send it."""
    names = points.dtype.names or ()
    kinds = {n: points.dtype.fields[n] for n in names}  # type: ignore[index]
    width, step = len(points) // height, points.dtype.itemsize
    rows = points.view(np.uint8).reshape(height, width * step)
    data = np.pad(rows, ((0, 0), (0, padding)))
    value = {
        "header": {"stamp": dict(zip(("sec", "nanosec"), divmod(STAMP, 10**9), strict=True))},
        "height": height,
        "width": width,
        "fields": [
            {"name": n, "offset": kinds[n][1], "datatype": DATATYPES[kinds[n][0].str[1:]], "count": 1} for n in names
        ],
        "is_bigendian": order == ">",
        "point_step": step,
        "row_step": width * step + padding,
        "data": data.ravel(),
    }
    scan: m.LidarScan = CODEC.decode(CODEC.type.encode(value))
    return scan


def points(time: str = "", kind: str = "", times: Any = (), *, order: str = "<", real: str = "f4") -> Any:
    layout = [
        ("intensity", f"{order}f4"),
        ("z", order + real),
        ("y", order + real),
        ("x", order + real),
        ("ring", "u1"),
    ]
    layout += [(time, order + kind)] if time else []
    table = np.zeros(3, layout)
    for i, axis in enumerate("xyz"):
        table[axis] = XYZ[:, i]
    if time:
        table[time] = times
    return table


@pytest.mark.parametrize("order", "<>")
@pytest.mark.parametrize("real", ["f4", "f8"])
def test_fields_are_found_by_name(order: str, real: str) -> None:
    scan = cloud(points(order=order, real=real), order=order)
    np.testing.assert_array_equal(scan.points_sensor, XYZ)
    assert scan.stamp_ns == STAMP and scan.point_age_s.tolist() == [0, 0, 0] and scan.miss_dirs_sensor.shape == (0, 3)


def test_rows_may_be_padded() -> None:
    np.testing.assert_array_equal(cloud(points(), height=3, padding=5).points_sensor, XYZ)


CONVENTIONS = {
    "velodyne, stamp at the start": ("time", "f4", [0.0, 0.04, 0.1], 100_000_000),
    "velodyne, stamp at the end": ("time", "f4", [-0.1, -0.06, 0.0], 0),
    "ouster": ("t", "u4", [0, 40_000_000, 100_000_000], 100_000_000),
    "livox custom": ("offset_time", "u4", [0, 40_000_000, 100_000_000], 100_000_000),
    "livox, nanoseconds of the epoch": ("timestamp", "f8", [STAMP, STAMP + 4e7, STAMP + 1e8], 100_000_000),
    "hesai, seconds of the epoch": ("timestamp", "f8", [STAMP / 1e9 - 0.1, STAMP / 1e9 - 0.06, STAMP / 1e9], 0),
    "seconds after the stamp": ("timestamp", "f8", [0.0, 0.04, 0.1], 100_000_000),
    "a clock since boot": ("timestamp", "f8", [5000.0, 5000.04, 5000.1], 0),
    "another epoch": ("timestamp", "f8", [1.2e9, 1.2e9 + 0.04, 1.2e9 + 0.1], 0),
}


@pytest.mark.parametrize("name", CONVENTIONS)
def test_times_of_drivers(name: str) -> None:
    field, kind, times, later_ns = CONVENTIONS[name]
    scan = cloud(points(field, kind, times))
    np.testing.assert_allclose(scan.point_age_s, [0.1, 0.06, 0.0], atol=1e-6)
    assert abs(scan.stamp_ns - (STAMP + later_ns)) < 1000


def test_no_return_and_not_a_number_are_dropped() -> None:
    table = points("time", "f4", [0.0, np.nan, 0.1])
    table["x"][0] = np.nan
    scan = cloud(table)
    np.testing.assert_array_equal(scan.points_sensor, XYZ[1:])
    np.testing.assert_allclose(scan.point_age_s, [0.0, 0.0], atol=1e-6)
    zero = points()
    zero["x"][1] = zero["y"][1] = zero["z"][1] = 0
    np.testing.assert_array_equal(cloud(zero).points_sensor, XYZ[[0, 2]])


def bad(**changes: Any) -> bytes:
    fields = [{"name": n, "offset": 4 * i, "datatype": 7, "count": 1} for i, n in enumerate("xyz")]
    value = {"height": 1, "width": 2, "fields": fields, "point_step": 12, "row_step": 24, "data": bytes(24)}
    return CODEC.type.encode(value | changes)


BAD = [
    ({"fields": []}, r"without x, y, z \(fields: none\)"),
    ({"data": bytes(23)}, "23 bytes are no cloud of 1 x 2 points of 12 bytes"),
    ({"width": 2**32 - 1}, "are no cloud"),
    ({"height": 2**32 - 1, "row_step": 0}, "are no cloud"),
    ({"point_step": 0, "row_step": 0}, "of a point of 0 bytes"),
    ({"point_step": 8}, "field z at byte 8 of a point of 8 bytes"),
    ({"fields": [{"name": "x", "offset": 0, "datatype": 9}]}, "field x of a cloud has data type 9"),
]


@pytest.mark.parametrize(("changes", "match"), BAD)
def test_clouds_that_are_none(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(WireError, match=match):
        CODEC.decode(bad(**changes))
    assert len(CODEC.decode(bad()).points_sensor) == 0  # two zero points: no returns
