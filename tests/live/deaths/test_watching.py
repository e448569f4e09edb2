"""Other processes beside a live flight: they see it, and one speaks into it."""

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

PAGE = Path(__file__).resolve().parents[3] / "docs/live.md"
SHOWN = re.findall(r"^\$ \.venv/bin/companion ((?:topic|node|top|record)\b.*)$", PAGE.read_text(), re.MULTILINE)


def companion(flight, *arguments):
    """Standard output of a tool on the flight's bus."""
    command = [sys.executable, "-m", "companion", *arguments, f"--bus={flight.bus}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, cwd=flight.folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_live_flight_is_watched_and_told_to_hold_from_other_processes(hover):
    hover.until(lambda: (v := hover.monitor.vehicle) and v.p_odom[2] > 1.5, "the height")
    assert len(SHOWN) >= 8
    for command in SHOWN:
        assert companion(hover, *shlex.split(command)).strip() or command.startswith("record"), command
    assert (hover.folder / "watched.mcap").stat().st_size > 100_000
    second = hover.start_run("second")
    rates = [
        json.loads(line)
        for line in companion(hover, "topic", "hz", "estimation/odometry", "--for-s=4", "--json").splitlines()
    ]
    assert 60 < rates[-1]["rate_hz"] < 140
    echo = json.loads(companion(hover, "topic", "echo", "autopilot/vehicle", "--once", "--json"))
    assert echo["mode"] == "OFFBOARD" and echo["armed"]
    listed = companion(hover, "topic", "list", "-t")
    assert (
        "/drone1/tracking/setpoint [understory_msgs/msg/Setpoint]" in listed
        and "/tf [tf2_msgs/msg/TFMessage]" in listed
    )
    bandwidth = json.loads(companion(hover, "topic", "bw", "sensors/lidar", "--for-s=3", "--json").splitlines()[-1])
    assert bandwidth["window"] > 5 and bandwidth["bytes_per_s"] > 1e5
    info = companion(hover, "topic", "info", "mission/goal", "-v")
    assert "MissionNode" in info and "world_inbox" in info
    limits = "{speed: 1, climb: 1, accel: 2, yaw_rate: 1, clearance: 0.4, unknown: stop_before, agl_max: 30}"
    hold = f"{{id: 4711, kind: hold, p_odom: [0, 0, 2], if_blocked: fail, limits: {limits}}}"
    companion(hover, "topic", "pub", "mission/goal", "understory_msgs/msg/Goal", hold, "--once")
    hover.until(lambda: (p := hover.plan) is not None and p.goal_id == 4711, "the planner's word on that goal", 20.0)
    assert second.wait(60) == 3
    assert "another companion" in hover.words("second")
