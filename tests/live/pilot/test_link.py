"""The link to the autopilot in a live flight: a reboot, and signing."""

import subprocess
import sys
import time

import pytest

INCOMPAT_SIGNED = 1

pytestmark = pytest.mark.slow


def said(flight):
    return (flight.out / "why.log").read_text()


def test_an_autopilot_that_reboots_before_the_flight_is_flown_after_it(fly, faults, wishes):
    flight = fly(options=("--set", "mission.ready_timeout_s=240"))
    flight.line.down = faults(loss=1.0)  # no pose reaches the autopilot: it is not ready
    flight.until(lambda: (v := flight.monitor.vehicle) and v.connected, "the vehicle")
    flight.sim.kill()
    flight.until(lambda: not flight.monitor.vehicle.connected, "its silence", 10.0)
    flight.start_sim("rebooted")
    flight.line.down = faults()
    assert flight.run.wait(240) == 0, flight.story()
    summary = flight.summary()
    assert summary["completed"] and not summary["contact"]
    assert "it rebooted: its clock went back" in said(flight)
    assert [what for _, what in wishes(flight, 0.0)].count("arm 1") <= 2


def test_an_autopilot_that_reboots_in_flight_ends_the_mission(fly, wishes):
    flight = fly()
    flight.flies()
    flight.sim.kill()
    again_s = time.monotonic()
    flight.start_sim("rebooted")
    assert flight.run.wait(120) == 1, flight.story()
    summary = flight.summary()
    assert not summary["completed"]
    assert "odometry age" in summary["reason"], "the sensors are gone with the simulator, and that shows first"
    assert "it rebooted: its clock went back" in said(flight)
    assert not [what for _, what in wishes(flight, again_s) if what in ("arm 1", "OFFBOARD")]


@pytest.fixture
def keys(tmp_path):
    """Two key files, made by the command."""
    files = [tmp_path / "one.key", tmp_path / "two.key"]
    for file in files:
        subprocess.run([sys.executable, "-m", "companion", "keys", "new", str(file)], check=True, capture_output=True)
    return files


def test_a_signed_flight_completes(fly, keys):
    flight = fly(options=(f"--key={keys[0]}",), sim_options=("--gcs=", f"--key={keys[0]}"))
    assert flight.run.wait(240) == 0, flight.story()
    assert flight.summary()["completed"] and not flight.summary()["contact"]
    signed = [m.get_header().incompat_flags & INCOMPAT_SIGNED for _, m in flight.setpoints()]
    assert all(signed) and len(signed) > 500


@pytest.mark.parametrize(
    ("key", "reason"),
    [(1, "both sides need the same key file"), (None, "it may want ours signed")],
    ids=["wrong", "none"],
)
def test_without_the_vehicles_key_it_never_arms_and_says_why(fly, keys, wishes, key, reason):
    own = () if key is None else (f"--key={keys[key]}",)
    flight = fly(options=("--set", "mission.ready_timeout_s=12", *own), sim_options=("--gcs=", f"--key={keys[0]}"))
    assert flight.run.wait(120) == 1, flight.story()
    summary = flight.summary()
    assert not summary["completed"] and reason in summary["reason"]
    assert wishes(flight, 0.0) == []
    flight.monitor.look()
    assert not flight.monitor.truth.armed and not flight.monitor.flew
