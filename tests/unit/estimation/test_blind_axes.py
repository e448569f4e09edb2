"""Blind axes: noise says nothing along them, not by way of the others either; what drifts there is said."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core.rig import Mount, Rig
from companion.estimation.blind_axes import BlindAxes, BlindAxesConfig, BlindDrift
from companion.estimation.lio import Lio, LioConfig
from companion.estimation.normal import Normal

KNOWN = np.diag([1e-6] * 3 + [1e-4] * 3)  # a pose known to a milliradian and a centimetre


def normal(H, g=None, R=None):
    return Normal(np.eye(3) if R is None else R, np.zeros(3), H, H @ np.ones(6) if g is None else g, 100, 100)


def leaning(rng, lean):
    """A plain seen: height, roll and pitch, along an axis that noise leans."""
    H = np.zeros((6, 6))
    for row in np.eye(6)[[0, 1, 5]]:
        seen = row + lean * rng.normal(size=6) * [0.1, 0.1, 0.1, 1.0, 1.0, 1.0]
        H += 1e5 * np.outer(seen, seen)
    return H


def test_what_noise_says_along_a_blind_axis_is_left_out():
    H = np.diag([1e6, 1e6, 1e6, 30.0, 4e4, 4e4])
    said = normal(H)
    soft = BlindAxes(BlindAxesConfig(lean=0.0)).soften(said, KNOWN)
    np.testing.assert_allclose(np.diag(soft.H)[[0, 1, 2, 4, 5]], np.diag(H)[[0, 1, 2, 4, 5]], rtol=1e-2)
    assert soft.H[3, 3] < 1e-3 * H[3, 3]
    np.testing.assert_allclose(soft.H, soft.H.T)
    assert soft.g[4] == pytest.approx(said.g[4], rel=1e-2)
    assert abs(soft.g[3]) < 1e-3 * said.g[3]


def test_where_nothing_is_blind_the_sweep_is_itself():
    said = normal(np.diag([1e6, 1e6, 1e6, 2e4, 4e4, 4e4]))
    assert BlindAxes(BlindAxesConfig()).soften(said, KNOWN) is said


def test_with_tilt_and_height_known_many_leaning_planes_do_not_say_where_on_the_plain_one_is():
    """Of 200 sweeps; each by itself is softened, too, but leans anew, and their sum claims centimetres."""
    rng = np.random.default_rng(4)
    kept, alone = np.linalg.inv(KNOWN), np.linalg.inv(KNOWN)
    kept[3, 3] = kept[4, 4] = alone[3, 3] = alone[4, 4] = 1e-2  # 10 m
    axes = BlindAxes(BlindAxesConfig(lean=0.0))
    for _ in range(200):
        said = normal(leaning(rng, 0.01))
        kept += axes.soften(said, KNOWN).H
        alone += BlindAxes(BlindAxesConfig(lean=0.0)).soften(said, KNOWN).H
        axes.seen()
    of_kept, of_alone = (np.sqrt(np.linalg.inv(information)[3, 3]) for information in (kept, alone))
    assert of_alone < 0.1
    assert of_kept > 3.0 * of_alone


def test_what_is_not_known_along_the_blind_axes_blurs_the_others():
    said, config = normal(leaning(np.random.default_rng(1), 0.0)), BlindAxesConfig(lean=0.01)
    lost = KNOWN + np.diag([0, 0, 0, 50.0, 50.0, 0])  # 10 m in the plain
    clear, blurred = (BlindAxes(config).soften(said, P).H[5, 5] for P in (KNOWN, lost))
    assert clear == pytest.approx(1e5, rel=0.01)
    assert 1 / np.sqrt(blurred) == pytest.approx(0.01 * 10.0, rel=0.05)  # rad times m


def test_blind_ways_are_named_in_odom_whatever_the_heading():
    H = np.diag([1e6, 1e6, 1e6, 30.0, 4e4, 4e4])
    axes = BlindAxes(BlindAxesConfig())
    assert axes.shift is None
    for degrees in (0, 90, 200):
        axes.soften(normal(H, R=Rotation.from_euler("z", degrees, degrees=True).as_matrix()), KNOWN)
        axes.seen()
    np.testing.assert_allclose(axes.shift, np.diag([1.0, 0.0, 0.0]), atol=1e-6)
    axes.soften(normal(np.zeros((6, 6))), KNOWN)  # no plane in reach: it is as blind as before
    axes.seen()
    np.testing.assert_allclose(axes.shift, np.diag([1.0, 0.0, 0.0]), atol=1e-6)
    axes.soften(normal(np.diag([1e6, 1e6, 1e6, 2e4, 4e4, 4e4])), KNOWN)
    axes.seen()
    assert axes.shift is None


def test_what_the_imu_alone_says_drifts_by_a_steady_acceleration():
    drift = BlindDrift(BlindAxesConfig(drift_m_s2=0.04))
    for _ in range(100):
        drift.grow(np.diag([1.0, 0.0, 0.0]), 0.1)
    sigma = np.sqrt(np.diag(drift.covariance))
    np.testing.assert_allclose(sigma[3:9], [0.04 * 10**2 / 2, 0, 0, 0.04 * 10, 0, 0], atol=1e-9)
    assert not sigma[:3].any() and not sigma[9:].any()
    drift.reset()
    assert not drift.covariance.any()


def test_the_drift_stays_a_covariance_though_the_blind_way_turns():
    drift, rng = BlindDrift(BlindAxesConfig()), np.random.default_rng(2)
    for _ in range(300):
        way = Rotation.from_euler("z", 0.3 * rng.normal()).apply([1.0, 0.0, 0.0])
        drift.grow(np.outer(way, way), 0.1)
        assert np.linalg.eigvalsh(drift.C).min() > -1e-9 * np.trace(drift.C)


def over_a_plain(lio, seconds, accel_m_s2, rng):
    """Sweeps at 10 Hz of level ground 1 m below, which look the same wherever one is; sigma of position, m."""
    for _ in range(10 * seconds):
        lio.predict(np.tile([0.005, 0, 0, 0, accel_m_s2, 0, 9.81], (20, 1)))
        angle, away = rng.uniform(0, 2 * np.pi, 3000), rng.uniform(2, 8, 3000)
        ground = np.stack([away * np.cos(angle), away * np.sin(angle), -1 + rng.normal(0, 0.01, 3000)], axis=1)
        lio.update_lidar(ground.astype(np.float32), np.zeros(3000, np.float32))
    return np.sqrt(np.diag(lio.covariance)[3:6])


def test_without_a_camera_a_plain_makes_the_position_unsure_once_the_vehicle_moves():
    rng = np.random.default_rng(5)
    lio = Lio.at_rest(np.tile([0, 0, 0, 0, 0, 9.81], (200, 1)), LioConfig(), Rig(lidar=Mount()))
    assert over_a_plain(lio, 5, 0.0, rng).max() < 0.01
    x, y, z = over_a_plain(lio, 5, 0.5, rng)
    assert x > 0.4 and y > 0.4  # 0.04 m/s2 for 5 s, at least
    assert z < 0.02
