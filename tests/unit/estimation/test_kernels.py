"""The kernels against definitions: finite differences, brute force, known motion."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from companion.core.geometry import exp_so3, log_so3
from companion.core.rig import Rig
from companion.estimation import camera
from companion.estimation.deskew import (
    ScanGate,
    constant_twist_nodes,
    deskew_directions,
    deskew_points,
    move_nodes,
)
from companion.estimation.downsample import Thinner
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.propagation import ImuNoise, propagate
from companion.estimation.registration import PlaneConfig, PlaneRegistration, find_planes
from companion.estimation.so3 import exp_into, orthonormal, tilt_free
from companion.estimation.state import State

vectors = st.tuples(*[st.floats(-1.8, 1.8)] * 3).map(np.array)
OPEN = ScanGate(min_range_m=0.0, max_range_m=1e3, hull_half_m=(0.0, 0.0, 0.0))


def random_state(rng):
    state = State(np.empty(24))
    state.x[9:] = rng.normal(size=15)
    state.R[:] = exp_so3(rng.normal(size=3))
    return state


@given(vectors)
@settings(max_examples=60, deadline=None)
def test_exp_kernel_is_core_geometry(w):
    R = np.empty((3, 3))
    exp_into(*w, R)
    np.testing.assert_allclose(R, exp_so3(w), atol=1e-10)
    if np.linalg.norm(w) < np.pi - 1e-3:
        np.testing.assert_allclose(log_so3(R), w, atol=1e-8)


@given(vectors)
@settings(max_examples=30, deadline=None)
def test_orthonormal_and_tilt(w):
    R = exp_so3(w) + 1e-7 * np.outer(w, [1, 2, 3])
    fixed = orthonormal(R)
    np.testing.assert_allclose(fixed @ fixed.T, np.eye(3), atol=1e-11)
    up = w + np.array([0, 0, 2.5])
    T = tilt_free(up)
    np.testing.assert_allclose(T @ up, [0, 0, np.linalg.norm(up)], atol=1e-9)
    np.testing.assert_allclose(T @ T.T, np.eye(3), atol=1e-12)


def test_state_minus_inverts_retract():
    rng = np.random.default_rng(0)
    a = random_state(rng)
    error = rng.normal(0, 0.3, 18)
    b = a.copy()
    b.retract(error)
    np.testing.assert_allclose(b.minus(a), error, atol=1e-9)


def test_propagation_covariance_is_the_finite_difference_jacobian():
    """With P = S S', the kernel must give (F S)(F S)', F from differences of the state."""
    rng = np.random.default_rng(1)
    state = random_state(rng)
    imu = np.concatenate([[0.005], rng.normal(0, 1, 3), rng.normal(0, 5, 3)])[None]
    none = np.zeros(4)

    def step(error):
        moved = state.copy()
        moved.retract(error)
        propagate(moved, np.zeros((18, 18)), imu, none, t_s=0.0)
        return moved

    centre = step(np.zeros(18))
    h = 1e-5
    F = np.column_stack([(step(h * e).minus(centre) - step(-h * e).minus(centre)) / (2 * h) for e in np.eye(18)])
    S = rng.normal(size=(18, 18))
    P = S @ S.T
    propagate(state.copy(), P, imu, none, t_s=0.0)
    # What is left is of second order in w dt, about 1e-5, times P of about 30.
    np.testing.assert_allclose(P, F @ S @ S.T @ F.T, atol=1e-3)


def test_propagation_noise_grows_as_densities_say():
    state = State.at_rest(9.80665)
    P = np.zeros((18, 18))
    imu = np.tile([0.005, 0, 0, 0, 0, 0, 9.80665], (200, 1))
    propagate(state, P, imu, ImuNoise().densities, t_s=0.0)
    assert P[6, 6] == pytest.approx(3e-2**2 + 9.8**2 * 1e-3**2 / 3, rel=0.02)
    assert P[2, 2] == pytest.approx(1e-3**2, rel=0.01)
    np.testing.assert_allclose(state.p, 0, atol=1e-12)


def twist_flight(omega, v, t):
    """Pose at time t <= 0 of a constant body twist that ends at the identity."""
    n = 4000
    R, p = np.eye(3), np.zeros(3)
    step = t / n
    half = exp_so3(omega * step / 2)
    for _ in range(n):
        p = p + R @ half @ v * step
        R = R @ half @ half
    return R, p


@pytest.mark.parametrize("source", ["imu", "twist"])
def test_deskew_is_exact_for_a_known_twist(source):
    rng = np.random.default_rng(2)
    omega, v = np.array([0.5, -0.4, 1.5]), np.array([6.0, 1.0, -0.5])
    rig = Rig()
    mount = (rig.lidar.R_body_sensor, rig.lidar.p_body)
    world = rng.uniform(-20, 20, (40, 3))
    age = rng.uniform(0, 0.1, 40)
    poses = [twist_flight(omega, v, -a) for a in age]
    sensor = np.array([(R.T @ (x - p) - mount[1]) @ mount[0] for x, (R, p) in zip(world, poses, strict=True)])
    if source == "twist":
        nodes = constant_twist_nodes(np.eye(3), np.zeros(3), omega, v, t_end_s=3.0, duration_s=0.25)
        end = (np.eye(3), np.zeros(3))
    else:
        state = State.at_rest(0.0)
        state.R[:], state.p[:] = twist_flight(omega, v, -0.2)
        state.v[:] = state.R @ v
        imu = np.tile([0.005, *omega, *np.cross(omega, v)], (40, 1))  # specific force of circling
        nodes = propagate(state, np.zeros((18, 18)), imu, np.zeros(4), t_s=2.8)
        end = (state.R, state.p)
        np.testing.assert_allclose(state.p, 0, atol=2e-4)
    body = deskew_points(
        sensor.astype(np.float32),
        age.astype(np.float32),
        nodes,
        pose_end=end,
        t_end_s=3.0,
        mount=mount,
        gate=OPEN,
    )
    np.testing.assert_allclose(body, (world - end[1]) @ end[0], atol=3e-4)
    dirs = sensor / np.linalg.norm(sensor, axis=1, keepdims=True)
    turned = deskew_directions(
        dirs.astype(np.float32), age.astype(np.float32), nodes, R_end=end[0], t_end_s=3.0, R_body_sensor=mount[0]
    )
    expected = [R @ mount[0] @ d for d, (R, _) in zip(dirs, poses, strict=True)]
    np.testing.assert_allclose(turned, expected, atol=1e-4)


def test_bad_points_are_left_out():
    points = np.array(
        [[5, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0], [0.1, 0, 0], [0.3, 0.3, 0.1], [900, 0, 0], [6, 0, 0], [7, 0, 0]],
        np.float32,
    )
    age = np.array([0, 0, 0, 0, 0, 0, -0.01, np.nan], np.float32)
    nodes = constant_twist_nodes(np.eye(3), np.zeros(3), np.zeros(3), np.zeros(3), t_end_s=0, duration_s=0.1)
    body = deskew_points(
        points,
        age,
        nodes,
        pose_end=(np.eye(3), np.zeros(3)),
        t_end_s=0.0,
        mount=(np.eye(3), np.zeros(3)),
        gate=ScanGate(),
    )
    np.testing.assert_array_equal(body, [[5, 0, 0]])


def test_moved_nodes_keep_the_motion_relative_to_the_end():
    rng = np.random.default_rng(3)
    state = random_state(rng)
    imu = np.column_stack([np.full(20, 0.005), rng.normal(0, 1, (20, 6))])
    nodes = propagate(state, np.eye(18), imu, np.zeros(4), t_s=0.0)
    points, age = rng.uniform(2, 9, (30, 3)).astype(np.float32), rng.uniform(0, 0.1, 30).astype(np.float32)

    def body(nodes, R, p):
        mount = (np.eye(3), np.zeros(3))
        return deskew_points(points, age, nodes, pose_end=(R, p), t_end_s=0.1, mount=mount, gate=OPEN)

    before = body(nodes, state.R, state.p)
    turn = exp_so3(np.array([0.1, -0.2, 0.3]))
    after = turn @ state.R, np.array([1.0, 2.0, 3.0]), turn @ state.v
    move_nodes(nodes, (state.R, state.p, state.v), after)
    np.testing.assert_allclose(body(nodes, *after[:2]), before, atol=2e-5)


def test_thinner_against_brute_force():
    points = np.random.default_rng(4).uniform(-3, 3, (3000, 3)).astype(np.float32)
    thinner = Thinner()
    cells = {}
    for x in points:
        cells.setdefault(tuple(np.floor(x.astype(float) / 0.5).astype(int)), []).append(x)
    means = np.array([np.mean(c, axis=0, dtype=float) for c in cells.values()])
    for _ in range(2):  # the scratch table is clean again after use
        np.testing.assert_allclose(thinner.centroids(points, 0.5, at_most=10**6), means, atol=1e-6)
        np.testing.assert_array_equal(thinner.firsts(points, 0.5), [c[0] for c in cells.values()])
    few = thinner.centroids(points, 0.5, at_most=100)
    assert len(few) == 100
    assert thinner.centroids(np.empty((0, 3), np.float32), 0.5, at_most=10).shape == (0, 3)


def test_map_keeps_spacing_and_grows_without_losing_points():
    rng = np.random.default_rng(5)
    points = rng.uniform(-40, 40, (60_000, 3)).astype(np.float32)
    target = PointMap(PointMapConfig(voxel_m=1.0))
    for part in np.array_split(points, 12):
        target.insert(part, np.eye(3), np.zeros(3))
    inside = {tuple(c) for c in np.floor(points).astype(int)}
    assert target.voxels == len(inside)
    assert 2 * target.voxels <= len(target.keys)
    known = {x.tobytes() for x in points}
    assert all(x.tobytes() in known for x in target.points())
    before = target.points()
    target.insert(before, np.eye(3), np.zeros(3))  # nothing new
    np.testing.assert_array_equal(target.points(), before)


def test_points_of_the_map_become_the_mean_of_what_was_seen_there():
    rng = np.random.default_rng(8)
    spots = np.stack(np.meshgrid(np.arange(12), np.arange(12), [0.25]), axis=-1).reshape(-1, 3) * 0.5 + [0.25, 0.25, 0]
    rms = {}
    for averaged in (1, 30):
        target = PointMap(PointMapConfig(averaged=averaged))
        for _ in range(60):
            target.insert((spots + rng.normal(0, 0.02, spots.shape)).astype(np.float32), np.eye(3), np.zeros(3))
        off = np.linalg.norm(target.points()[:, None] - spots, axis=2).min(axis=1)
        rms[averaged] = np.sqrt((off**2).mean())
        assert len(target.points()) == len(spots)
    assert rms[1] == pytest.approx(0.02 * 3**0.5, rel=0.15)
    assert rms[30] == pytest.approx(0.02 * (3 / 30) ** 0.5, rel=0.15)


@pytest.mark.parametrize("config", [PointMapConfig(averaged=20), PointMapConfig(max_voxels=40)])
def test_points_at_once_are_points_one_after_another(config):
    """Some share a voxel that is new with the first of them, some a spacing; in the second map not all have room."""
    points = np.random.default_rng(9).normal(0, 1.5, (700, 3)).astype(np.float32)
    at_once, one_by_one = PointMap(config), PointMap(config)
    at_once.insert(points, np.eye(3), np.zeros(3))
    for n in range(len(points)):
        one_by_one.insert(points[n : n + 1], np.eye(3), np.zeros(3))
    assert at_once.points().tobytes() == one_by_one.points().tobytes()
    assert (at_once.voxels, at_once.refused) == (one_by_one.voxels, one_by_one.refused)
    assert at_once.voxels >= 40


def test_a_full_map_refuses_and_never_hangs():
    rng = np.random.default_rng(6)
    target = PointMap(PointMapConfig(max_voxels=500))
    points = rng.uniform(-100, 100, (20_000, 3)).astype(np.float32)
    target.insert(points, np.eye(3), np.zeros(3))
    assert target.voxels == 500
    assert target.refused > 15_000
    planes, valid = np.empty((50, 4)), np.empty(50, np.bool_)
    far = points[:50].astype(np.float64)
    assert find_planes(target, far, np.eye(3), np.zeros(3), PlaneConfig(), planes, valid) == 0


def plane_world(rng):
    """Three noisy walls, and scan points near them."""
    u = rng.uniform(-6, 6, (6000, 2))
    walls = [np.column_stack(c) for c in ((u[:, 0], u[:, 1], 0 * u[:, 0]), (0 * u[:, 0], u[:, 0], u[:, 1]))]
    walls.append(np.column_stack([u[:, 0], 0 * u[:, 0] + 2.0, u[:, 1]]))
    cloud = np.concatenate(walls) + rng.normal(0, 0.01, (18_000, 3))
    target = PointMap(PointMapConfig())
    target.insert(cloud.astype(np.float32), np.eye(3), np.zeros(3))
    return target


def test_planes_against_brute_force_neighbours():
    rng = np.random.default_rng(7)
    target = plane_world(rng)
    cloud = target.points().astype(np.float64)
    queries = cloud[rng.integers(0, len(cloud), 200)] + rng.normal(0, 0.05, (200, 3))
    planes, valid = np.empty((200, 4)), np.empty(200, np.bool_)
    config = PlaneConfig(neighbour_m=0.4, breadth_m=0.0)  # below the voxel: 27 voxels are then exact
    find_planes(target, queries, np.eye(3), np.zeros(3), config, planes, valid)
    agreed = 0
    for query, plane, ok in zip(queries, planes, valid, strict=True):
        distance = np.linalg.norm(cloud - query, axis=1)
        near = cloud[np.argsort(distance)[:5]]
        normal = np.linalg.eigh(np.cov(near.T))[1][:, 0]
        off = (near - near.mean(axis=0)) @ normal
        expected = np.sort(distance)[4] < config.neighbour_m and np.abs(off).max() <= config.flatness_m
        assert ok == expected or abs(np.abs(off).max() - config.flatness_m) < 5e-3
        if ok and expected:
            spread = np.linalg.eigvalsh(np.cov(near.T))
            if spread[1] > 10 * spread[0] + 1e-4:  # a line of points has no plane
                assert abs(plane[:3] @ normal) > 0.999
                agreed += 1
    assert agreed > 100


def test_points_on_a_line_have_no_plane():
    line = np.column_stack([np.linspace(-1, 1, 400), np.zeros(400), np.zeros(400)])
    patch = np.stack(np.meshgrid(np.arange(-1, 1, 0.16), np.arange(3, 5, 0.16), [0.0]), axis=-1).reshape(-1, 3)
    target = PointMap(PointMapConfig())
    target.insert(np.concatenate([line, patch]).astype(np.float32), np.eye(3), np.zeros(3))
    queries = np.array([[0.1, 0.02, 0.0], [0.0, 4.0, 0.05]])
    planes, valid = np.empty((2, 4)), np.empty(2, np.bool_)
    find_planes(target, queries, np.eye(3), np.zeros(3), PlaneConfig(), planes, valid)
    np.testing.assert_array_equal(valid, [False, True])
    np.testing.assert_allclose(np.abs(planes[1]), [0, 0, 1, 0], atol=1e-6)


def test_plane_jacobian_is_the_finite_difference():
    rng = np.random.default_rng(8)
    target = plane_world(rng)
    R, p = exp_so3(np.array([0.02, -0.03, 0.05])), np.array([0.05, -0.04, 0.06])
    points = (target.points()[::40].astype(np.float64) + rng.normal(0, 0.02, (1, 3)) - p) @ R
    scan = PlaneRegistration(target, points, PlaneConfig(cauchy=1e12, range_gate=1e3, inflation=1.0))
    normal = scan.linearise(R, p)
    planes, valid = scan.met.copy(), scan.valid.copy()
    assert valid.sum() > 200

    def cost(dx):
        world = points[valid] @ (R @ exp_so3(dx[:3])).T + p + dx[3:]
        r = (world * planes[valid, :3]).sum(axis=1) + planes[valid, 3]
        return 0.5 * r @ r / 0.05**2

    check_normal_equations(cost, normal)


def check_normal_equations(cost, normal, *, curvature=5e-2):
    """g is minus the gradient of the cost; H is its Hessian but for the residuals' curvature."""
    h = 1e-4
    e = np.eye(6) * h
    gradient = np.array([(cost(d) - cost(-d)) / (2 * h) for d in e])
    np.testing.assert_allclose(-normal.g, gradient, rtol=1e-3, atol=1e-3 * np.abs(gradient).max())
    hessian = np.array([[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / (4 * h * h) for a in e] for b in e])
    scale = np.sqrt(np.outer(hessian.diagonal(), hessian.diagonal()))
    np.testing.assert_allclose(normal.H / scale, hessian / scale, atol=curvature)


def test_camera_jacobian_is_the_finite_difference():
    rng = np.random.default_rng(9)
    rig = Rig()
    R, p = exp_so3(np.array([0.1, -0.05, 0.7])), np.array([3.0, -2.0, 2.5])
    anchors = np.column_stack([p[:2] + rng.uniform(-1.5, 1.5, (80, 2)), rng.normal(0, 0.1, 80)])
    mount = (rig.camera.R_body_sensor, rig.camera.p_body)
    K = np.array([rig.pinhole.focal_px, *rig.pinhole.center_px])

    def project(R, p):
        optical = ((anchors - p) @ R - mount[1]) @ mount[0]
        return K[0] * optical[:, :2] / optical[:, 2:] + K[1:]

    pixels = project(R, p) + rng.normal(0, 0.5, (80, 2))
    H, g, accepted = np.empty((6, 6)), np.empty(6), np.zeros(80, np.bool_)
    limits = (1 / 3.2**2, 1e12, 1e9)
    assert camera._linearise(anchors, pixels, R, p, mount, K, limits, H, g, accepted) == 80

    def cost(dx):
        r = pixels - project(R @ exp_so3(dx[:3]), p + dx[3:])
        return 0.5 * (r**2).sum() / 3.2**2

    normal = Normal(R, p, H, g, 80, 80)
    check_normal_equations(cost, normal)


def test_camera_sees_down_and_gates_outliers():
    rig = Rig()
    forward = rig.camera.R_body_sensor @ [0, 0, 1]
    np.testing.assert_allclose(forward, [0, 0, -1], atol=1e-12)
    mount = (rig.camera.R_body_sensor, rig.camera.p_body)
    K = np.array([rig.pinhole.focal_px, *rig.pinhole.center_px])
    p = np.array([0.0, 0.0, 2.0])
    anchors = np.array([[0.06, 0.0, 0.0], [0.06, 0.0, 0.0], [0.0, 0.0, 3.0]])  # below, below, above
    pixels = np.array([[160.0, 120.0], [260.0, 120.0], [160.0, 120.0]])
    H, g, accepted = np.empty((6, 6)), np.empty(6), np.zeros(3, np.bool_)
    camera._linearise(anchors, pixels, np.eye(3), p, mount, K, (1 / 3.2**2, 9.0, 100.0), H, g, accepted)
    np.testing.assert_array_equal(accepted, [True, False, False])


def test_weakest_direction_of_a_plain_is_blind():
    rng = np.random.default_rng(10)
    flat = np.column_stack([rng.uniform(-8, 8, (9000, 2)), rng.normal(0, 0.01, 9000)])
    target = PointMap(PointMapConfig())
    target.insert(flat.astype(np.float32), np.eye(3), np.zeros(3))
    points = flat[::12] - [0, 0, 2.0]
    up = np.array([0, 0, 2.0])
    blind = PlaneRegistration(target, points, PlaneConfig()).linearise(np.eye(3), up)
    assert blind.weakest < 2e-3
    seen = PlaneRegistration(plane_world(rng), plane_world(rng).points()[::20].astype(float), PlaneConfig())
    assert seen.linearise(np.eye(3), np.zeros(3)).weakest > 0.05


def test_rotation_helpers_agree_with_scipy():
    w = np.array([0.3, -0.2, 0.9])
    R = np.empty((3, 3))
    exp_into(*w, R)
    np.testing.assert_allclose(R, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
