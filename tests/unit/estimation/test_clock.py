"""A clock that is set in flight, and an IMU that falls silent: survived, or told."""

import numpy as np
import pytest

from companion.core import topics
from companion.core.messages import ImuSample, LidarScan
from companion.runtime.bench.estimation_faults import fault
from tests.unit.estimation.synthetic import record
from tests.unit.estimation.test_flight import run

TOPIC = {ImuSample: topics.IMU, LidarScan: topics.LIDAR}
AT_S = 6.0


@pytest.fixture(scope="module")
def events():
    return record(10.0)[1]


@pytest.fixture(scope="module")
def usual(events):
    """Stamps in s, and positions, of odometry without a fault."""
    odometry = run(events)[topics.ODOMETRY.name]
    return np.array([o.stamp_ns for o in odometry]) * 1e-9, np.array([o.p_odom for o in odometry])


@pytest.mark.parametrize("what", ["clock_jump_0.3", "clock_jump_-0.1", "clock_jump_1.5", "imu_gap_0.1", "imu_gap_1.5"])
def test_short_faults_are_survived(events, usual, what):
    """Two seconds later it is where it is, and says so."""
    off, odometry = errors(events, usual, what)
    assert odometry[-1].health == "nominal", odometry[-1].health_reason
    assert off[-50:].max() < 0.03
    assert any(o.health != "nominal" for o in odometry)


@pytest.mark.parametrize("what", ["clock_jump_-3", "clock_jump_3", "imu_gap_2.5"])
def test_what_is_not_survived_is_told(events, usual, what):
    """Whenever it is farther off than 0.5 m, odometry says that it is lost or that it may be as far off."""
    off, odometry = errors(events, usual, what)
    sigma = np.array([np.sqrt(o.pose_variance[3:].max()) for o in odometry])
    told = np.array([o.health == "lost" for o in odometry]) | (3.0 * sigma > off)
    assert told[off > 0.5].all()


def errors(events, usual, what):
    """How far odometry is from what it is without the fault, m, from then on, and odometry itself."""
    spoil = fault(f"{what}@{AT_S}")
    spoilt = [(t, message) for t, m in events if (message := spoil(TOPIC[type(m)], m)) is not None]
    jump_s = float(what.rpartition("_")[2]) if what.startswith("clock") else 0.0
    heard = [o for o in run(spoilt)[topics.ODOMETRY.name] if o.stamp_ns * 1e-9 >= AT_S + max(jump_s, 0.0)]
    t = np.array([o.stamp_ns for o in heard]) * 1e-9 - jump_s
    p = np.column_stack([np.interp(t, usual[0], usual[1][:, k]) for k in range(3)])
    return np.linalg.norm(np.array([o.p_odom for o in heard]) - p, axis=1), heard
