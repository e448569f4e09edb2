"""Loops are found where there are some, closures are right, and the corrected way is the true one."""

import numpy as np
import pytest

from companion.core.geometry import exp_so3, rotation_from_quaternion
from companion.estimation.places.loops import LoopConfig, LoopFinder
from companion.estimation.places.submap import rise
from companion.estimation.places.verify import VerifyConfig, align
from tests.unit.estimation.synthetic import cast

SPACING_M = 0.4  # between scans


def turn_z(yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def forest(seed, path, n=600):
    rng = np.random.default_rng(seed)
    trunks = np.column_stack([rng.uniform(-45, 45, (n, 2)), rng.uniform(0.1, 0.3, n)])
    away = np.linalg.norm(trunks[:, None, :2] - path[None, ::5, :2], axis=2).min(axis=1) > 1.2
    return trunks[away]


def beams(count=6000):
    golden = np.pi * (3 - np.sqrt(5)) * np.arange(count)
    elevation = np.radians(-35 + 60 * (np.arange(count) / count))
    return np.stack([np.cos(elevation) * np.cos(golden), np.cos(elevation) * np.sin(golden), np.sin(elevation)], 1)


def circle(laps, radius_m=14.0):
    """True poses (R, p) along a circle, flown facing ahead."""
    angle = np.arange(0, 2 * np.pi * laps, SPACING_M / radius_m)
    p = np.stack([radius_m * np.cos(angle), radius_m * np.sin(angle), 2.0 + 0.2 * np.sin(5 * angle)], axis=1)
    return [turn_z(a + np.pi / 2) for a in angle], p


def drifting(R_true, p_true, rng, *, yaw_per_m=6e-4, scale=1.004, climb_per_m=2e-3):
    """Odometry with the errors of one: from the true start on, each step a little wrong."""
    R, p = [R_true[0]], [p_true[0]]
    for k in range(len(p_true) - 1):
        step = R_true[k].T @ (p_true[k + 1] - p_true[k])
        way = np.linalg.norm(step)
        p.append(p[-1] + R[-1] @ (scale * step) + [0, 0, climb_per_m * way])
        R.append(R[-1] @ R_true[k].T @ R_true[k + 1] @ exp_so3(np.array([0, 0, yaw_per_m * way])))
    return R, np.array(p) + np.cumsum(rng.normal(0, 1e-3, (len(p), 3)), axis=0)


def scans(R_true, p_true, world, rng):
    """Points (N, 3) float32 in the body, one per pose."""
    dirs = beams()
    for R, p in zip(R_true, p_true, strict=True):
        spun = dirs @ turn_z(rng.uniform(0, 6.3)).T
        reach = cast(np.broadcast_to(p, spun.shape).copy(), spun @ R.T, world)
        seen = (reach < 40) & (reach > 0.4)
        yield (spun[seen] * (reach[seen] + rng.normal(0, 0.02, seen.sum()))[:, None]).astype(np.float32)


def flown(R_true, p_true, seed, config=None, share=None):
    """(finder, odometry); `share`: odometry says that position and yaw drift by so much per metre, in m and 0.1 rad."""
    rng = np.random.default_rng(seed)
    R, p = drifting(R_true, p_true, rng)
    finder = LoopFinder(config or LoopConfig())
    for k, points in enumerate(scans(R_true, p_true, forest(seed, p_true), rng)):
        said = None if share is None else ((share * SPACING_M * k) ** 2, (0.1 * share * SPACING_M * k) ** 2)
        finder.add(k, points, R[k], p[k], said)
    return finder, p


@pytest.fixture(scope="module")
def lapped():
    R_true, p_true = circle(1.6)
    finder, p = flown(R_true, p_true, seed=3)
    return finder, finder.corrected(), p, R_true, p_true


def test_every_closure_is_right(lapped):
    finder, _, _, R_true, p_true = lapped
    assert len(finder.closures) >= 6
    for closure in finder.closures:
        a, b = finder.stamps_ns[closure.earlier], finder.stamps_ns[closure.later]
        p = R_true[a].T @ (p_true[b] - p_true[a])
        R = R_true[a].T @ R_true[b]
        assert np.linalg.norm(closure.p - p) < 0.08
        assert np.linalg.norm(closure.R - R) < 0.02
        assert closure.trunks >= 8


def test_corrected_way_is_the_true_one_and_the_newest_pose_stays(lapped):
    finder, poses, p, R_true, p_true = lapped
    scan = np.array(finder.stamps_ns)
    last = scan[-1]
    assert poses[-1, :3] == pytest.approx(p[last], abs=1e-6)
    R_last = rotation_from_quaternion(poses[-1, 3:])
    seen = (poses[:, :3] - poses[-1, :3]) @ R_last  # from the newest pose
    truth = (p_true[scan] - p_true[last]) @ R_true[last]
    drifted = (p[scan] - p[last]) @ R_last
    error, before = (np.linalg.norm(x - truth, axis=1) for x in (seen, drifted))
    assert np.sqrt(np.mean(before**2)) > 0.5
    assert np.sqrt(np.mean(error**2)) < 0.12
    assert np.sqrt(np.mean(error**2)) < 0.2 * np.sqrt(np.mean(before**2))


def test_odometry_that_knows_its_drift_is_corrected_as_well():
    R_true, p_true = circle(1.6)
    finder, _ = flown(R_true, p_true, seed=3, share=6e-3)
    poses, scan = finder.corrected(), np.array(finder.stamps_ns)
    assert len(finder.closures) >= 6 and finder.refused == 0
    R_last = rotation_from_quaternion(poses[-1, 3:])
    seen = (poses[:, :3] - poses[-1, :3]) @ R_last
    truth = (p_true[scan] - p_true[scan[-1]]) @ R_true[scan[-1]]
    assert np.sqrt(np.mean(np.linalg.norm(seen - truth, axis=1) ** 2)) < 0.12


def test_a_closure_that_odometry_knows_to_be_wrong_moves_nothing():
    """It drifts by far more than it says here, so that true closures look like wrong ones."""
    R_true, p_true = circle(1.3)
    finder, p = flown(R_true, p_true, seed=3, share=1e-5)
    assert finder.refused >= 2
    for closure in finder.closures:
        a, b = (finder.keyframe_p_odom[k] for k in (closure.earlier, closure.later))
        chain = finder.keyframe_R_odom(closure.earlier).T @ (b - a)
        assert np.linalg.norm(closure.p - chain) < 0.4
    assert finder.corrected()[:, :3] == pytest.approx(p[finder.stamps_ns], abs=0.15)


def test_where_there_is_no_loop_none_is_found():
    s = np.arange(0, 70, SPACING_M)
    p = np.stack([s - 35, 3 * np.sin(s / 9), 2 + 0 * s], axis=1)
    finder, odometry = flown([np.eye(3)] * len(p), p, seed=5)
    assert finder.closures == []
    poses = finder.corrected()
    assert poses[:, :3] == pytest.approx(odometry[finder.stamps_ns], abs=1e-6)


def test_a_second_lap_that_shows_another_forest_closes_nothing():
    """What stands at the place of the first lap is not what stood there: nothing may be forced.

    Right after the seam a submap still holds scans of the first forest: what closes by them must be right.
    """
    R_true, p_true = circle(1.6)
    rng = np.random.default_rng(0)
    finder = LoopFinder(LoopConfig())
    half = round(2 * np.pi * 14.0 / SPACING_M)
    first, second = forest(1, p_true), forest(2, p_true)
    for k in range(len(p_true)):
        world = first if k < half else second
        points = next(scans(R_true[k : k + 1], p_true[k : k + 1], world, rng))
        finder.add(k, points, R_true[k], p_true[k])
    for closure in finder.closures:
        a, b = finder.stamps_ns[closure.earlier], finder.stamps_ns[closure.later]
        assert (b - half) * SPACING_M < 0.5 * finder.config.window_m
        assert np.linalg.norm(closure.p - R_true[a].T @ (p_true[b] - p_true[a])) < 0.05
        assert np.linalg.norm(closure.R - R_true[a].T @ R_true[b]) < 0.01


def test_same_scans_give_the_same_bytes():
    R_true, p_true = circle(1.15)
    first, second = (flown(R_true, p_true, seed=4)[0] for _ in range(2))
    assert len(first.closures) >= 1
    assert first.corrected().tobytes() == second.corrected().tobytes()


def test_clouds_align_from_a_rough_guess_and_strangers_do_not():
    _, p_true = circle(0.2)
    rng = np.random.default_rng(1)
    world, other = forest(7, p_true), forest(8, p_true)
    several = [np.eye(3)] * 4, [p_true[0]] * 4
    known, seen, strange = (np.concatenate(list(scans(*several, w, rng))) for w in (world, world, other))
    yaw, shift = 0.7, np.array([0.5, -0.3, 0.1])
    moved = ((seen - shift) @ turn_z(yaw)).astype(np.float32)
    guess = (turn_z(yaw + 0.02), shift + np.array([0.15, 0.1, -0.1]))
    config = VerifyConfig(thin_m=0.2, least_near=0.5)
    found = align(known, moved, guess, config)
    assert found.p == pytest.approx(shift, abs=0.03)
    assert np.linalg.norm(found.R - turn_z(yaw)) < 0.01
    assert align(known, strange, (np.eye(3), np.zeros(3)), config) is None


@pytest.mark.parametrize("rise_m", [-2.3, 0.0, 1.7])
def test_the_ground_says_how_much_higher_a_cloud_lies(rise_m):
    """Two sweeps of one slope with trunks, drawn anew: trunks and what one of them missed do not matter."""
    rng = np.random.default_rng(3)

    def cloud(n):
        xy = rng.uniform(-12, 12, (n, 2))
        ground = np.column_stack([xy, 0.05 * xy[:, 0] + rng.normal(0, 0.02, n)])
        at = rng.integers(-10, 10, (n // 4, 2)) + 0.5
        return np.vstack([ground, np.column_stack([at, rng.uniform(0, 4, n // 4)])]).astype(np.float32)

    known, placed = cloud(6000), cloud(4000) - np.array([0, 0, rise_m], np.float32)
    assert rise(known, placed, cell_m=1.0) == pytest.approx(rise_m, abs=0.05)
    assert rise(known, placed + np.array([500, 0, 0], np.float32), cell_m=1.0) == 0.0  # nowhere the same
