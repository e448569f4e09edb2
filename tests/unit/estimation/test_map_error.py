"""The map leans: by how much, from what a sweep tells, and what becomes of it on the way."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core.messages import LidarScan
from companion.core.rig import Rig
from companion.core.topics import LIO_STATE
from companion.estimation.camera import CameraConfig
from companion.estimation.config import EstimationConfig
from companion.estimation.lio_node import LioNode
from companion.estimation.map_error import MapError, MapErrorConfig
from companion.estimation.normal import Normal
from companion.estimation.state import State
from tests.unit.estimation.synthetic import REST_S, record
from tests.unit.estimation.test_flight import run

TILT_RAD, HEIGHT_M = 0.002, 0.03  # what the sweep below tells
PLAIN = np.diag([TILT_RAD**-2, TILT_RAD**-2, 0.0, 0.0, 0.0, HEIGHT_M**-2])
AHEAD = Rotation.from_euler("z", 90, degrees=True).as_matrix()


def swept(H, R=None):
    R = np.eye(3) if R is None else R
    return Normal(R, np.zeros(3), H, np.zeros(6), 100, 100)


def sigmas(error):
    return np.sqrt(np.diag(error.C))


def test_a_map_laid_by_a_filter_walks_by_the_share_of_each_sweeps_noise():
    """The derivation, played through 4000 times: true tilt 0; measured is tilt against the map, which leans."""
    rng, sweeps, share, gain, noise = np.random.default_rng(1), 400, 0.02, 0.4, 0.003
    lean, tilt = np.zeros(4000), np.zeros(4000)
    for _ in range(sweeps):
        tilt += gain * (lean + noise * rng.normal(size=4000) - tilt)
        lean += share * (tilt - lean)
    model = MapError()
    for _ in range(sweeps):
        model.lean(swept(np.diag([noise**-2, noise**-2, 0, 0, 0, 1e4])), share, 1.0)
    assert lean.std() == pytest.approx(0.02 * np.sqrt(400) * noise, rel=0.1)
    assert sigmas(model)[0] == pytest.approx(lean.std(), rel=0.1)


def test_tilt_and_height_lean_by_what_a_sweep_tells_of_them_and_nothing_else_does():
    model = MapError()
    for _ in range(25):
        model.lean(swept(PLAIN), 0.1, 1.0)
    np.testing.assert_allclose(
        sigmas(model)[[0, 1, 5]], [0.1 * 5 * s for s in (TILT_RAD, TILT_RAD, HEIGHT_M)], rtol=1e-3
    )
    assert not sigmas(model)[2:5].any()


@pytest.mark.parametrize(("share", "factor", "times"), [(0.2, 1.0, 2.0), (0.1, 4.0, 2.0), (0.0, 1.0, 0.0)])
def test_twice_the_share_or_four_times_the_factor_is_twice_the_lean(share, factor, times):
    once, other = MapError(), MapError()
    once.lean(swept(PLAIN), 0.1, 1.0)
    other.lean(swept(PLAIN), share, factor)
    np.testing.assert_allclose(sigmas(other), times * sigmas(once), atol=1e-12)


def test_roll_and_pitch_are_those_of_odom_whatever_the_heading():
    H, model = PLAIN.copy(), MapError()
    H[0, 0] *= 100.0  # roll of the body, known ten times as well
    model.lean(swept(H, AHEAD), 0.1, 1.0)
    roll, pitch = sigmas(model)[:2]
    assert roll == pytest.approx(10.0 * pitch, rel=0.01)


def test_what_sweeps_hardly_see_is_not_laid_by_them():
    """Trunks and no ground: height has no part in it, though its own covariance is a kilometre."""
    H, model = np.diag([2.5e5, 2.5e5, 1e6, 1e4, 1e4, 1e-6]), MapError()
    model.lean(swept(H), 0.2, 1.0)
    assert sigmas(model)[5] < 1e-6
    np.testing.assert_allclose(sigmas(model)[:2], 0.2 * 0.002, rtol=1e-3)


def test_one_poor_sweep_among_good_ones_is_the_means_matter():
    """A filter takes little of it, so the map leans by ten per cent of information less, not by its own noise."""
    model, other = MapError(), MapError()
    for each in (model, other):
        for _ in range(50):
            each.lean(swept(PLAIN), 0.1, 1.0)
    before = model.C[0, 0]
    model.lean(swept(1e-4 * PLAIN), 0.1, 1.0)
    other.lean(swept(PLAIN), 0.1, 1.0)
    assert model.C[0, 0] - before == pytest.approx((other.C[0, 0] - before) / 0.9, rel=1e-3)


def test_a_lean_becomes_height_along_the_way_and_turns_the_velocity():
    model, state = MapError(), State.at_rest(9.8)
    model.move(np.zeros(3))
    model.C[1, 1] = 0.005**2  # about y
    model.move(np.array([20.0, 7.0, 0.0]))
    assert sigmas(model)[5] == pytest.approx(0.1)
    state.v[:] = [4.0, 0.0, 0.0]
    P = model.covariance(state)
    assert np.sqrt(P[8, 8]) == pytest.approx(0.02)
    assert P[1, 5] / np.sqrt(P[1, 1] * P[5, 5]) == pytest.approx(-1.0)  # nose down is lower ahead
    model.move(np.zeros(3))
    assert sigmas(model)[5] == pytest.approx(0.0, abs=1e-9)  # the way back undoes it


def test_a_height_over_the_ground_that_is_off_makes_the_way_off_by_as_much():
    """A camera 2.5 m above ground that it takes for 5 cm farther away measures 2 % too much."""
    model = MapError()
    model.move(np.zeros(3), 2.5)
    model.C[5, 5] = 0.05**2
    model.move(np.array([20.0, 0.0, 0.0]), 2.5)
    np.testing.assert_allclose(sigmas(model), [0, 0, 0, 0.4, 0, 0.05], atol=1e-12)
    assert model.C[3, 5] == pytest.approx(0.4 * 0.05)
    model.move(np.array([20.0, 10.0, 0.0]))  # sweeps hold the height over the ground: nothing is added
    assert sigmas(model)[4] == 0.0


def test_anchors_laid_without_a_lidar_take_roll_and_pitch_of_the_pose_maps_do_not():
    P, state = np.diag([1e-6, 4e-6, 9e-6] + [0.0] * 15), State.at_rest(9.8)
    of_anchors, of_map = MapError(), MapError()
    of_anchors.extend(state, P, 0.5, tilts=True)
    of_map.extend(state, P, 0.5)
    np.testing.assert_allclose(np.diag(of_anchors.C)[:3], [0.5e-6, 2e-6, 4.5e-6])
    np.testing.assert_allclose(np.diag(of_map.C)[:3], [0.0, 0.0, 4.5e-6])


def test_the_error_in_the_body_frame_is_that_of_odom_turned():
    model, state = MapError(), State.at_rest(9.8)
    state.R[:] = AHEAD
    model.C[0, 0] = 0.003**2
    np.testing.assert_allclose(np.sqrt(np.diag(model.covariance(state))[:3]), [0.0, 0.003, 0.0], atol=1e-12)


def test_it_stays_a_covariance():
    model, rng, p = MapError(), np.random.default_rng(3), np.zeros(3)
    for _ in range(300):
        A = rng.normal(size=(6, 6)) * [30, 30, 30, 10, 10, 10]
        p = p + rng.normal(size=3)
        model.move(p)
        model.lean(swept(A @ A.T, Rotation.random(random_state=rng).as_matrix()), rng.uniform(0, 0.3), 1.0)
        assert np.linalg.eigvalsh(model.C).min() > -1e-9 * np.trace(model.C)


def test_by_default_it_is_as_derived():
    assert MapErrorConfig().lean == 1.0


@pytest.fixture(scope="module", params=["tracks", "direct"])
def over_a_plain(request):
    """Truth and states of a flight over bare ground that the LiDAR sees to 8 m."""
    config = EstimationConfig(camera=CameraConfig(method=request.param))
    truth, events = record(14.0, camera=True, forest=False, max_range=8.0)
    return truth, run(events, config=config, nodes=[LioNode(config, Rig())])[LIO_STATE.name]


def off_and_variance(truth, states, from_s):
    """Errors of position and their variances, (N, 3), in odom, whose first attitude is right by definition."""
    late = [s for s in states if s.stamp_ns * 1e-9 > from_s]
    R, p = truth.pose(np.array([s.stamp_ns for s in [states[0], *late]]) * 1e-9)
    begun = Rotation.from_quat(states[0].q_odom_body, scalar_first=True) * R[0].inv()
    variance = np.array([np.diag(s.covariance)[3:6] for s in late])
    return np.array([s.p_odom for s in late]) - begun.apply(p[1:] - p[0]), variance


def test_height_over_a_plain_is_within_what_is_said(over_a_plain):
    off, variance = off_and_variance(*over_a_plain, REST_S + 3.0)
    assert np.mean(off[:, 2] ** 2 / variance[:, 2]) < 2.0
    assert (np.abs(off[:, 2]) < 3.0 * np.sqrt(variance[:, 2])).mean() > 0.95


@pytest.mark.parametrize("method", ["tracks", "direct"])
def test_the_way_by_camera_alone_is_within_what_is_said(method):
    """Six seconds without a sweep, in which the vehicle goes 17 m; it is known to better than 2 % of that."""
    config = EstimationConfig(camera=CameraConfig(method=method))
    truth, events = record(13.0, camera=True)
    heard = [(at, m) for at, m in events if not (isinstance(m, LidarScan) and at > 7.0)]
    states = run(heard, config=config, nodes=[LioNode(config, Rig())])[LIO_STATE.name]
    off, variance = off_and_variance(truth, states, 7.2)
    assert np.mean(off**2 / variance) < 3.0
    assert (np.abs(off) < 3.0 * np.sqrt(variance)).all()
    assert np.linalg.norm(off[-1]) < 0.34
