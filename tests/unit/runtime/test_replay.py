"""A recorded flight replays to the byte; a changed byte or parameter is found and named."""

import json

import msgspec
import pytest
from typer.testing import CliRunner

from companion.cli.main import app
from companion.core import topics
from companion.core.errors import InputError
from companion.core.topics import BY_NAME
from companion.runtime.codec import decode
from companion.runtime.flight_folder import logs_of, read_header, rebuild
from companion.runtime.log_file import MESSAGE, LogDamaged, Message, entries, read_log
from companion.runtime.replay import Replay
from companion.stack import NODES

MISSION = """
version: 1
name: up
steps:
  - {do: takeoff, alt: 1.5}
  - {do: land}
"""
SECONDS = 3


def fly(folder, *options):
    (folder / "in.yaml").write_text(MISSION)
    command = ["fly", str(folder / "in.yaml"), "--world", "poisson", "--seed", "5", "--cores", "1", "--quiet"]
    result = CliRunner().invoke(app, [*command, "--limit-s", str(SECONDS), "--out", str(folder / "out"), *options])
    assert result.exit_code == 1, result.output  # a flight of three seconds does not end its mission
    return folder / "out"


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    return fly(tmp_path_factory.mktemp("flight"), "--record")


def run(log, *, overrides=(), **options):
    header = read_header(log)
    changed = rebuild(header, overrides) if overrides else ()
    replay = Replay(log, rebuild(header), changed=changed, **options)
    for _ in replay.run():
        pass
    return replay


def rewritten(log, path, change):
    """A copy in which `change` was applied to every entry."""
    with path.open("wb") as file:
        for raw in read_log(log):
            data = msgspec.msgpack.encode(change(raw))
            file.write(len(data).to_bytes(4, "little") + data)
    return path


def without_payloads(log, path, keep):
    """A copy as flown without --record: `keep` says of which (source, topic) payloads stay."""

    def change(raw):
        if raw[0] == MESSAGE and not keep(raw[2], raw[3]):
            raw[4] = None
        return raw

    return rewritten(log, path, change)


def stamp_of(message: Message):
    return decode(message.payload, BY_NAME[message.topic].type).stamp_ns


def nth(log, source, topic, n):
    """(number of the entry, message) of the n-th message of a source on a topic."""
    found = [
        (k, e) for k, e in enumerate(entries(log)) if isinstance(e, Message) and (e.source, e.topic) == (source, topic)
    ]
    return found[n]


def test_every_node_gives_its_outputs_again_to_the_byte(flight):
    replay = run(flight / "flight.log")
    assert replay.identical
    assert replay.end_reason == ""
    assert list(replay.reports) == [kind.__name__ for kind in NODES]
    logged = [e for e in entries(flight / "flight.log") if isinstance(e, Message) and e.source != "SimNode"]
    assert sum(r.outputs for r in replay.reports.values()) == len(logged)
    assert replay.reports["LioNode"].outputs > 10 * SECONDS
    assert replay.reports["MappingNode"].outputs > 2 * SECONDS


def test_scans_and_maps_are_not_stored_and_computed_again(flight):
    unstored = {e.topic for e in entries(flight / "flight.log") if isinstance(e, Message) and e.payload is None}
    assert unstored == {"estimation/registered_scan", "mapping/local_map", "mapping/delta", "mapping/occupied"}
    replay = run(flight / "flight.log", only="MappingNode")
    assert list(replay.reports) == ["MappingNode"]
    assert replay.identical
    assert replay.reports["MappingNode"].outputs > 2 * SECONDS


def test_a_changed_parameter_changes_its_node_alone(flight):
    replay = run(flight / "flight.log", overrides=["estimation.lio.thin_m=0.4"])
    assert replay.identical  # the original, which runs beside it
    assert replay.reports["LioNode"].first_changed.topic == "estimation/lio_state"
    table = replay.reports["LioNode"].changed["estimation/lio_state"]
    assert table.compared == replay.reports["LioNode"].changed["estimation/likelihood"].compared + 1
    assert 0 < table.differing <= table.compared
    assert 0 < table.largest["p_odom"] < 0.1
    assert all(r.first_changed is None for n, r in replay.reports.items() if n != "LioNode")


def test_in_a_chain_the_nodes_behind_it_change_too(flight):
    replay = run(flight / "flight.log", overrides=["estimation.lio.thin_m=0.4"], chain=True)
    changed = {n for n, r in replay.reports.items() if r.first_changed}
    assert {"LioNode", "PropagatorNode", "GraphNode"} <= changed
    assert "SensorsNode" not in changed


def test_a_damaged_input_is_named(flight, tmp_path):
    number, message = nth(flight / "flight.log", "SimNode", "sensors/lidar", 12)
    data = bytearray((flight / "flight.log").read_bytes())
    at = data.index(message.payload) + len(message.payload) // 2
    data[at] ^= 1
    (tmp_path / "a.log").write_bytes(data)
    with pytest.raises(LogDamaged, match=rf"sensors/lidar of SimNode, stamp {stamp_of(message)}"):
        run(tmp_path / "a.log")
    assert number > 0


def test_another_output_in_the_log_is_named(flight, tmp_path):
    """A digest that the node does not reproduce: as if the node had given something else in flight."""
    number, message = nth(flight / "flight.log", "PropagatorNode", "estimation/odometry", 20)
    count = iter(range(10**9))

    def change(raw):
        if next(count) == number:
            raw[5] = bytes([raw[5][0] ^ 1]) + raw[5][1:]
            raw[4] = None
        return raw

    replay = run(rewritten(flight / "flight.log", tmp_path / "a.log", change))
    assert (replay.first.node, replay.first.topic) == ("PropagatorNode", "estimation/odometry")
    assert replay.first.stamp_ns == stamp_of(message)
    assert replay.reports["PropagatorNode"].differing == 1  # the nodes behind it got what was computed


def test_a_lost_and_an_invented_output_are_named(flight, tmp_path):
    """One setpoint is said to come from the safety node."""
    number, message = nth(flight / "flight.log", "TrackingNode", "tracking/setpoint", 3)
    _, behind = nth(flight / "flight.log", "TrackingNode", "tracking/setpoint", 4)
    count = iter(range(10**9))

    def change(raw):
        return [*raw[:2], "SafetyNode", *raw[3:]] if next(count) == number else raw

    log = rewritten(flight / "flight.log", tmp_path / "a.log", change)
    invented = run(log, only="SafetyNode").first
    assert (invented.topic, invented.stamp_ns) == ("tracking/setpoint", stamp_of(message))
    assert "the replay does not give it" in invented.what[0]
    lost = run(log, only="TrackingNode").first  # it is compared with the one behind it
    assert (lost.topic, lost.time_ns, lost.stamp_ns) == ("tracking/setpoint", behind.time_ns, stamp_of(message))


def test_a_tick_at_another_time_is_a_difference(flight, tmp_path):
    ticks = [
        k for k, raw in enumerate(read_log(flight / "flight.log")) if raw[:1] + raw[2:4] == [1, "SafetyNode", "watch"]
    ]
    count = iter(range(10**9))

    def change(raw):
        if next(count) == ticks[5]:
            raw[1] += 1
        return raw

    replay = run(rewritten(flight / "flight.log", tmp_path / "a.log", change), only="SafetyNode")
    assert replay.first.topic == "safety/status"
    assert replay.first.what[0].startswith("stamp_ns: ")


def test_a_torn_log_replays_up_to_the_tear(flight, tmp_path):
    data = (flight / "flight.log").read_bytes()
    (tmp_path / "a.log").write_bytes(data[: len(data) // 2])
    replay = run(tmp_path / "a.log")
    assert replay.identical
    assert replay.end_reason is None
    assert 1e9 < replay.end_ns < SECONDS * 1e9
    assert replay.reports["LioNode"].outputs > 0


def test_bytes_that_are_no_entry_are_named(flight, tmp_path):
    data = bytearray((flight / "flight.log").read_bytes())
    data[4] = 0xC1  # no MessagePack
    (tmp_path / "a.log").write_bytes(data)
    with pytest.raises(LogDamaged, match="byte 4"):
        list(entries(tmp_path / "a.log"))


def test_without_recorded_sensors_the_other_nodes_are_replayed(flight, tmp_path):
    log = without_payloads(flight / "flight.log", tmp_path / "a.log", lambda _, topic: BY_NAME[topic].recorded)
    replay = run(log)
    assert replay.identical
    assert list(replay.blocked) == [
        *("SensorsNode", "LioNode", "LoopNode", "MappingNode", "ObstacleTracksNode", "LandmarkNode", "PlanningNode")
    ]
    assert replay.blocked["PlanningNode"] == ("mapping/local_map", "MappingNode")
    assert list(replay.reports) == [k.__name__ for k in NODES if k.__name__ not in replay.blocked]
    with pytest.raises(InputError, match="--record"):
        run(log, only="LioNode")


def test_a_log_without_header_says_so(tmp_path):
    (tmp_path / "flight.log").write_bytes(b"")
    with pytest.raises(InputError, match="which nodes"):
        read_header(logs_of(tmp_path)[0])
    with pytest.raises(InputError, match="no log"):
        logs_of(tmp_path / "nothing")


def test_the_command_says_identical_and_finds_a_difference(flight, tmp_path):
    result = CliRunner().invoke(app, ["replay", str(flight), "--node", "TrackingNode", "--json"])
    assert result.exit_code == 0
    told = json.loads(result.stdout)
    assert told["identical"]
    assert told["logs"][0]["nodes"]["TrackingNode"]["differing"] == 0
    number, message = nth(flight / "flight.log", "TrackingNode", "tracking/setpoint", 3)
    (tmp_path / "flight.log").write_bytes((flight / "flight.log").read_bytes().replace(message.digest, bytes(16)))
    result = CliRunner().invoke(app, ["replay", str(tmp_path), "--node", "TrackingNode"])
    assert result.exit_code == 1
    assert isinstance(result.exception, LogDamaged)  # payload and digest disagree
    assert f"tracking/setpoint of TrackingNode, stamp {stamp_of(message)}" in str(result.exception)
    assert number > 0


def test_the_command_shows_what_a_parameter_changes(flight):
    command = ["replay", str(flight), "--node", "TrackingNode", "--set", "tracking.odometry_stale_s=0.001"]
    result = CliRunner().invoke(app, command)
    assert result.exit_code == 0
    assert "first output that is changed: TrackingNode, tracking/setpoint" in result.stdout
    result = CliRunner().invoke(app, ["replay", str(flight), "--node", "Nobody"])
    assert isinstance(result.exception, InputError)


def test_recording_changes_nothing_of_the_flight(flight):
    told = json.loads((flight / "summary.json").read_text())
    count = sum(isinstance(e, Message) for e in entries(flight / "flight.log"))
    assert told["messages"] == count
    assert topics.LIDAR.name in {
        e.topic for e in entries(flight / "flight.log") if isinstance(e, Message) and e.payload
    }
