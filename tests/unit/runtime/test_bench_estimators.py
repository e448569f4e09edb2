"""The bench's figures by their definition, and what it asks of its arguments."""

from pathlib import Path

import numpy as np
import pytest

from companion.cli.bench_estimators import gtsam_data
from companion.core.errors import InputError
from companion.core.geometry import exp_so3, quaternion_from_rotation
from companion.runtime.bench import estimators_flights as flights
from companion.runtime.bench import estimators_real as real
from companion.runtime.bench.estimators_warehouse import Trace, figures
from companion.runtime.inertial_recordings import kitti_drive, rtk_flights

SHARED = Path(__file__).resolve().parents[3].parent / "shared/data"


def test_figures_of_a_flight_do_not_depend_on_where_odom_began():
    """An estimate in a tilted, turned, shifted frame with errors of its own covariance: NEES is 1, ATE the noise."""
    rng, sigma = np.random.default_rng(1), 0.02
    stamps = np.arange(2000) * 100_000_000
    truth = np.cumsum(rng.normal(0.1, 0.1, (2000, 3)), axis=0)
    v = rng.normal(size=(2000, 3))
    R_world_odom, R_world_body = exp_so3(np.array([0.01, -0.02, 1.0])), exp_so3(np.array([0.1, 0.2, -0.5]))
    q_odom_body = quaternion_from_rotation(R_world_odom.T @ R_world_body)
    flight = flights.Flight(
        truth_ns=list(stamps), truth_p=list(truth), truth_v=list(v),
        truth_q=[quaternion_from_rotation(R_world_body)] * 2000,
        views=[(0, np.empty((0, 3)), np.zeros(3), q_odom_body)],
    )  # fmt: skip
    noise = rng.normal(0.0, sigma, (2000, 3)) * (np.arange(2000) > 0)[:, None]
    run = flights.Run(
        list(stamps), list((truth - truth[0]) @ R_world_odom + noise), list(v @ R_world_odom + noise),
        [sigma**2 * np.eye(3)] * 2000, [sigma**2 * np.eye(3)] * 2000, cpu_s=1.0,
    )  # fmt: skip
    found = flights._figures(run, flight)
    assert found["NEES per dof, position"] == pytest.approx(1.0, abs=0.1)
    assert found["NEES per dof, velocity"] == pytest.approx(1.0, abs=0.1)
    assert found["ATE, m"] == pytest.approx(np.sqrt(3) * sigma, rel=0.05)
    assert found["CPU ms per scan"] == pytest.approx(0.5)


def test_a_drive_counts_as_found_when_it_stays_right():
    trace = Trace(carried=2)
    for error in (0.1, 0.1, 9.0, 0.2, 9.0, 0.3, 0.2):
        trace.note(np.zeros(4), np.array([error, 0, 0, 0]), np.diag([1.0, 1, 1, 1]), True, 300, 0.001)
    found = figures([trace], "kidnapped")
    assert found["found after, median s"] == pytest.approx(0.6)
    assert found["share of time sure and wrong"] == pytest.approx(0.4)
    assert found["right at the end"] == 1.0
    assert found["error once found, rms m"] == pytest.approx(np.sqrt((0.09 + 0.04) / 2))


def test_kitti_through_gaps():
    """gtsam's own drive: a gap of 1 s costs 0.15 m, one of 5 s 1.5 m (medians), and sigma covers 9 of 10."""
    (row,) = real.bench_fixes(real.KITTI, [kitti_drive(gtsam_data())], ["ekf"])
    assert row.figures["median error after 1 s, m"] < 0.15
    assert row.figures["median error after 5 s, m"] < 1.5
    assert row.figures["covered by 3 sigma"] > 0.9


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the shared recordings")
def test_rtk_flights_are_bridged():
    """A flight whose clocks agree within 0.1 s: start in motion, then 1 s without RTK costs 0.3 m, 5 s 2.5 m."""
    files = [f for f in rtk_flights(SHARED / "imu_rtk_quadrotor_ansfl") if f.stem == "Vertical_path_27"]
    (flight,) = map(real.rtk_flight, files)
    (row,) = real.bench_fixes(real.RTK, [flight], ["ekf"])
    assert row.figures["median error after 1 s, m"] < 0.3
    assert row.figures["median error after 5 s, m"] < 2.5


def test_bad_arguments_are_named():
    from companion.cli.bench_estimators import _valid

    with pytest.raises(InputError, match="--study"):
        _valid(["nothing"], ("kitti",), "--study")
    with pytest.raises(InputError, match="--data"):
        from companion.cli.bench_estimators import _folder

        _folder(None)
