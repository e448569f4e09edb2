"""Windows of scans are whole seconds about their last place; eyes are where the map is known to be free."""

import numpy as np
import pytest

from companion.core.geometry import quaternion_from_yaw
from companion.core.messages import RegisteredScan
from companion.mapping.formats.stored_map import stored
from companion.mapping.voxel_map import VoxelMap, VoxelMapConfig
from companion.runtime.locate import windows
from companion.runtime.map_places import free_eyes

EMPTY = np.empty((0, 3), np.float32)


def scan(time_s, p, yaw, points_odom):
    """A scan of points in odom, as the body there has them."""
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return RegisteredScan(
        stamp_ns=round(time_s * 1e9), points_body=((points_odom - p) @ R).astype(np.float32), miss_dirs_body=EMPTY,
        origin_body=np.zeros(3), p_odom=np.asarray(p, float), q_odom_body=quaternion_from_yaw(yaw),
    )  # fmt: skip


def test_windows_gather_a_second_about_the_last_place():
    rng = np.random.default_rng(0)
    points = rng.uniform(-5, 5, (40, 3)) - [0, 0, 5]
    flown = [scan(0.1 * k, np.array([0.2 * k, 0.0, 2.0]), 0.1 * k, points) for k in range(35)]
    found = list(windows(flown, begin_ns=500_000_000))
    assert [w.stamp_ns for w in found] == [1_500_000_000, 2_500_000_000]
    assert [len(w.points) for w in found] == [11 * 40, 10 * 40]
    assert found[0].p_odom == pytest.approx([3.0, 0.0, 2.0])
    assert np.abs(found[1].points.reshape(10, 40, 3) - (points - found[1].p_odom)).max() < 1e-4


def test_height_is_that_above_the_ground_below():
    grid = np.stack(np.meshgrid(np.arange(-3, 3, 0.2), np.arange(-3, 3, 0.2), [0.0]), axis=-1).reshape(-1, 3)
    (window,) = windows([scan(0.1 * k, np.array([0, 0, 1.7]), 0.0, grid) for k in range(11)], begin_ns=0)
    assert window.height_m == pytest.approx(1.7, abs=0.01)


def test_eyes_are_free_cells_at_the_height_asked_for():
    """A floor of 8 x 8 m seen from its middle: free above it as far as rays went, nothing beyond."""
    voxels = VoxelMap(VoxelMapConfig())
    floor = np.stack(np.meshgrid(np.arange(-4, 4, 0.1), np.arange(-4, 4, 0.1), [-2.05]), axis=-1).reshape(-1, 3)
    for _ in range(3):
        voxels.insert(floor.astype(np.float32), R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
    eyes = free_eyes(stored(voxels), 1.0)
    assert len(eyes) > 4
    assert eyes[:, 2] == pytest.approx(-2.1 + 1.0, abs=0.11)
    assert np.abs(eyes[:, :2]).max() < 4.0 * 1.2 / 2.05 + 0.1  # of the way out where a ray passes the lowest such cell
