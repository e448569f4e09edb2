"""`companion topic` as programs beside a real `companion sim`: what a user types in a second terminal."""

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time

import pytest

from companion.core import topics
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session
from companion.runtime.wire import codec_of, wire_type
from companion.runtime.wire.keys import Qos


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextlib.contextmanager
def running(*arguments):
    """A `companion` program; ends with Ctrl-C, or at once if that does not help."""
    command = [sys.executable, "-m", "companion", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=15)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def await_sensors(endpoint, timeout_s=60.0):
    """Until the simulator's IMU is on the bus."""
    kind, heard = codec_of(topics.IMU).type, threading.Event()
    until_s = time.monotonic() + timeout_s
    while time.monotonic() < until_s:
        with (
            contextlib.suppress(Exception),
            open_session("client", endpoint=endpoint) as session,
            Graph(session) as graph,
        ):
            graph.node("probe").subscribe("/drone1/sensors/imu", kind, Qos(), lambda arrival: heard.set())
            if heard.wait(max(0.0, until_s - time.monotonic())):
                return
        time.sleep(0.1)
    pytest.fail("the simulator never published")


@pytest.fixture(scope="module")
def endpoint():
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    link = f"udp://127.0.0.1:{free_port(socket.SOCK_DGRAM)}"
    with running("sim", "--world", "empty", "--bus", endpoint, "--mavlink", link, "--gcs", "", "--quiet"):
        await_sensors(endpoint)
        yield endpoint


@pytest.fixture
def companion(endpoint):
    def run(*arguments):
        command = [sys.executable, "-m", "companion", *arguments, "--bus", endpoint]
        return subprocess.run(command, capture_output=True, text=True, timeout=30)

    return run


def rows(done):
    assert done.returncode == 0, done.stderr
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_rate_bytes_and_one_message_of_a_real_sensor(companion):
    rate = rows(companion("topic", "hz", "sensors/imu", "--for-s", "2.5", "--json"))[-1]
    assert rate["rate_hz"] == pytest.approx(topics.IMU.rate_hz, rel=0.1)
    assert rate["window"] > 300
    bytes_ = rows(companion("topic", "bw", "sensors/imu", "-n", "100", "--json"))[-1]
    size = len(wire_type("sensor_msgs/msg/Imu").encode({"header": {"frame_id": "imu"}}))
    assert bytes_["size_mean_bytes"] == pytest.approx(size, abs=16)
    echo = companion("topic", "echo", "sensors/imu", "-n", "200", "--field", "linear_acceleration.z", "--json")
    assert sum(rows(echo)) / 200 == pytest.approx(9.81, abs=0.2)  # it stands on the ground; one sample has noise


def test_info_and_list_name_the_simulator(companion):
    found = rows(companion("topic", "info", "sensors/imu", "--json"))[0]
    assert found["types"] == ["sensor_msgs/msg/Imu"]
    assert [p["node"] for p in found["publishers"]] == ["/drone1/SimNode"]
    assert "/drone1/sensors/lidar [sensor_msgs/msg/PointCloud2]" in companion("topic", "list", "-t").stdout


def test_what_is_published_by_one_program_is_echoed_by_another(endpoint, companion):
    with running("topic", "echo", "/said", "--once", "--bus", endpoint) as early:
        assert early.wait(20) == 2  # nobody says it yet
    pub = ("topic", "pub", "/said", "std_msgs/msg/String", "data: north", "-w", "0", "-r", "20", "--bus", endpoint)
    with running(*pub) as talker:
        while "/said" not in companion("topic", "list").stdout:
            assert talker.poll() is None
        done = companion("topic", "echo", "/said", "-n", "3")
    assert done.stdout == "data: north\n---\n" * 3
    assert talker.returncode == 0  # Ctrl-C is how it ends


def test_ctrl_c_ends_hz_with_a_last_line(endpoint):
    with running("topic", "hz", "sensors/imu", "--bus", endpoint) as measuring:
        first = measuring.stdout.readline()
        time.sleep(0.3)
        measuring.send_signal(signal.SIGINT)
        out, error = measuring.communicate(timeout=10)
    assert first.startswith("average rate")
    assert out.splitlines()[-1].startswith("average rate")
    assert error == ""
    assert measuring.returncode == 0
