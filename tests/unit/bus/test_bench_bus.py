"""`companion bench bus` counts what it says it counts."""

import json
import threading
from collections import Counter

import msgspec
import pytest
import typer
from typer.testing import CliRunner

from companion.cli import bench
from companion.core import topics
from companion.runtime.bench.bus import BusRow, bench_bus
from companion.runtime.bench.load import full_load
from companion.runtime.bench.side import Ears, Span, _speak
from companion.runtime.clock import Clock
from companion.runtime.wire import codec_of

SECOND_NS = 1_000_000_000


class Box:
    """An outlet that refuses every tenth message."""

    def __init__(self):
        self.sent, self.got = dict.fromkeys((s.topic.name for s in full_load()), 0), []

    def publish(self, topic, message, now_ns):
        self.got.append((topic.name, message.stamp_ns))
        self.sent[topic.name] += len(self.got) % 10 != 0


def test_the_load_is_that_of_a_vehicle():
    streams = full_load()
    rates = {s.topic.name: s.rate_hz for s in streams}
    size = {s.topic.name: len(codec_of(s.topic).encode(s.make(1))) for s in streams}
    assert sum(rates.values()) == 482
    assert size["sensors/lidar"] == pytest.approx(1_048_576, rel=0.01)
    assert size["mapping/local_map"] == pytest.approx(1_048_576, rel=0.02)
    assert sum(rates[name] * size[name] for name in rates) == pytest.approx(17.4e6, rel=0.01)


@pytest.mark.parametrize("stream", full_load(), ids=lambda s: s.topic.name)
def test_each_message_bears_its_stamp_on_the_other_side(stream):
    codec = codec_of(stream.topic)
    assert codec.decode(codec.encode(stream.make(7 * SECOND_NS + 5))).stamp_ns == 7 * SECOND_NS + 5


def test_speaking_counts_what_is_sent_within_the_span():
    clock, box, counted = Clock(0), Box(), Counter()
    first_ns = clock.now_ns()
    span = Span(first_ns, first_ns + SECOND_NS // 5, first_ns + SECOND_NS // 2)
    _speak(full_load(), box, clock, span, counted)
    sent = [(name, stamp) for k, (name, stamp) in enumerate(box.got, start=1) if k % 10]
    within = Counter(name for name, stamp in sent if span.begin_ns <= stamp < span.end_ns)
    assert +counted == within and within
    assert all(stamp < span.end_ns for _, stamp in box.got)


def test_hearing_counts_what_is_stamped_within_the_time_however_late_it_comes():
    clock = Clock(0)
    ears, begin_ns = Ears(clock), clock.now_ns() + SECOND_NS // 10
    codec = codec_of(topics.SETPOINT)
    make = next(s.make for s in full_load() if s.topic is topics.SETPOINT)
    stamps = [
        begin_ns - 1,
        begin_ns,
        begin_ns + SECOND_NS // 4,
        begin_ns + SECOND_NS // 2 - 1,
        begin_ns + SECOND_NS // 2,
    ]
    payloads = [codec.encode(make(stamp)) for stamp in stamps]

    def say():
        for payload in payloads:
            ears.receive(topics.SETPOINT, payload, decode=codec.decode)

    late = threading.Timer(1.0, say)
    late.start()
    tally = ears.listen(begin_ns, for_ns=SECOND_NS // 2)
    late.join()
    assert tally.messages == {"tracking/setpoint": 3}
    assert tally.payload_bytes == 3 * len(payloads[0])
    assert len(tally.latency_ms) == 3 and len(tally.gap_ms) == 2
    assert tally.latency_ms == sorted(tally.latency_ms, reverse=True)  # the first waited longest


def test_a_row_accounts_for_every_message():
    (row,) = bench_bus(for_s=1.0, ways=["classes"])
    names = {s.topic.name for s in full_load()}
    assert set(row.sent) == set(row.lost) == names
    assert all(0 <= row.lost[name] <= row.sent[name] and row.sent[name] > 0 for name in names)
    assert row.messages_per_s == sum(row.sent.values()) - sum(row.lost.values())


def test_the_command_prints_one_row_per_line(monkeypatch):
    some = msgspec.json.decode(
        json.dumps(
            {
                "way": "classes", "for_s": 1.0, "cpu_send_percent": 1.0, "cpu_hear_percent": 1.0, "latency_p50_ms": 0.5,
                "latency_p99_ms": 1.0, "latency_max_ms": 2.0, "gap_p99_ms": 21.0, "messages_per_s": 480.0,
                "mb_per_s": 17.0, "sent": {"tracking/setpoint": 50}, "lost": {"tracking/setpoint": 1},
                "ran_first": True, "machine_load": 0.5, "cores": 2,
            }
        ),
        type=BusRow,
    )  # fmt: skip
    monkeypatch.setattr(bench, "bench_bus", lambda for_s: [some, some])
    app = typer.Typer()
    app.command("bus")(bench.bus)
    app.command("other")(lambda: None)
    lines = CliRunner().invoke(app, ["bus", "--json"]).output.splitlines()
    assert [msgspec.json.decode(line, type=BusRow) for line in lines] == [some, some]
    assert "1 of 50" in "".join(str(cell) for column in bench._table([some]).columns for cell in column.cells)
