"""The log of a live group: written by all its threads, replayed to the byte, harmless when the disk fails."""

import threading
import time
from pathlib import Path

import numpy as np
import pytest

from companion.config import Config, dump_config
from companion.core import topics
from companion.core.messages import BaroReading, ImuSample, LidarScan, LioState, RangeReading
from companion.core.node import Topic
from companion.mission.model import parse_mission
from companion.runtime.clock import Clock
from companion.runtime.codec import decode
from companion.runtime.flight_folder import rebuild
from companion.runtime.inbox import BULK_LIMIT, OUTSIDE, InboxLog, inbox_path
from companion.runtime.live import LiveGroup
from companion.runtime.log_file import End, Fed, Header, Message, entries
from companion.runtime.replay import Replay
from companion.stack import GROUPS, build

MISSION = "version: 1\nname: up\nsteps:\n  - {do: takeoff, alt: 1.5}\n  - {do: land}\n"
CONTROL = tuple(kind.__name__ for kind in GROUPS["control"])


def header(group: str, nodes: tuple[str, ...], *, signed: bool = False) -> Header:
    return Header(group=group, nodes=nodes, seed=3, mission=MISSION, config=dump_config(Config()), signed=signed)


def messages(path: Path) -> list[Message]:
    return [e for e in entries(path) if isinstance(e, Message)]


def reading(k: int) -> RangeReading:
    return RangeReading(stamp_ns=k, range_m=0.5 * k)


def test_what_comes_from_outside_is_stored_and_outputs_as_the_topic_says(tmp_path):
    log = InboxLog(tmp_path / "a.log", header("x", ("Worker",)))
    assert log.received(1, topics.RANGE, reading(1)) == 0
    log.fed(2, "Worker", "sensors/range", 0)
    assert log.published(3, "Worker", topics.BARO, BaroReading(stamp_ns=3, altitude_m=1.0)) == 1
    unstored = Topic("estimation/registered_scan", RangeReading, 0.0, recorded=False)
    assert log.published(4, "Worker", unstored, reading(4)) == 2
    log.close()
    found = list(entries(tmp_path / "a.log"))
    assert found[0] == header("x", ("Worker",))
    assert found[2] == Fed(2, "Worker", "sensors/range", 0)
    assert found[-1] == End(4, "")
    assert [m.source for m in messages(tmp_path / "a.log")] == [OUTSIDE, "Worker", "Worker"]
    assert [m.payload is None for m in messages(tmp_path / "a.log")] == [False, False, True]
    assert decode(found[1].payload, RangeReading).range_m == 0.5


@pytest.mark.parametrize(("store", "stored"), [("inputs", [True, False]), ("all", [True, True])])
def test_the_store_option(tmp_path, store, stored):
    log = InboxLog(tmp_path / "a.log", header("x", ("Worker",)), store=store)
    log.received(1, topics.RANGE, reading(1))
    log.published(2, "Worker", topics.RANGE, reading(2))
    log.close()
    assert [m.payload is not None for m in messages(tmp_path / "a.log")] == stored


def test_many_threads_write_one_order(tmp_path):
    """Numbers count the messages of the file, and each thread's entries keep their order."""
    log, given = InboxLog(tmp_path / "a.log", header("x", ())), {}

    def write(name: str) -> None:
        given[name] = [log.published(k, name, topics.RANGE, reading(k)) for k in range(2000)]

    threads = [threading.Thread(target=write, args=(f"n{k}",)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    log.close()
    found = messages(tmp_path / "a.log")
    assert sorted(n for numbers in given.values() for n in numbers) == list(range(8000))
    for name, numbers in given.items():
        assert [found[n].time_ns for n in numbers] == list(range(2000))
        assert {found[n].source for n in numbers} == {name}


def test_a_killed_process_leaves_what_it_logged_up_to_a_moment_ago(tmp_path):
    log = InboxLog(tmp_path / "a.log", header("x", ()))
    log.published(1, "n", topics.RANGE, reading(1))
    deadline = time.monotonic() + 5
    while not messages(tmp_path / "a.log") and time.monotonic() < deadline:
        time.sleep(0.02)
    assert len(messages(tmp_path / "a.log")) == 1  # the file was neither closed nor flushed by us
    log.close()


def test_a_disk_that_is_too_slow_ends_the_log_and_nothing_else(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.runtime.inbox.PERIOD_S", 60.0)
    log = InboxLog(tmp_path / "a.log", header("x", ()))
    bulk = Topic("sensors/lidar", LidarScan, 0.0, service="bulk")
    for k in range(BULK_LIMIT + 5):
        log.published(k, "n", bulk, reading(k))
    assert "too slow" in log.failure
    log.close()
    assert len(messages(tmp_path / "a.log")) == BULK_LIMIT + 1
    assert list(entries(tmp_path / "a.log"))[-1].reason == log.failure


def test_a_full_disk_ends_the_log_and_nothing_else():
    if not Path("/dev/full").exists():
        pytest.skip("no /dev/full here")
    log = InboxLog(Path("/dev/full"), header("x", ()))
    log.published(1, "n", topics.RANGE, reading(1))
    log.close()
    assert "cannot be written" in log.failure
    assert log.published(2, "n", topics.RANGE, reading(2)) == 1


def test_a_restarted_group_gets_a_new_file(tmp_path):
    names = []
    for _ in range(3):
        path = inbox_path(tmp_path, "control")
        path.touch()
        names.append(path.name)
    assert names == ["inbox-control.log", "inbox-control-2.log", "inbox-control-3.log"]


def test_a_live_group_replays_to_the_byte(tmp_path):
    """The control group with its threads and ticks of the real clock; IMU and LIO states come from outside."""
    clock = Clock.of_host()
    path = inbox_path(tmp_path, "control")
    log = InboxLog(path, header("control", CONTROL))
    mission = parse_mission(MISSION, file="mission")
    group = LiveGroup(build(Config(), mission, seed=3, only=GROUPS["control"]), clock=clock, log=log, outlets=[])
    group.start()
    for k in range(120):
        for topic, message in outside(clock.now_ns(), k):
            group.receive(topic, message)
        time.sleep(0.01)
    assert group.stop() == []
    assert group.failure is None
    log.close()
    replay = Replay(path, build(Config(), mission, seed=3, only=GROUPS["control"]))
    for _ in replay.run():
        pass
    assert replay.identical, replay.first
    assert replay.end_reason == ""
    assert list(replay.reports) == list(CONTROL)
    assert replay.reports["PropagatorNode"].outputs > 20
    assert replay.reports["SafetyNode"].outputs > 10
    assert replay.reports["AutopilotNode"].outputs > 10


def test_a_signed_link_replays_with_its_key_and_without_the_autopilot_node_otherwise(tmp_path):
    path, clock, key = tmp_path / "a.log", Clock.of_host(), bytes(range(32))
    told = header("control", CONTROL, signed=True)
    log = InboxLog(path, told)
    group = LiveGroup(rebuild(told, signing_key=key), clock=clock, log=log, outlets=[])
    group.start()
    time.sleep(0.6)
    assert group.stop() == []
    log.close()
    for given, names in ((key, list(CONTROL)), (None, list(CONTROL[:-1]))):
        replay = Replay(path, rebuild(told, signing_key=given))
        for _ in replay.run():
            pass
        assert replay.identical, replay.first
        assert list(replay.reports) == names
    wrong = Replay(path, rebuild(told, signing_key=bytes(32)))
    for _ in wrong.run():
        pass
    assert (wrong.first.node, wrong.first.topic) == ("AutopilotNode", "mavlink/tx")


def outside(now_ns: int, k: int):
    rate, force = np.array([0.01, 0.02, 0.1 * np.sin(k)]), np.array([0.1, 0.0, 9.81])
    yield topics.IMU, ImuSample(stamp_ns=now_ns, angular_velocity_body=rate, specific_force_body=force)
    if k % 10 == 0:
        yield (
            topics.LIO_STATE,
            LioState(
                stamp_ns=now_ns,
                p_odom=np.array([0.01 * k, 0.0, 1.0]),
                q_odom_body=np.array([1.0, 0.0, 0.0, 0.0]),
                v_odom=np.array([1.0, 0.0, 0.0]),
                gyro_bias_body=np.zeros(3),
                accel_bias_body=np.zeros(3),
                gravity_odom=np.array([0.0, 0.0, -9.81]),
                covariance=np.eye(18) * 1e-4,
                source="lidar" if k else "start",
                inlier_fraction=0.9,
                weakest_direction=0.4,
            ),
        )
