"""A live flight as a user starts it, on free ports, with an ear on the line to the autopilot.

Loaded by the conftest.py of every folder that flies: tests are no package.
"""

import importlib.util
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from companion.core import topics
from companion.runtime.bus.attach import Hearing
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session
from companion.runtime.monitor import WATCHED, Monitor

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("middleman", ROOT / "tests/live/middleman.py")
middleman = importlib.util.module_from_spec(_spec)
sys.modules["middleman"] = middleman
_spec.loader.exec_module(middleman)

MISSION = """
version: 1
name: out_and_back
steps:
  - {do: takeoff, alt: 2.0}
  - {do: goto, at: [10, 5, 2], limits: {speed: 1.0}}
  - {do: return_home, land: land}
"""
HOVER = """
version: 1
name: hover
steps:
  - {do: takeoff, alt: 2.0}
  - {do: hover, seconds: 300}
  - {do: land}
"""
LIGHT = "sim.lidar.points=8000"  # what dies and what follows is not a matter of rays: leave room for the test
START_S, FLIGHT_S = 240.0, 150.0


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


class Flight:
    """`companion sim` and `companion run` as processes; `monitor` hears the bus, `line` the MAVLink."""

    def __init__(self, folder, *, world="demo", options=(), sim_options=("--gcs=",), mission=MISSION):
        self.out, self.folder = folder / "flight", folder
        self.bus = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        self.port = free_port(socket.SOCK_DGRAM)
        self.line = middleman.Middleman(towards=("127.0.0.1", self.port), seed=1)
        self.plan = None  # the newest PlanStatus
        self.monitor = Monitor([self])
        (folder / "mission.yaml").write_text(mission)
        self._processes, self._world, self._options, self._sim_options = {}, world, options, sim_options
        self._session = self._graph = None

    def __enter__(self):
        self.line.__enter__()
        self.sim = self.start_sim("sim")
        self.run = self.start_run("run")
        self._session = open_session("peer", endpoint=self.bus)  # lives on without the simulator, its router
        self._graph = Graph(self._session)
        Hearing(self._graph, WATCHED, self.monitor, listener="test", vehicle="drone1")
        return self

    def __exit__(self, *_):
        for process in self._processes.values():
            if process.poll() is None:
                process.kill()
            process.wait(10)
        for pid in self.groups():
            os.kill(pid, signal.SIGKILL)
        if self._graph is not None:
            self._graph.__exit__(None, None, None)
            self._session.close()
        self.line.__exit__(None, None, None)

    def heard(self, topic, message):
        if topic is topics.PLAN:
            self.plan = message

    def start_sim(self, name):
        sim = self._start(name, "sim", "--world", self._world, f"--mavlink=udp://127.0.0.1:{self.line.port}",
                          "--json", f"--bus={self.bus}", "--set", LIGHT, *self._sim_options)  # fmt: skip
        self.until(lambda: "ready" in self.words(name), "the simulator", START_S)
        return sim

    def start_run(self, name):
        out = self.out if name == "run" else self.folder / name
        return self._start(name, "run", str(self.folder / "mission.yaml"), f"--vehicle=udp://127.0.0.1:{self.port}",
                           "--json", f"--bus={self.bus}", f"--out={out}", *self._options)  # fmt: skip

    def _start(self, name, *arguments):
        out, err = (self.folder / f"{name}.{end}" for end in ("out", "err"))
        with out.open("wb") as stdout, err.open("wb") as stderr:
            process = subprocess.Popen(
                [sys.executable, "-m", "companion", *arguments], cwd=ROOT, stdout=stdout, stderr=stderr
            )
        self._processes[name] = process
        return process

    def words(self, name):
        return (self.folder / f"{name}.err").read_text(errors="replace")

    def until(self, condition, what, timeout_s=FLIGHT_S):
        until_s = time.monotonic() + timeout_s
        while time.monotonic() < until_s:
            self.monitor.look()
            if found := condition():
                return found
            time.sleep(0.01)
        pytest.fail(f"waited {timeout_s:g} s in vain for {what}\n{self.story()}")

    def story(self):
        logs = [f"--- {p.name}\n{p.read_text(errors='replace')[-1500:]}" for p in sorted(self.out.glob("*.log"))
                if not p.name.startswith("inbox")]  # fmt: skip
        return "\n".join([self.words("run")[-3000:], *logs, str(self.monitor.mission), str(self.monitor.vehicle)])

    def flies(self, at_least_m=3.0):
        """Until it is on its way, some metres from its start."""
        self.until(
            lambda: (v := self.monitor.vehicle) and v.armed and (v.p_odom[:2] ** 2).sum() > at_least_m**2,
            f"{at_least_m:g} m of flight",
        )

    def groups(self):
        """Process ids of the groups of this flight: their logs lie in its folder."""
        found = {}
        for entry in Path("/proc").iterdir():
            try:
                if entry.name.isdigit() and b"companion.runtime.group" in (entry / "cmdline").read_bytes():
                    log = os.readlink(entry / "fd/2")
                    if log.startswith(str(self.out)):
                        found[int(entry.name)] = Path(log).stem
            except OSError:
                continue
        return found

    def pid(self, group):
        return next(pid for pid, name in self.groups().items() if name == group)

    def setpoints(self, since_s=0.0):
        """(monotonic s, message) of every setpoint that went to the vehicle."""
        return self.sent("SET_POSITION_TARGET_LOCAL_NED", since_s)

    def sent(self, kind, since_s=0.0):
        """(monotonic s, message) of every message of a kind that went to the vehicle."""
        parser = mavlink.MAVLink(None)
        parser.robust_parsing = True
        found = []
        for when, data in list(self.line.to_vehicle):
            if when >= since_s:
                messages = parser.parse_buffer(data) or []
                found += [(when, m) for m in messages if m.get_type() == kind]
        return found

    def summary(self):
        return json.loads((self.out / "summary.json").read_text())


def speed_of(setpoint):
    """Demanded speed, m/s; 0 where the velocity is not demanded."""
    if setpoint.type_mask & 0b111000 == 0b111000:
        return 0.0
    return (setpoint.vx**2 + setpoint.vy**2 + setpoint.vz**2) ** 0.5
