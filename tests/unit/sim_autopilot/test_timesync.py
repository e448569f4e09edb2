"""The double-exponential filter: converges on the offset, follows skew, survives outliers, resets."""

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.timesync import WINDOW, TimeSync

MS = 1_000_000


def exchange(sync, k, offset_ns, *, delay_ns=2 * MS, jitter_ns=0):
    """Request k at 10 Hz; the companion's clock is ours minus the offset."""
    sent = k * 100 * MS
    sync.answer(sent + 2 * delay_ns, theirs_ns=sent + delay_ns + jitter_ns - offset_ns, ours_ns=sent)


def test_arrival_time_until_converged_then_the_offset():
    sync, offset, rng = TimeSync(), 7_250_000_000, np.random.default_rng(0)
    for k in range(WINDOW):
        assert sync.to_autopilot(5, 123) == 123
        exchange(sync, k, offset, jitter_ns=int(rng.normal(0, MS)))
    assert sync.converged
    assert sync.to_autopilot(1000 * MS, 0) == pytest.approx(1000 * MS + offset, abs=0.3 * MS)


def test_a_skew_of_50_ppm_is_followed():
    sync = TimeSync()
    for k in range(3000):
        exchange(sync, k, 10**9 + k * 5000)
    truth = 10**9 + 2999 * 5000
    assert sync.to_autopilot(0, 0) == pytest.approx(truth, abs=1 * MS)


def test_slow_round_trips_are_not_used():
    sync = TimeSync()
    exchange(sync, 0, 0, delay_ns=6 * MS)
    sync.answer(5, theirs_ns=1, ours_ns=10)  # an answer from the future
    assert sync.samples == 0


def test_a_few_outliers_are_dropped_and_a_jump_resets():
    sync = TimeSync()
    for k in range(WINDOW):
        exchange(sync, k, 10**9)
    for k in range(10):
        exchange(sync, k, 2 * 10**9)
    assert sync.converged
    assert sync.to_autopilot(0, 0) == pytest.approx(10**9, abs=MS)
    exchange(sync, 0, 2 * 10**9)
    assert not sync.converged
    assert sync.resets == 1


def test_over_the_link_it_asks_at_10_hz_and_answers_in_its_own_time(bench):
    b = bench()
    b.run(2.0)
    asked = [m for m in b.of("TIMESYNC") if m.tc1 == 0]
    assert 19 <= len(asked) <= 21
    assert b.autopilot.timesync.samples == len(asked)
    b.send(dialect.MAVLink_timesync_message(0, 42))
    b.run(0.0025)
    answer = [m for m in b.of("TIMESYNC") if m.tc1 != 0][-1]
    assert answer.ts1 == 42
    assert answer.tc1 == b.own_ns - 2_500_000
