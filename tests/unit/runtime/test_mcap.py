"""MCAP files are read back by mcap's own reader, by rosbags and by ours, also torn ones."""

import struct
import subprocess
import sys
import time
from dataclasses import replace

import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from companion.core.errors import InputError
from companion.runtime.mcap_file import McapFile, Sample, recover, samples
from companion.runtime.recorder import Recorder

RULE = "=" * 80
HEADER = f"{RULE}\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n"
TIME = f"{RULE}\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n"
PRESSURE = f"std_msgs/Header header\nfloat64 fluid_pressure\nfloat64 variance\n{HEADER}{TIME}"
FLOAT = "float64 data\n"
S = 1_000_000_000


def pressure(k: int) -> Sample:
    head = struct.pack("<iII4s", k, 7, 4, b"map\0")  # sec, nanosec, length, text; aligned to 8 at 16
    body = b"\x00\x01\x00\x00" + head + struct.pack("<dd", 1000.0 + k, 0.5)
    return Sample(
        topic="drone1/sensors/baro",
        type="sensor_msgs/msg/FluidPressure",
        schema=PRESSURE,
        payload=body,
        log_ns=k * S + 5,
        publish_ns=k * S,
    )


def number(k: int, size: int = 0) -> Sample:
    body = b"\x00\x01\x00\x00" + struct.pack("<d", 0.25 * k) + bytes(size)
    return Sample(
        topic="drone1/height",
        type="std_msgs/msg/Float64",
        schema=FLOAT,
        payload=body,
        log_ns=k * S + 9,
        publish_ns=k * S,
    )


@pytest.fixture
def file(tmp_path):
    with McapFile(tmp_path / "a.mcap") as out:
        for k in range(50):
            out.write(pressure(k))
            out.write(number(k))
    return tmp_path / "a.mcap"


def test_mcaps_reader_finds_every_message_by_the_summary(file):
    with file.open("rb") as stream:
        reader = make_reader(stream)
        summary = reader.get_summary()
        assert reader.get_header().profile == "ros2"
        assert summary.statistics.message_count == 100
        assert {c.topic: c.message_encoding for c in summary.channels.values()} == {
            "/drone1/sensors/baro": "cdr",
            "/drone1/height": "cdr",
        }
        assert {s.name: s.encoding for s in summary.schemas.values()} == {
            "sensor_msgs/msg/FluidPressure": "ros2msg",
            "std_msgs/msg/Float64": "ros2msg",
        }
        assert all(c.compression == "lz4" for c in summary.chunk_indexes)
        heard = [(m.log_time, m.publish_time, m.sequence) for _, c, m in reader.iter_messages("/drone1/height")]
    assert heard == [(k * S + 9, k * S, k + 1) for k in range(50)]


def test_rosbags_reads_every_value(file):
    with AnyReader([file]) as reader:
        values = {c.topic: [] for c in reader.connections}
        for connection, stamp_ns, data in reader.messages():
            values[connection.topic].append((stamp_ns, reader.deserialize(data, connection.msgtype)))
    heights, pressures = values["/drone1/height"], values["/drone1/sensors/baro"]
    assert [(t, m.data) for t, m in heights] == [(k * S + 9, 0.25 * k) for k in range(50)]
    assert [m.fluid_pressure for _, m in pressures] == [1000.0 + k for k in range(50)]
    assert {(m.header.frame_id, m.header.stamp.nanosec) for _, m in pressures} == {("map", 7)}


def test_our_reader_gives_back_what_was_written(file):
    assert list(samples(file)) == [s for k in range(50) for s in (pressure(k), number(k))]


def test_a_topic_keeps_its_type(tmp_path):
    with McapFile(tmp_path / "a.mcap") as out:
        out.write(number(0))
        with pytest.raises(InputError, match="Float64"):
            out.write(replace(number(1), type="std_msgs/msg/Float32"))


@pytest.mark.parametrize("beyond", [-1, 0, 20, 200])
def test_a_torn_file_is_read_up_to_its_last_whole_chunk(tmp_path, beyond):
    """Cut in the index behind the second chunk, after it, in the head of the third chunk, in its data."""
    with McapFile(tmp_path / "a.mcap") as out:
        ends = []
        for k in range(40):
            out.write(number(k, size=1000))
            if k % 10 == 9:
                out.flush()
                ends.append(out.bytes)
    data = (tmp_path / "a.mcap").read_bytes()
    (tmp_path / "torn.mcap").write_bytes(data[: ends[1] + beyond])
    assert recover(tmp_path / "torn.mcap", tmp_path / "b.mcap") == 20
    with AnyReader([tmp_path / "b.mcap"]) as reader:
        assert reader.message_count == 20
        assert [t for _, t, _ in reader.messages()] == [k * S + 9 for k in range(20)]


def test_what_is_no_mcap_file_says_so(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"hello, world")
    with pytest.raises(InputError, match="no MCAP"):
        list(samples(tmp_path / "a.mcap"))


def test_a_recorder_writes_all_that_it_got_and_counts(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap")
    given = [s for k in range(500) for s in (pressure(k), number(k))]
    assert all([recorder.put(s) for s in given])
    recorder.close()
    assert recorder.written == {"drone1/sensors/baro": 500, "drone1/height": 500}
    assert not recorder.dropped
    assert list(samples(tmp_path / "a.mcap")) == given
    assert not recorder.put(number(1))  # closed


def test_a_recorder_drops_and_counts_what_does_not_fit(tmp_path):
    recorder = Recorder(tmp_path / "a.mcap", waiting_bytes=10_000)
    taken = [recorder.put(number(k, size=20_000)) for k in range(3)]
    taken.append(recorder.put(number(9)))
    recorder.close()
    assert taken == [False, False, False, True]
    assert recorder.dropped == {"drone1/height": 3}
    assert list(samples(tmp_path / "a.mcap")) == [number(9)]


def test_a_recorder_splits_when_asked(tmp_path, monkeypatch):
    monkeypatch.setattr("companion.runtime.recorder.FLUSH_S", 0.02)
    recorder = Recorder(tmp_path / "a.mcap", split_bytes=2000)
    for k in range(30):
        recorder.put(number(k, size=300))
        time.sleep(0.01)
    recorder.close()
    assert [p.name for p in recorder.files[:2]] == ["a.mcap", "a_1.mcap"]
    assert [s.publish_ns for p in recorder.files for s in samples(p)] == [k * S for k in range(30)]
    assert all(len(list(samples(p))) for p in recorder.files[:-1])


KILLED = """
import sys, time
from pathlib import Path
sys.path.insert(0, {tests!r})
from companion.runtime import recorder
from test_mcap import number
recorder.FLUSH_S = 0.1
r = recorder.Recorder(Path({out!r}))
for k in range(10_000):
    r.put(number(k))
    if k == 200:
        time.sleep(0.5)
        print("go", flush=True)
    time.sleep(0.001)
"""


def test_a_killed_recorder_leaves_a_file_that_can_be_recovered(tmp_path, request):
    code = KILLED.format(tests=str(request.path.parent), out=str(tmp_path / "a.mcap"))
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "go\n"
        process.kill()
    saved = recover(tmp_path / "a.mcap", tmp_path / "b.mcap")
    assert saved >= 201
    assert list(samples(tmp_path / "b.mcap"))[:201] == [number(k) for k in range(201)]
