"""The clock filter against simulated clocks."""

from __future__ import annotations

import numpy as np
import pytest

from companion.autopilot.codec import Timesync
from companion.autopilot.timesync import TimesyncConfig, TimesyncFilter, answer, request

PERIOD_NS = 100_000_000


def run(sync, rng, *, offset_ns, samples, start_ns=0, drift=0.0, jitter_s=1e-3):
    """Exchange requests at 10 Hz; travel times 0.3 ms + exponential each way; returns the time."""
    now = start_ns
    for _ in range(samples):
        asked = request(now)
        there, back = (int(3e5 + rng.exponential(jitter_s) * 1e9) for _ in range(2))
        autopilot_ns = now + there - offset_ns - round(drift * (now - start_ns))
        sync.learn(Timesync(tc1=autopilot_ns, ts1=asked.ts1), now + there + back)
        now += PERIOD_NS
    return now


@pytest.mark.parametrize("offset_ns", [0, 7_654_321_987, 1_755_000_000_123_456_789])
def test_converges_below_a_millisecond(offset_ns):
    sync = TimesyncFilter(TimesyncConfig())
    rng = np.random.default_rng(5)
    run(sync, rng, offset_ns=offset_ns, samples=800, start_ns=offset_ns)
    assert sync.converged
    assert abs(sync.offset_ns - offset_ns) < 100_000


def test_follows_a_drifting_clock():
    """50 ppm, a poor crystal: 5 us per sample."""
    sync = TimesyncFilter(TimesyncConfig())
    end = run(sync, np.random.default_rng(6), offset_ns=10**9, samples=3000, drift=50e-6, jitter_s=0.3e-3)
    truth = 10**9 + round(50e-6 * (end - PERIOD_NS))
    assert abs(sync.offset_ns - truth) < 1_000_000


def test_no_stamp_is_mapped_before_convergence():
    sync = TimesyncFilter(TimesyncConfig())
    run(sync, np.random.default_rng(1), offset_ns=10**9, samples=400)
    assert not sync.converged
    assert sync.to_companion(5) is None and sync.to_autopilot(5) is None


def test_stamps_map_there_and_back():
    sync = TimesyncFilter(TimesyncConfig(convergence_samples=20))
    run(sync, np.random.default_rng(1), offset_ns=10**12 + 7, samples=40, jitter_s=0.0)
    assert sync.to_companion(123_456) == 123_456 + 10**12 + 7
    assert sync.to_autopilot(sync.to_companion(123_456)) == 123_456


def test_slow_and_impossible_round_trips_teach_nothing():
    config = TimesyncConfig(convergence_samples=2)
    sync = TimesyncFilter(config)
    for now in range(0, 10**9, PERIOD_NS):
        sync.learn(Timesync(tc1=now, ts1=now), now + 10_000_001)
        sync.learn(Timesync(tc1=now, ts1=now + 1), now)
    assert not sync.converged


def test_a_run_of_outliers_restarts_and_single_ones_do_not():
    config = TimesyncConfig(convergence_samples=50)
    sync = TimesyncFilter(config)
    rng = np.random.default_rng(2)
    now = run(sync, rng, offset_ns=0, samples=100)
    before = sync.offset_ns
    for _ in range(config.outliers_max):
        now = run(sync, rng, offset_ns=2 * 10**9, samples=1, start_ns=now)
    assert sync.converged and sync.offset_ns == before
    now = run(sync, rng, offset_ns=0, samples=1, start_ns=now)  # a good one clears the count
    now = run(sync, rng, offset_ns=2 * 10**9, samples=config.outliers_max, start_ns=now)
    assert sync.converged
    now = run(sync, rng, offset_ns=2 * 10**9, samples=1, start_ns=now)
    assert not sync.converged
    run(sync, rng, offset_ns=2 * 10**9, samples=60, start_ns=now)
    assert abs(sync.offset_ns - 2 * 10**9) < 1_000_000


def test_an_answer_carries_both_clocks():
    assert answer(request(77), 1234) == Timesync(tc1=1234, ts1=77)
    assert answer(request(77), 0).tc1 != 0  # would read as a request
