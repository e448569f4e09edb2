"""Laws of the PID."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.tracking.pid import Pid, PidConfig

errors = st.lists(st.tuples(*[st.floats(-3, 3)] * 3), min_size=1, max_size=60)


def test_terms_by_hand():
    pid = Pid(PidConfig(kp_per_s=2.0, ki_per_s2=0.5, kd=0.1, integral_limit_m_s=9.0, output_limit_m_s=99.0))
    e0, e1 = np.array([0.1, 0.0, -0.2]), np.array([0.2, 0.1, -0.2])
    assert np.allclose(pid.step(e0, dt_s=0.1), 2.0 * e0 + 0.05 * e0)
    assert np.allclose(pid.step(e1, dt_s=0.1), 2.0 * e1 + 0.05 * (e0 + e1) + (e1 - e0))


@given(errors)
def test_output_and_integral_stay_bounded(rows):
    config = PidConfig()
    pid = Pid(config)
    for row in rows:
        output = pid.step(np.array(row), dt_s=0.02)
        assert np.linalg.norm(output) <= config.output_limit_m_s + 1e-12
        assert np.linalg.norm(pid.integral) <= config.integral_limit_m_s + 1e-12


def test_it_does_not_wind_up_against_the_limit():
    pid = Pid(PidConfig(kp_per_s=1.0, ki_per_s2=1.0, integral_limit_m_s=5.0, output_limit_m_s=0.5))
    for _ in range(500):
        pid.step(np.array([3.0, 0.0, 0.0]), dt_s=0.02)
    assert np.allclose(pid.integral, 0.0)
    assert pid.step(np.array([-0.1, 0.0, 0.0]), dt_s=0.02)[0] < 0.0  # turns at once


def test_a_constant_push_is_taken_over_by_the_integral():
    pid, x = Pid(PidConfig(kp_per_s=1.0, ki_per_s2=0.5)), 0.0
    for _ in range(3000):
        x += (pid.step(np.array([-x, 0.0, 0.0]), dt_s=0.02)[0] + 0.2) * 0.02
    assert x == pytest.approx(0.0, abs=1e-3) and pid.integral[0] == pytest.approx(-0.2, abs=1e-3)


def test_reset_forgets():
    used, fresh = Pid(PidConfig(kd=0.1)), Pid(PidConfig(kd=0.1))
    used.step(np.ones(3), dt_s=0.02)
    used.reset()
    assert np.array_equal(used.step(np.ones(3) * 0.1, dt_s=0.02), fresh.step(np.ones(3) * 0.1, dt_s=0.02))
