"""What the autopilot receives when a part of the stack dies in flight."""

import itertools
import os
import signal
import time

import pytest

from companion.runtime.flight_folder import read_header, rebuild
from companion.runtime.replay import Replay


def test_a_killed_planner_stops_the_vehicle_and_the_mission_goes_on(flight, speed_of):
    flight.flies()
    before = flight.pid("world")
    killed_s = time.monotonic()
    os.kill(before, signal.SIGKILL)
    flight.until(lambda: flight.monitor.safety.action == "hold", "the guards' hold", 5.0)
    reacted = [when for when, _ in flight.setpoints(killed_s)]
    flight.until(lambda: before not in (now := flight.groups()) and "world" in now.values(), "the restart", 10.0)
    flight.until(lambda: flight.monitor.safety.action == "ok", "the map and the planner again", 20.0)
    again_s = time.monotonic()
    braking = [speed_of(m) for when, m in flight.setpoints(killed_s) if killed_s + 0.2 < when < again_s]
    assert braking and braking[-1] < 0.3
    assert all(b <= a + 0.1 for a, b in zip(braking, braking[5:], strict=False) if a > 0.3), "it never speeds up"
    assert max(b - a for a, b in itertools.pairwise(reacted)) < 0.5, "setpoints went on"
    assert flight.run.wait(240) == 0, flight.story()
    summary = flight.summary()
    assert summary["completed"] and not summary["contact"]
    assert summary["restarts"] == {"world": 1}
    replayed = [log for log in sorted(flight.out.glob("inbox-*.log")) if _replays(log)]
    assert len(replayed) == 5, "four groups, one of them twice"


def _replays(log):
    """Every node of a live process gives the same bytes again, also of one that was killed."""
    replay = Replay(log, rebuild(read_header(log)))
    for _ in replay.run():
        pass
    assert replay.first is None, f"{log.name}: {replay.first}"
    return sum(report.outputs for report in replay.reports.values()) > 50


@pytest.mark.slow
def test_a_stopped_estimator_gives_no_stale_setpoint(flight, speed_of):
    flight.flies()
    pid, stopped_s = flight.pid("perception"), time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    time.sleep(1.0)
    os.kill(pid, signal.SIGCONT)
    sent = flight.setpoints(stopped_s)
    boot = [(when, m.time_boot_ms) for when, m in sent]
    ages = [(when - boot[0][0]) - (ms - boot[0][1]) * 1e-3 for when, ms in boot]
    assert max(ages) - min(ages) < 0.3, "each setpoint is made when it is sent"
    late = [speed_of(m) for when, m in sent if when > stopped_s + 0.9]
    assert not late or max(late) < 0.6, "without a measurement it slows down"
    flight.until(lambda: flight.monitor.over, "the end of the mission")
    assert not flight.monitor.contact


def test_a_killed_control_group_leaves_the_vehicle_to_the_autopilot(flight):
    flight.flies()
    killed_s = time.monotonic()
    os.kill(flight.pid("control"), signal.SIGKILL)
    assert flight.run.wait(30) == 1
    assert "failsafe has the vehicle" in flight.summary()["reason"]
    assert [when for when, _ in flight.setpoints(killed_s + 0.2)] == []
    assert flight.groups() == {}
    flight.until(lambda: flight.monitor.truth and not flight.monitor.truth.armed, "the failsafe's landing")


def test_a_killed_supervisor_leaves_no_orphan_and_the_vehicle_lands(flight):
    flight.flies()
    flight.run.kill()
    flight.until(lambda: not flight.monitor.truth.armed, "the landing")
    assert flight.monitor.truth.contact == ""
    flight.until(lambda: flight.groups() == {}, "the end of every group", 30.0)


@pytest.mark.slow
def test_a_bad_line_is_survived(flight, faults):
    flight.flies()
    flight.line.both_ways(faults(loss=0.5, delay_s=0.2, duplicate=0.2, reorder=0.2))
    flight.until(lambda: not flight.monitor.truth.armed, "an end on the ground", 240.0)
    assert flight.monitor.contact == ""
