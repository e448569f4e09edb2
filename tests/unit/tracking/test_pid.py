"""Laws of the PID."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.tracking.pid import Pid, PidConfig

errors = st.lists(st.tuples(*[st.floats(-3, 3)] * 6), min_size=1, max_size=60)
REST = np.zeros(3)


def test_terms_by_hand():
    pid = Pid(PidConfig(kp_per_s=2.0, ki_per_s2=0.5, kd=0.1, integral_limit_m_s=9.0, output_limit_m_s=99.0))
    e0, e1, rate = np.array([0.1, 0.0, -0.2]), np.array([0.2, 0.1, -0.2]), np.array([1.0, -2.0, 0.5])
    assert np.allclose(pid.step(e0, measured_rate=REST, dt_s=0.1), 2.0 * e0 + 0.05 * e0)
    assert np.allclose(pid.step(e1, measured_rate=rate, dt_s=0.1), 2.0 * e1 + 0.05 * (e0 + e1) - 0.1 * rate)


@given(errors)
def test_output_and_integral_stay_bounded(rows):
    config = PidConfig()
    pid = Pid(config)
    for row in rows:
        output = pid.step(np.array(row[:3]), measured_rate=np.array(row[3:]), dt_s=0.02)
        assert np.linalg.norm(output) <= config.output_limit_m_s + 1e-12
        assert np.linalg.norm(pid.integral) <= config.integral_limit_m_s + 1e-12


@given(st.tuples(*[st.floats(-0.1, 0.1)] * 3), st.floats(0.0, 5.0))
def test_a_step_of_the_reference_gives_no_derivative_kick(step, kd):
    """What comes out after a jump of the reference does not depend on the derivative gain."""
    gains = {"kp_per_s": 1.0, "ki_per_s2": 0.0, "output_limit_m_s": 99.0}
    with_d, without = Pid(PidConfig(kd=kd, **gains)), Pid(PidConfig(kd=0.0, **gains))
    for pid in (with_d, without):
        pid.step(REST, measured_rate=REST, dt_s=0.02)
    outputs = [pid.step(np.array(step), measured_rate=REST, dt_s=0.02) for pid in (with_d, without)]
    assert np.array_equal(*outputs)


def test_it_does_not_wind_up_against_the_limit():
    pid = Pid(PidConfig(kp_per_s=1.0, ki_per_s2=1.0, integral_limit_m_s=5.0, output_limit_m_s=0.5))
    for _ in range(500):
        pid.step(np.array([3.0, 0.0, 0.0]), measured_rate=REST, dt_s=0.02)
    assert np.allclose(pid.integral, 0.0)
    assert pid.step(np.array([-0.1, 0.0, 0.0]), measured_rate=REST, dt_s=0.02)[0] < 0.0  # turns at once


def test_a_constant_push_is_taken_over_by_the_integral():
    pid, x = Pid(PidConfig(kp_per_s=1.0, ki_per_s2=0.5, kd=0.0)), 0.0
    for _ in range(3000):
        x += (pid.step(np.array([-x, 0.0, 0.0]), measured_rate=REST, dt_s=0.02)[0] + 0.2) * 0.02
    assert x == pytest.approx(0.0, abs=1e-3) and pid.integral[0] == pytest.approx(-0.2, abs=1e-3)


def test_reset_forgets():
    used, fresh = Pid(PidConfig()), Pid(PidConfig())
    used.step(np.ones(3) * 0.1, measured_rate=REST, dt_s=0.02)
    used.reset()
    outputs = [pid.step(np.ones(3) * 0.1, measured_rate=REST, dt_s=0.02) for pid in (used, fresh)]
    assert np.array_equal(*outputs)
