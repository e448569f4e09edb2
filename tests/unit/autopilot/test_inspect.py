"""Logs: real ones against pymavlink's counts, damaged ones against what was damaged."""

from __future__ import annotations

import gzip
import json
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import typer
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink import mavutil
from typer.testing import CliRunner

from companion.autopilot.codec import Encoder, Heartbeat, Timesync
from companion.autopilot.inspect import Damage, inspect_tlog, read_tlog
from companion.cli.mavlink import inspect
from companion.core.errors import InputError

LOGS = Path(__file__).parents[4] / "shared/data/log_mavlink_tlog"
RADIO = LOGS / "real_radio_flight.tlog"
needs_logs = pytest.mark.skipif(not RADIO.exists(), reason="recorded logs are not here")
START_US = 1_700_000_000_000_000


def log(count=30) -> list[bytes]:
    """Records at 10 Hz, two kinds."""
    encoder = Encoder(system=1, component=1)
    messages = [Heartbeat(i, 2, 12, 81, 4) if i % 2 else Timesync(0, i + 1) for i in range(count)]
    return [(START_US + i * 100_000).to_bytes(8, "big") + encoder.encode(m) for i, m in enumerate(messages)]


def test_a_clean_log():
    report = inspect_tlog(b"".join(log()))
    assert (report.messages, report.corrupt_pieces, report.missing) == (30, 0, 0)
    assert report.duration_s == pytest.approx(2.9)
    assert {t.name: (t.count, round(t.rate_hz, 6)) for t in report.traffic} == {
        "HEARTBEAT": (15, 5.0),
        "TIMESYNC": (15, 5.0),
    }


def test_damage_costs_the_damaged_records_only():
    records = [bytearray(r) for r in log()]
    for i in (4, 5, 20):
        records[i][-1] ^= 1
    records[10] = records[10][:13]  # bytes lost
    records[11] = bytearray(b"noise between") + records[11]
    report = inspect_tlog(b"".join(records) + bytes(records[0][:15]))
    assert report.messages == 26
    assert report.corrupt_pieces == 4  # 10's rest and the noise are one run
    assert report.missing == 4
    assert report.cut_off_bytes == 15


def test_a_clock_that_was_set_in_between_loses_nothing():
    records = log()
    late = [(START_US * 2).to_bytes(8, "big") + r[8:] for r in records[15:]]
    report = inspect_tlog(b"".join([*records[:15], *late]))
    assert (report.messages, report.corrupt_pieces) == (30, 0)


def test_a_damaged_stamp_loses_nothing():
    records = [bytearray(r) for r in log()]
    records[0][0] = records[7][1] = records[29][0] = 0xEE
    report = inspect_tlog(b"".join(records))
    assert (report.messages, report.corrupt_pieces) == (30, 0)
    assert report.duration_s == pytest.approx(2.7)  # without the first and the last stamp


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=400), st.integers(0, 30))
def test_any_bytes_anywhere_never_raise_and_are_accounted_for(noise, place):
    records = log()
    data = b"".join(records[:place]) + noise + b"".join(records[place:])
    covered = sum(i.size if isinstance(i, Damage) else 8 + i.frame.size for i in read_tlog(data))
    assert covered == len(data)
    assert inspect_tlog(data).messages >= 20


def pymavlink_counts(path) -> Counter:
    connection = mavutil.mavlink_connection(str(path), dialect="all")
    counts: Counter = Counter()
    while (message := connection.recv_msg()) is not None:
        counts[message.get_type()] += 1
    connection.close()
    return counts


@needs_logs
def test_the_radio_log_counts_as_pymavlink_does():
    report = inspect_tlog(RADIO.read_bytes())
    theirs = pymavlink_counts(RADIO)
    assert theirs.pop("BAD_DATA") == report.corrupt_pieces == 1314
    ours: Counter = Counter()
    for t in report.traffic:
        ours[t.name] += t.count
    assert ours == theirs
    assert report.messages == 75_477
    assert report.duration_s == pytest.approx(1377.03, abs=0.01)
    assert {(t.system, t.component) for t in report.traffic} == {(1, 1), (51, 68), (255, 0)}


@needs_logs
def test_the_radio_logs_corrupt_pieces_are_frames_of_an_older_definition():
    """All 1,314 are whole frames of id 142 whose checksums one other CRC_EXTRA explains."""
    report = inspect_tlog(RADIO.read_bytes())
    assert list(report.foreign.values()) == [1314]
    assert report.corrupt_bytes == 1314 * 21
    assert report.cut_off_bytes == 19


@needs_logs
@pytest.mark.parametrize("name, messages, unknown", [("px4_offboard", 76_225, 146), ("arducopter_guided", 18_097, 0)])
def test_both_direction_logs_are_read_whole(name, messages, unknown):
    report = inspect_tlog(gzip.decompress((LOGS / f"{name}_both_directions.tlog.gz").read_bytes()))
    assert (report.messages, report.unknown, report.corrupt_pieces) == (messages, unknown, 0)


@needs_logs
def test_random_damage_to_a_real_log_is_survived():
    data = bytearray(RADIO.read_bytes()[:400_000])
    clean = inspect_tlog(bytes(data)).messages
    rng = np.random.default_rng(4)
    for at in rng.integers(0, len(data), size=300):
        data[at] = int(rng.integers(256))
    report = inspect_tlog(bytes(data))
    assert clean - 330 <= report.messages < clean
    assert report.corrupt_pieces >= 200


app = typer.Typer()
app.command()(inspect)


def test_command_prints_json_and_a_table(tmp_path):
    file = tmp_path / "a.tlog.gz"
    file.write_bytes(gzip.compress(b"".join(log())))
    result = CliRunner().invoke(app, [str(file), "--json"])
    told = json.loads(result.stdout)
    assert (told["messages"], told["duration_s"], len(told["traffic"])) == (30, 2.9, 2)
    table = CliRunner().invoke(app, [str(file)])
    assert table.exit_code == 0 and "HEARTBEAT" in table.stdout and "30 messages" in table.stdout


@pytest.mark.parametrize("content", [b"", b"no log at all" * 50, b"\x1f\x8bbroken"])
def test_what_is_no_log_is_an_input_error(tmp_path, content):
    file = tmp_path / "a.tlog"
    file.write_bytes(content)
    result = CliRunner().invoke(app, [str(file)])
    assert isinstance(result.exception, InputError)
    missing = CliRunner().invoke(app, [str(tmp_path / "missing.tlog")])
    assert isinstance(missing.exception, InputError) and "missing.tlog" in str(missing.exception)
