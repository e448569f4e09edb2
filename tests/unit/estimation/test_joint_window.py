"""The joint window: its Jacobians, its prior, and what several sweeps find together that one does not."""

import numpy as np
import pytest

from companion.core import topics
from companion.core.geometry import exp_so3, log_so3
from companion.core.rig import Mount, Rig
from companion.estimation.config import EstimationConfig
from companion.estimation.course import Course
from companion.estimation.downsample import Thinner
from companion.estimation.filter import Filter
from companion.estimation.lio import Lio, LioConfig
from companion.estimation.node import LioNode
from companion.estimation.point_map import PointMap
from companion.estimation.propagation import ImuNoise, propagate
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.standing import StandingConfig
from companion.estimation.state import State
from companion.estimation.window.fresh_points import FreshPoints
from companion.estimation.window.joint_planes import Sweep, _place_planes, associate, linearise
from companion.estimation.window.joint_window import JointWindow, JointWindowConfig
from companion.estimation.window.preintegration import ImuResidual, imu_residual, preintegrate
from companion.estimation.window.prior import Prior, eliminate
from companion.estimation.window.rescue import Rescue, RescueConfig
from companion.runtime.bench.estimation_replay import feed
from tests.unit.estimation.synthetic import record
from tests.unit.estimation.test_flight import TOPIC, run

G = 9.80665
DENSITIES = ImuNoise().densities
RIG = Rig(lidar=Mount())


def shaken(rng, pieces=40):
    """IMU of a lively flight: dt, rate, specific force."""
    return np.column_stack(
        [np.full(pieces, 0.005), rng.normal(0, 0.8, (pieces, 3)), rng.normal([0, 0, G], 2.0, (pieces, 3))]
    )


def somewhere(rng):
    state = State.at_rest(G)
    state.R[:] = exp_so3(rng.normal(size=3))
    state.x[9:21] = rng.normal(size=12) * np.repeat([3.0, 2.0, 0.01, 0.1], 3)
    return state


def test_preintegration_means_the_same_as_the_filter():
    rng = np.random.default_rng(0)
    imu, first = shaken(rng), somewhere(rng)
    second, P = first.copy(), np.zeros((18, 18))
    propagate(second, P, imu, DENSITIES, t_s=0.0)
    pre = preintegrate(imu, first.x[15:21], DENSITIES)
    found = imu_residual(pre, first, second, first.g)
    assert np.abs(np.linalg.solve(pre.root, found.r)).max() < 1e-9
    turned = np.eye(15)  # the filter's errors of p and v are in odom, those of the residual in the first body
    turned[3:6, 3:6] = turned[6:9, 6:9] = first.R.T
    covariance = np.linalg.inv(pre.root.T @ pre.root)
    np.testing.assert_allclose(covariance, turned @ P[:15, :15] @ turned.T, rtol=1e-6, atol=2e-10)


def test_imu_jacobians_are_finite_differences():
    rng = np.random.default_rng(1)
    imu, first = shaken(rng), somewhere(rng)
    second = first.copy()
    propagate(second, np.zeros((18, 18)), imu, DENSITIES, t_s=0.0)
    pre = preintegrate(imu, first.x[15:21] + rng.normal(0, 1e-3, 6), DENSITIES)
    second.retract(np.concatenate([rng.normal(0, 0.02, 15), np.zeros(3)]))
    found = imu_residual(pre, first, second, first.g)
    step = 1e-6

    def moved(which, k, by):
        states, g = [first.copy(), second.copy()], first.g.copy()
        if which == 2:
            g[k] += by
        else:
            states[which].retract(by * np.eye(18)[k])
        return imu_residual(pre, *states, g).r

    for which, J in enumerate((found.by_first, found.by_second, found.by_gravity)):
        numeric = np.column_stack(
            [(moved(which, k, step) - moved(which, k, -step)) / (2 * step) for k in range(J.shape[1])]
        )
        np.testing.assert_allclose(J, numeric, atol=2e-4 * np.abs(numeric).max())


def patches(rng, poses):
    """A sweep of two poses' points on the walls of a room, of which node 0 has seen all, as its own body has them."""
    walls = rng.uniform(-4, 4, (4000, 3))
    walls[np.arange(4000), np.arange(4000) % 3] = np.where(np.arange(4000) % 2, 4.0, -4.0)
    seen = rng.permutation(walls)[:60] + rng.normal(0, 0.01, (60, 3))
    (R0, p0), (R1, p1) = poses
    return (walls - p0) @ R0, (seen - p1) @ R1


@pytest.mark.parametrize("owned", [False, True])
def test_plane_jacobians_are_finite_differences(owned):
    """Of planes that stand in the map, and of planes that move with another node."""
    rng = np.random.default_rng(2)
    config = PlaneConfig(cauchy=1e12, inflation=1.0)
    poses = [(exp_so3(rng.normal(0, 0.3, 3)), rng.normal(0, 0.3, 3)) for _ in range(2)]
    old, new = patches(rng, poses)
    known, fresh = PointMap(LioConfig().map), FreshPoints(5000, voxel_m=0.5, spacing_m=0.15)
    if owned:
        fresh.insert(old, *poses[0], 5)
    else:
        known.insert(old.astype(np.float32), *poses[0])
    sweep = Sweep(new, np.empty((0, 3), np.float32))
    associate(sweep, known, fresh, poses[1], config)
    assert (sweep.owner == (5 if owned else -1)).all()

    def cost(step):
        R = np.array([pose[0] @ exp_so3(d[:3]) for pose, d in zip(poses, step.reshape(2, 6), strict=True)])
        p = np.array([pose[1] + d[3:] for pose, d in zip(poses, step.reshape(2, 6), strict=True)])
        r = np.empty(len(new))
        _place_planes(
            new, (R, p, 1, 5), sweep.near, sweep.owner, (config.flatness_m, 5 * config.breadth_m**2), sweep.planes, r
        )
        return 0.5 * np.nansum(r**2) / config.sigma_m**2 / (1.4 if owned else 1.0)

    R, p = np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])
    _, g = linearise(sweep, 1, (R, p), 5, config)
    assert sweep.used > 40
    numeric = np.array([(cost(1e-6 * e) - cost(-1e-6 * e)) / 2e-6 for e in np.eye(12)])
    np.testing.assert_allclose(-g, numeric, atol=2e-3 * np.abs(numeric).max())
    assert np.abs(numeric[:6]).max() > 1.0 if owned else not numeric[:6].any()


def test_planes_of_the_window_say_nothing_of_where_it_is():
    """All nodes moved as one body: no residual changes, so the information of that motion is nought."""
    rng = np.random.default_rng(3)
    poses = [(exp_so3(rng.normal(0, 0.3, 3)), rng.normal(0, 0.5, 3)) for _ in range(3)]
    old, new = patches(rng, [poses[0], poses[2]])
    fresh = FreshPoints(9000, voxel_m=0.5, spacing_m=0.05)
    half = len(old) // 2
    fresh.insert(old[:half], *poses[0], 0)
    middle = old[half:] @ poses[0][0].T + poses[0][1]
    fresh.insert((middle - poses[1][1]) @ poses[1][0], *poses[1], 1)
    sweep = Sweep(new, np.empty((0, 3), np.float32))
    associate(sweep, PointMap(LioConfig().map), fresh, poses[2], PlaneConfig())
    assert len(np.unique(sweep.owner)) == 2  # some planes are of both
    R, p = np.array([pose[0] for pose in poses]), np.array([pose[1] for pose in poses])
    H, _ = linearise(sweep, 2, (R, p), 0, PlaneConfig())
    turn, shift = rng.normal(size=(2, 3))
    moved = np.concatenate([np.r_[R[k].T @ turn, np.cross(turn, p[k]) + shift] for k in range(3)])
    assert np.abs(H @ moved).max() < 1e-9 * np.abs(H).max()


def test_a_prior_left_behind_equals_the_whole_batch():
    """A linear chain of six nodes: what five of them leave is what the sixth knows of all."""
    rng = np.random.default_rng(4)
    states = [somewhere(rng) for _ in range(6)]
    links = [
        ImuResidual(rng.normal(size=15), *rng.normal(size=(2, 15, 15)), rng.normal(size=(15, 3))) for _ in range(5)
    ]
    root = rng.normal(size=(18, 18))
    first = Prior(states[0].copy(), root.T @ root, rng.normal(size=18))
    said = []
    for _ in range(5):
        root = rng.normal(size=(6, 6))
        said.append((root.T @ root, rng.normal(size=6)))
    H, g = np.zeros((93, 93)), np.zeros(93)
    prior, gravity = first, np.r_[90:93]
    at = np.r_[0:15, gravity]
    H[np.ix_(at, at)] += first.H
    g[at] += first.g
    for k, (link, (own, right)) in enumerate(zip(links, said, strict=True)):
        prior = eliminate(prior, [(own, right)], link, (states[k], states[k + 1]))
        J, at = np.hstack([link.by_first, link.by_second, link.by_gravity]), np.r_[15 * k : 15 * k + 30, gravity]
        H[np.ix_(at, at)] += J.T @ J
        g[at] -= J.T @ link.r
        H[15 * k : 15 * k + 6, 15 * k : 15 * k + 6] += own
        g[15 * k : 15 * k + 6] += right
    last = np.r_[75:93]
    np.testing.assert_allclose(np.linalg.solve(prior.H, prior.g), np.linalg.solve(H, g)[last], rtol=1e-6)
    np.testing.assert_allclose(np.linalg.inv(prior.H), np.linalg.inv(H)[np.ix_(last, last)], rtol=1e-6, atol=1e-9)


def room(rng, count=9000):
    """Points on the six sides of a room of 12 x 10 x 8 m, exactly."""
    half = np.array([6.0, 5.0, 4.0])
    walls = rng.uniform(-1, 1, (count, 3)) * half
    side = np.arange(count) % 3
    walls[np.arange(count), side] = np.where(np.arange(count) % 2, half[side], -half[side])
    return walls


def true_motion(k):
    """R, p, v after k sweeps of 0.1 s: 0.5 m/s2 along x, 0.3 rad/s about z."""
    t = 0.1 * k
    return exp_so3(np.array([0, 0, 0.3 * t])), np.array([0.25 * t**2, 0, 0]), np.array([0.5 * t, 0, 0])


def imu_of(k):
    """Twenty exact pieces from sweep k to k + 1: means over 5 ms of what the motion gives."""
    t = 0.1 * k + 0.005 * (np.arange(20) + 0.5)
    force = np.array([exp_so3(np.array([0, 0, -0.3 * s])) @ [0.5, 0, G] for s in t])
    return np.column_stack([np.full(20, 0.005), np.tile([0, 0, 0.3], (20, 1)), force])


def begun(offset_m, offset_rad, *, sigma_m, sigma_rad):
    state = State.at_rest(G)
    state.R[:], state.p[:] = exp_so3(offset_rad), offset_m
    sigmas = np.repeat([sigma_rad, sigma_m, 0.05, 1e-3, 1e-2, 1e-3], 3)
    return Filter(state, np.diag(sigmas**2), 0.0)


def known_room(rng):
    known = PointMap(LioConfig().map)
    known.insert(room(rng, 40000).astype(np.float32), np.eye(3), np.zeros(3))
    return known


def follow(sweeps, start, *, config=None):
    rng = np.random.default_rng(5)
    window = JointWindow(Course(start), known_room(rng), config or JointWindowConfig(), LioConfig(), RIG)
    for k in range(1, sweeps + 1):
        window.predict(imu_of(k - 1))
        R, p, _ = true_motion(k)
        window.add_points(((room(rng) - p) @ R).astype(np.float32))
    return window


def off(window, k):
    R, p, _ = true_motion(k)
    return np.linalg.norm(window.filter.state.p - p), np.linalg.norm(log_so3(R.T @ window.filter.state.R))


def test_exact_sweeps_lead_from_a_wrong_start_to_the_truth():
    """0.3 m and 3 degrees off, without noise: a millimetre after eight sweeps."""
    axis = np.array([1.0, -1.0, 1.0]) / np.sqrt(3)
    start = begun(0.3 * axis, np.radians(3) * axis[::-1], sigma_m=0.3, sigma_rad=np.radians(3))
    window = follow(8, start)
    m, rad = off(window, 8)
    assert m < 1e-3
    assert rad < 2e-4
    assert np.linalg.norm(window.filter.state.v - true_motion(8)[2]) < 5e-3


def test_one_sweep_says_what_the_filter_hears_of_it():
    """Same start, same map, same sweep: the same state, and as sure of it."""
    start = begun(np.array([0.01, -0.01, 0.005]), np.array([2e-3, -1e-3, 2e-3]), sigma_m=0.02, sigma_rad=5e-3)
    alone = Filter(start.state.copy(), start.P.copy(), 0.0)
    window = follow(1, start)
    rng = np.random.default_rng(5)
    known = known_room(rng)
    R, p, _ = true_motion(1)
    few = Thinner().centroids(((room(rng) - p) @ R).astype(np.float32), LioConfig().thin_m, at_most=LioConfig().points)
    alone.predict(imu_of(0), DENSITIES)
    scan = PlaneRegistration(known, few, LioConfig().plane)
    alone.update(scan.linearise, iterations=10, at_least=20)
    apart = window.filter.state.minus(alone.state)
    assert np.abs(apart[:3]).max() < 1e-5
    assert np.abs(apart[3:6]).max() < 1e-4
    np.testing.assert_allclose(window.filter.P.diagonal(), alone.P.diagonal(), rtol=0.02)


def test_the_map_never_holds_what_the_window_measures():
    """Of four sweeps of a window of three the first alone has gone into the map."""
    empty = PointMap(LioConfig().map)
    window = JointWindow(
        Course(begun(np.zeros(3), np.zeros(3), sigma_m=1e-3, sigma_rad=1e-3)),
        empty, JointWindowConfig(sweeps=3), LioConfig(), RIG,
    )  # fmt: skip
    rng, held = np.random.default_rng(6), []
    for k in range(1, 6):
        window.predict(imu_of(k - 1))
        R, p, _ = true_motion(k)
        window.add_points(((room(rng) - p) @ R).astype(np.float32))
        held.append(empty.voxels > 0)
    assert held == [False, False, False, True, True]
    assert off(window, 5)[0] < 0.01  # planes that the window alone has seen hold it


def test_the_same_input_gives_the_same_bytes():
    start = begun(np.full(3, 0.1), np.full(3, 0.01), sigma_m=0.1, sigma_rad=0.02)
    first, second = (follow(5, Filter(start.state.copy(), start.P.copy(), 0.0)) for _ in range(2))
    assert first.filter.state.x.tobytes() == second.filter.state.x.tobytes()
    assert first.covariance.tobytes() == second.covariance.tobytes()


def after_a_gap(*, rescue):
    """Errors in m after each of 15 sweeps, of a filter that a gap of the IMU has left 0.5 m and 17 degrees off."""
    axis = np.array([0.6, -0.8, 0.0])
    start = begun(0.5 * axis, 0.3 * axis[::-1], sigma_m=0.5, sigma_rad=0.3)
    config = LioConfig(standing=StandingConfig(enabled=False), rescue=RescueConfig(enabled=rescue))
    rng, lio = np.random.default_rng(7), Lio(start, config, RIG)
    lio.map, errors = known_room(rng), []
    for k in range(1, 16):
        lio.predict(imu_of(k - 1), gap_s=0.3 if k == 1 else 0.0)
        R, p, _ = true_motion(k)
        lio.update_lidar(((room(rng) - p) @ R).astype(np.float32), np.zeros(9000, np.float32))
        errors.append(np.linalg.norm(lio.filter.state.p - p))
    return errors


def test_several_sweeps_find_back_where_one_does_not():
    assert after_a_gap(rescue=False)[-1] > 1.0
    errors = after_a_gap(rescue=True)
    assert max(errors[-8:]) < 5e-3


def test_a_rescue_survives_what_it_cannot_use():
    """Sweeps without a return, and a covariance that has no inverse: not found, and ready for the next one."""
    rng, config = np.random.default_rng(8), LioConfig()
    nothing = np.empty((0, 3), np.float32), np.empty(0, np.float32)
    course = Course(begun(np.zeros(3), np.zeros(3), sigma_m=0.1, sigma_rad=0.1))
    rescue = Rescue(config, RIG)
    assert rescue.look(course, known_room(rng), *nothing) is None
    course.filter.P = np.zeros((18, 18))
    rescue.end()
    assert rescue.look(course, known_room(rng), *nothing) is None


def test_a_rescue_changes_nothing_while_sweeps_agree():
    """The same flight to the bit with it and without."""
    events = record(4.0)[1]
    configs = [EstimationConfig(lio=LioConfig(rescue=RescueConfig(enabled=on))) for on in (True, False)]
    told = [run(events, config=c, nodes=[LioNode(c, Rig())])[topics.LIO_STATE.name] for c in configs]
    assert len(told[0]) > 10
    assert [s.covariance.tobytes() for s in told[0]] == [s.covariance.tobytes() for s in told[1]]
    assert [s.p_odom.tobytes() for s in told[0]] == [s.p_odom.tobytes() for s in told[1]]


def test_the_bench_runs_a_window_beside_the_filter():
    """A flight through a forest: it goes along with the filter while the vehicle stands, and is as right in flight."""
    events = record(8.0)[1]
    heard = [(round(t * 1e9), TOPIC[type(m)], m) for t, m in events]
    found = feed(heard, EstimationConfig(), Rig(), with_graph=False, with_joint=True)
    assert [s.stamp_ns for s in found.joint] == [s.stamp_ns for s in found.states if s.source == "lidar"]
    assert found.cpu_s["JointWindowNode"] > 0
    for joint, alone in zip(found.joint, (s for s in found.states if s.source == "lidar"), strict=True):
        assert np.linalg.norm(joint.p_odom - alone.p_odom) < 0.03
