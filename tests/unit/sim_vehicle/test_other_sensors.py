"""Barometer, range finder and GPS: statistics against their figures."""

import math

import numpy as np
import pytest

from companion.core.geometry import exp_so3, quaternion_from_rotation
from companion.core.rig import Mount
from sim.sensors.baro import Baro, BaroConfig
from sim.sensors.gps import Gps, GpsConfig
from sim.sensors.range_finder import RangeFinder, RangeFinderConfig

SECOND = 1_000_000_000
LEVEL = np.array([1.0, 0, 0, 0])


def down_to_ground(p: np.ndarray, d: np.ndarray) -> float:
    return p[2] / -d[2] if d[2] < 0 else math.inf


def test_baro_noise_and_drift() -> None:
    calm = BaroConfig(drift_m=0.0)
    baro = Baro(calm, seed=1)
    errors = [baro.sample(k * SECOND // 20, 7.0).altitude_m - 7.0 for k in range(5000)]
    assert np.std(errors) == pytest.approx(calm.noise_m, rel=0.05)
    assert abs(np.mean(errors)) < 0.01
    quiet = BaroConfig(noise_m=0.0, drift_time_s=10.0)
    baro = Baro(quiet, seed=1)
    drift = np.array([baro.sample(k * SECOND, 0.0).altitude_m for k in range(20_000)])
    assert np.std(drift) == pytest.approx(quiet.drift_m, rel=0.1)
    correlation = drift[10:] @ drift[:-10] / (drift @ drift)
    assert correlation == pytest.approx(math.exp(-1), abs=0.05)
    assert abs(Baro(quiet, seed=1).sample(0, 0.0).altitude_m) == 0.0


def test_range_finder_measures_along_its_own_axis() -> None:
    exact = RangeFinderConfig(noise_m=0.0, noise_per_m=0.0, dropout=0.0)
    finder = RangeFinder(exact, Mount(xyz_m=(0.0, 0.0, -0.06)), seed=1)
    p = np.array([1.0, 2.0, 5.0])
    assert finder.sample(0, p, LEVEL, down_to_ground).range_m == pytest.approx(4.94)
    tilted = quaternion_from_rotation(exp_so3(np.array([0.3, 0.0, 0.0])))
    expected = (5.0 - 0.06 * math.cos(0.3)) / math.cos(0.3)
    assert finder.sample(0, p, tilted, down_to_ground).range_m == pytest.approx(expected)
    for height in (0.08, 30.0):
        assert math.isnan(finder.sample(0, np.array([0, 0, height]), LEVEL, down_to_ground).range_m)
    upside_down = np.array([0.0, 1.0, 0, 0])
    assert math.isnan(finder.sample(0, p, upside_down, down_to_ground).range_m)


def test_range_finder_noise_and_dropout() -> None:
    config = RangeFinderConfig(dropout=0.2)
    finder = RangeFinder(config, Mount(), seed=1)
    p = np.array([0.0, 0.0, 10.0])
    ranges = np.array([finder.sample(k, p, LEVEL, down_to_ground).range_m for k in range(5000)])
    assert np.mean(np.isnan(ranges)) == pytest.approx(0.2, abs=0.02)
    assert np.nanstd(ranges) == pytest.approx(math.hypot(0.02, 0.05), rel=0.05)


def test_gps_is_denied_by_default() -> None:
    gps = Gps(GpsConfig(), seed=1)
    assert all(gps.sample(k * SECOND, np.zeros(3), np.zeros(3)) is None for k in range(50))


@pytest.mark.parametrize(("canopy", "sigma"), [(0.0, math.hypot(0.8, 0.3)), (1.0, math.hypot(5.0, 0.3))])
def test_gps_errors_are_as_large_as_it_claims(canopy: float, sigma: float) -> None:
    config = GpsConfig(denied=False, multipath_time_s=2.0)
    gps = Gps(config, seed=1)
    p, v = np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 0.0])
    fixes = [gps.sample(k * SECOND, p, v, canopy=canopy) for k in range(8000)]
    good = [f for f in fixes if f is not None]
    assert len(good) / len(fixes) == pytest.approx(1.0 - 0.3 * canopy, abs=0.02)
    errors = np.array([f.p_world for f in good]) - p
    assert np.std(errors[:, :2]) == pytest.approx(sigma, rel=0.05)
    assert good[0].sigma_horizontal_m == pytest.approx(sigma)
    assert np.std(errors[:, 2]) == pytest.approx(good[0].sigma_vertical_m, rel=0.05)
    assert np.std(np.array([f.v_world for f in good]) - v) == pytest.approx(0.1, rel=0.05)


def test_gps_jump_shifts_the_fixes() -> None:
    config = GpsConfig(denied=False)
    a, b, zero = Gps(config, seed=1), Gps(config, seed=1), np.zeros(3)
    b.jump(np.array([30.0, 0.0, 0.0]))
    first, second = a.sample(0, zero, zero), b.sample(0, zero, zero)
    assert first is not None
    assert second is not None
    np.testing.assert_allclose(second.p_world - first.p_world, [30.0, 0.0, 0.0])
