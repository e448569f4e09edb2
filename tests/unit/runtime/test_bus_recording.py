"""`companion record` against a node in another session: all topics, also late ones, and only those asked for."""

import contextlib
import socket
import threading
import time

import pytest
from rosbags.highlevel import AnyReader
from rosbags.interfaces import QosDurability
from typer.testing import CliRunner

from companion.cli.main import app
from companion.core.errors import CompanionError, LinkError
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.session import open_session
from companion.runtime.mcap_file import samples
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Qos

TEXT = "std_msgs/msg/String"


@pytest.fixture
def endpoint():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


@pytest.fixture
def graph(endpoint):
    with open_session("router", endpoint=endpoint) as session, Graph(session) as graph:
        yield graph


@contextlib.contextmanager
def talking(graph, name, *, after_s=0.0, qos=Qos(depth=10)):  # noqa: B008 (frozen)
    """Say `<name> <k>` at 50 Hz, from `after_s` on."""
    ended, kind = threading.Event(), wire_type(TEXT)

    def work():
        ended.wait(after_s)
        publisher, k = graph.node("talker", namespace="/drone1").publisher(name, kind, qos), 0
        while not ended.wait(0.02):
            publisher.put(kind.encode({"data": f"{name} {k}"}), time.time_ns())
            k += 1

    thread = threading.Thread(target=work)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def record(endpoint, path, *arguments):
    return CliRunner().invoke(app, ["record", *arguments, "--out", str(path), "--bus", endpoint])


def said(path):
    with AnyReader([path]) as reader:
        found = {c.topic: [] for c in reader.connections}
        for connection, _, data in reader.messages():
            found[connection.topic].append(reader.deserialize(data, connection.msgtype).data)
    return found


def test_every_topic_is_recorded_late_ones_too(graph, endpoint, tmp_path):
    with (
        talking(graph, "/drone1/first"),
        talking(graph, "/drone1/late", after_s=1.0),
        talking(graph, "/drone1/_hidden"),
        talking(graph, "/drone1/mapping/local_map"),
    ):
        result = record(endpoint, tmp_path / "a.mcap", "--for-s", "3")
    assert result.exit_code == 0, result.output
    found = said(tmp_path / "a.mcap")
    assert sorted(found) == ["/drone1/first", "/drone1/late"]
    numbers = [int(text.split()[1]) for text in found["/drone1/first"]]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert len(numbers) > 50
    times = [(s.publish_ns, s.log_ns) for s in samples(tmp_path / "a.mcap")]
    assert all(sent <= heard for sent, heard in times)


def test_only_what_was_asked_for(graph, endpoint, tmp_path):
    with talking(graph, "/drone1/sensors/a"), talking(graph, "/drone1/sensors/b"), talking(graph, "/drone1/c"):
        result = record(endpoint, tmp_path / "a.mcap", "sensors/*", "--for-s", "1")
    assert result.exit_code == 0, result.output
    assert sorted(said(tmp_path / "a.mcap")) == ["/drone1/sensors/a", "/drone1/sensors/b"]


def test_what_is_kept_for_late_joiners_is_there_and_said_to_be(graph, endpoint, tmp_path):
    kind = wire_type(TEXT)
    publisher = graph.node("talker").publisher("/tf_static", kind, Qos(transient_local=True, depth=1))
    publisher.put(kind.encode({"data": "frames"}), time.time_ns())
    result = record(endpoint, tmp_path / "a.mcap", "--for-s", "1.5")
    assert result.exit_code == 0, result.output
    assert said(tmp_path / "a.mcap") == {"/tf_static": ["frames"]}
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        profile = reader.connections[0].ext.offered_qos_profiles[0]
    assert profile.durability == QosDurability.TRANSIENT_LOCAL


def test_silence_and_no_bus_are_told_apart(graph, endpoint, tmp_path):
    assert isinstance(record(endpoint, tmp_path / "a.mcap", "--for-s", "1").exception, CompanionError)
    nowhere = record("tcp/127.0.0.1:9", tmp_path / "b.mcap", "--for-s", "1")
    assert isinstance(nowhere.exception, LinkError)
    assert not (tmp_path / "b.mcap").exists()
