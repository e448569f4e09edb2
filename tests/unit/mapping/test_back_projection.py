"""Image points to the world and back, covariance against Monte Carlo, what stands in the way."""

import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))
from local_maps import CELL_M, box, made, plane_map, with_cells

from companion.core.geometry import exp_so3
from companion.core.rig import Rig
from companion.mapping.back_projection import BackProjectionConfig, Pose, back_project, ground_height
from companion.mapping.voxel_map import OCCUPIED_CELL

RIG, CONFIG = Rig(), BackProjectionConfig()
NOISE = np.array([0.01, 0.01, 0.02, 0.03, 0.03, 0.02]) ** 2
SURE = np.full(6, 1e-12)


def pose_at(p, rotation=(0.0, 0.0, 0.0), variance=SURE):
    return Pose(np.array(p, float), exp_so3(np.array(rotation, float)), variance)


def project(points, pose):
    body = (points - pose.p_odom) @ pose.R_odom_body
    optical = (body - RIG.camera.p_body) @ RIG.camera.R_body_sensor
    return optical[:, :2] / optical[:, 2:] * RIG.pinhole.focal_px + RIG.pinhole.center_px


def grid_px(step=40):
    u, v = np.meshgrid(np.arange(10, 320, step), np.arange(10, 240, step))
    return np.column_stack([u.ravel(), v.ravel()]) + 0.5


@given(
    slope=st.tuples(*[st.floats(-0.25, 0.25)] * 2),
    agl=st.floats(1.0, 4.0),
    tilt=st.tuples(*[st.floats(-0.2, 0.2)] * 3),
)
@settings(max_examples=15, deadline=None)
def test_points_lie_on_the_plane_and_project_to_where_they_came_from(slope, agl, tilt):
    local_map = plane_map(slope=slope)
    pose = pose_at([0.3, -0.2, agl], tilt)
    uv = grid_px()
    surface = back_project(uv, pose, RIG, local_map, CONFIG)
    assert surface.ground.mean() > 0.9
    p = surface.position_odom[surface.ground]
    np.testing.assert_allclose(p[:, 2], p[:, :2] @ np.array(slope), atol=0.006)
    np.testing.assert_allclose(project(p, pose), uv[surface.ground], atol=1e-6)


def test_covariance_is_that_of_many_trials():
    rng = np.random.default_rng(0)
    trials, uv = 600, grid_px(95)
    local_map, pose = plane_map(), pose_at([0, 0, 2.5], (0.1, -0.15, 0.4), NOISE)
    said = back_project(uv, pose, RIG, local_map, CONFIG)
    found = np.empty((trials, len(uv), 3))
    for k in range(trials):
        error = rng.normal(size=6) * np.sqrt(NOISE)
        moved = Pose(pose.p_odom + error[3:], pose.R_odom_body @ exp_so3(error[:3]), NOISE)
        noisy = uv + rng.normal(size=uv.shape) * CONFIG.pixel_sigma_px
        # the ground of the map is off by so much, for each point on its own
        rays = back_project(noisy, moved, RIG, local_map, CONFIG).position_odom - moved.p_odom
        camera = moved.R_odom_body @ RIG.camera.p_body
        height = rng.normal(size=len(uv)) * CONFIG.ground_sigma_m
        along = rays - camera
        found[k] = moved.p_odom + rays + along * (height / along[:, 2])[:, None]
    error = found - found.mean(axis=0)
    measured = np.einsum("kni,knj->nij", error, error) / trials
    for a, b in zip(measured, said.covariance, strict=True):
        np.testing.assert_allclose(a, b, atol=0.15 * np.trace(b))
        assert np.trace(a) == pytest.approx(np.trace(b), rel=0.15)


def test_a_slab_in_the_way_is_met_and_is_no_ground():
    slab = box([-0.5, -0.5, 1.0], [0.5, 0.5, 1.2])
    local_map = with_cells(plane_map(), slab)
    pose = pose_at([0, 0, 2.5])
    uv = grid_px()
    surface = back_project(uv, pose, RIG, local_map, CONFIG)
    clear = back_project(uv, pose, RIG, plane_map(), CONFIG)
    assert surface.met.all() and clear.ground.all()
    stopped = ~surface.ground
    assert 0 < stopped.sum() < len(uv)
    cells = np.floor((surface.position_odom[stopped] - local_map.origin_odom) / CELL_M).astype(int)
    assert (local_map.state[tuple(cells.T)] == OCCUPIED_CELL).all()
    assert (surface.position_odom[stopped, 2] > 0.9).all()
    np.testing.assert_array_equal(surface.position_odom[~stopped], clear.position_odom[~stopped])


def test_no_ground_where_none_was_seen_nor_out_of_reach():
    hidden = with_cells(plane_map(), box([-9, -9, -3], [0, 9, 3]), state=0, hides_ground=True)
    surface = back_project(grid_px(), pose_at([0, 0, 2.0]), RIG, hidden, CONFIG)
    assert (surface.position_odom[surface.met, 0] > -CELL_M).all()
    assert 0.3 < surface.met.mean() < 0.7
    far = back_project(grid_px(), pose_at([0, 0, 2.0]), RIG, plane_map(), BackProjectionConfig(max_range_m=1.0))
    assert not far.met.any()
    upside_down = back_project(grid_px(), pose_at([0, 0, 2.0], (np.pi, 0, 0)), RIG, plane_map(), CONFIG)
    assert not upside_down.met.any()


def test_ground_height_is_bilinear_and_needs_half_of_the_weight():
    rng = np.random.default_rng(2)
    field = rng.normal(size=(6, 6)).astype(np.float32)
    field[3, 3] = np.nan
    local_map = made(np.zeros((6, 6, 6)), (1.0, -2.0, 0.0), field)
    xy = np.array([1.0, -2.0]) + rng.uniform(-0.3, 1.5, (300, 2))
    for (x, y), z in zip((xy - [1.0, -2.0]) / CELL_M - 0.5, ground_height(local_map, xy), strict=True):
        total = weight = 0.0
        for i in (int(np.floor(x)), int(np.floor(x)) + 1):
            for j in (int(np.floor(y)), int(np.floor(y)) + 1):
                share = (1 - abs(x - i)) * (1 - abs(y - j))
                if 0 <= i < 6 and 0 <= j < 6 and not np.isnan(field[i, j]):
                    total, weight = total + share * field[i, j], weight + share
        if abs(weight - 0.5) > 1e-9:
            np.testing.assert_allclose(z, total / weight if weight > 0.5 else np.nan, atol=1e-6)
    assert np.isnan(ground_height(local_map, np.array([[np.nan, 0.0]]))).all()
