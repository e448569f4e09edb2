"""MAVProxy as it comes from PyPI, scripted through its standard input, flies `companion sim`."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

MAVPROXY = Path(sys.executable).with_name("mavproxy.py")
pytestmark = pytest.mark.skipif(not MAVPROXY.exists(), reason="MAVProxy is not installed: make test installs it")


class Shell:
    """The prompt: what is typed in, what came out so far."""

    def __init__(self, port, folder, until):
        self.until, self.lines = until, []
        self._process = subprocess.Popen(
            [sys.executable, str(MAVPROXY), f"--master=udp:127.0.0.1:{port}", f"--state-basedir={folder}"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder,
            env={**os.environ, "HOME": str(folder), "PYTHONUNBUFFERED": "1"},
        )  # fmt: skip
        self._reader = threading.Thread(target=self._listen, daemon=True)
        self._reader.start()

    def _listen(self):
        for line in self._process.stdout:
            self.lines.append(line.rstrip())

    def type(self, command):
        self._process.stdin.write(command + "\n")
        self._process.stdin.flush()

    def wait_for(self, text, times=1):
        said = lambda: sum(text in line for line in self.lines) >= times  # noqa: E731
        self.until(said, f"{text!r}", said=lambda: self.lines[-20:])

    def close(self):
        self._process.kill()
        self._process.wait(10)
        self._reader.join(10)
        self._process.stdin.close()
        self._process.stdout.close()


@pytest.fixture
def shell(start_sim, until, tmp_path):
    sim = start_sim("--gps", speed=2.0)
    shell = Shell(sim.gcs, tmp_path, until)
    yield shell
    shell.close()
    summary = sim.end()
    assert summary["armed_s"] > 5.0
    assert summary["contact"] == ""


def test_it_loads_all_parameters_arms_takes_off_and_lands(shell, tmp_path):
    shell.wait_for("Detected vehicle 1:1")
    shell.wait_for("Received ")
    count = int(next(x for x in shell.lines if "Received " in x).split("Received ")[1].split()[0])
    shell.wait_for(f"Saved {count} parameters")
    saved = next(tmp_path.rglob("mav.parm")).read_text().splitlines()
    values = dict(line.split()[:2] for line in saved)
    assert len(values) == count > 100
    assert float(values["EKF2_EV_CTRL"]) == 15.0  # an integer, bytewise in a float field
    shell.wait_for("GPS lock at 48")
    shell.type("arm throttle")
    shell.wait_for("COMPONENT_ARM_DISARM: ACCEPTED")
    shell.type("takeoff 5")  # PX4 takes it as metres above the sea, and raises it
    shell.wait_for("NAV_TAKEOFF: ACCEPTED")
    shell.wait_for("Using minimum takeoff altitude")
    shell.wait_for("Mode TAKEOFF")
    shell.wait_for("Takeoff detected")
    shell.wait_for("Mode LOITER", times=2)  # at the start, and at the height of take-off
    shell.type("long NAV_LAND 0 0 0 0 0 0 0")
    shell.wait_for("NAV_LAND: ACCEPTED")
    shell.wait_for("Mode LAND")
    shell.wait_for("Disarmed by landing")
