"""The pilot always wins: what the companion does after somebody else changed the mode in flight."""

import time

import pytest

REACT_S = 1.5  # a heartbeat per second shows the mode; then setpoints stop


def texts(flight, since_s):
    return [m.text.rstrip("\0") for _, m in flight.sent("STATUSTEXT", since_s)]


def test_a_pilots_hold_ends_the_mission_and_is_never_taken_back(watched, wishes):
    flight, station = watched
    flight.flies()
    switched_s = station.switch("HOLD")
    flight.until(lambda: station.in_mode("HOLD"), "the pilot's mode", 5.0)
    held_s = time.monotonic()
    flight.until(lambda: flight.monitor.mission.state == "failed", "the end of the mission", 5.0)
    reason = flight.monitor.mission.reason
    flight.until(lambda: time.monotonic() > held_s + 6.0, "six seconds of hold", 10.0)
    assert "HOLD" in reason and "took over" in reason
    assert wishes(flight, switched_s + 0.2) == []
    assert flight.setpoints(held_s + REACT_S) == []
    assert not station.left("HOLD", held_s)
    assert any("HOLD is not ours, setpoints stop" in text for text in texts(flight, switched_s))
    assert any("mission failed" in text for text in texts(flight, switched_s))
    truth = flight.monitor.truth
    assert truth.armed and (truth.v_world**2).sum() ** 0.5 < 0.5, "it hovers where the pilot stopped it"
    assert flight.run.poll() is None, "it watches until the motors are off"
    station.switch("LAND")
    assert flight.run.wait(60) == 1, flight.story()
    summary = flight.summary()
    assert (summary["completed"], summary["contact"], summary["reason"]) == (False, False, reason)
    assert wishes(flight, switched_s + 0.2) == []


@pytest.mark.slow
def test_a_pilots_landing_ends_the_mission(watched, wishes):
    flight, station = watched
    flight.flies()
    switched_s = station.switch("LAND")
    flight.until(lambda: station.in_mode("LAND"), "the pilot's mode", 5.0)
    landing_s = time.monotonic()
    assert flight.run.wait(90) == 1, flight.story()
    assert not station.left("LAND", landing_s)
    assert wishes(flight, switched_s + 0.2) == []
    late = [when for when, _ in flight.setpoints(landing_s + REACT_S)]
    assert all(when > station.last_armed_s for when in late), "only on the ground may a stream begin again"
    assert any("LAND is not ours, setpoints stop" in text for text in texts(flight, switched_s))
    summary = flight.summary()
    assert not summary["completed"] and not summary["contact"]
    assert "mode LAND" in summary["reason"]


@pytest.mark.slow
def test_a_pilot_who_gives_offboard_back_gets_no_flight_without_him(watched, wishes):
    """After the pilot's hold the stream has stopped, so PX4 refuses OFFBOARD: no old goal is flown to."""
    flight, station = watched
    flight.flies()
    station.switch("HOLD")
    flight.until(lambda: flight.monitor.mission.state == "failed", "the end of the mission", 5.0)
    gave_s = station.switch("OFFBOARD")
    flight.until(lambda: time.monotonic() > gave_s + 4.0, "four seconds", 10.0)
    assert station.in_mode("HOLD")
    assert flight.setpoints(gave_s) == []
    station.switch("LAND")
    assert flight.run.wait(60) == 1
    assert wishes(flight, gave_s) == []
