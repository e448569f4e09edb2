"""The laws of simulated time: order, modelled delay, busy nodes, determinism."""

import pytest

from companion.core.messages import BaroReading, RangeReading
from companion.core.node import Node, Outputs, Topic, every, on
from companion.runtime.codec import decode, encode
from companion.runtime.flight_log import FlightLog, read_log
from companion.runtime.lockstep import Lockstep

FAST = Topic("fast", RangeReading, 100.0, "all")
SLOW = Topic("slow", BaroReading, 10.0, "latest")
OUT = Topic("out", RangeReading, 0.0, "all")
MS = 1_000_000


class Source(Node):
    @every(hz=100)
    def fast(self, now_ns: int) -> Outputs:
        yield FAST(RangeReading(stamp_ns=now_ns, range_m=1.0))

    @every(hz=50)
    def slow(self, now_ns: int) -> Outputs:
        yield SLOW(BaroReading(stamp_ns=now_ns, altitude_m=2.0), delay_ns=3 * MS)


class Worker(Node):
    def __init__(self) -> None:
        self.log: list[tuple[str, int, int]] = []
        self.now = 0

    @on(FAST)
    def fast(self, msg: RangeReading) -> None:
        self.log.append(("fast", msg.stamp_ns, self.now))

    @on(SLOW)
    def slow(self, msg: BaroReading) -> Outputs:
        self.log.append(("slow", msg.stamp_ns, self.now))
        yield OUT(RangeReading(stamp_ns=msg.stamp_ns, range_m=0.0))


class Sink(Node):
    def __init__(self) -> None:
        self.stamps: list[int] = []

    @on(OUT)
    def out(self, msg: RangeReading) -> None:
        self.stamps.append(msg.stamp_ns)


class Recorder:
    def __init__(self) -> None:
        self.messages: list[tuple[int, str, str]] = []
        self.deliveries: list[tuple[int, str, str]] = []

    def published(self, now_ns, source, topic, message):
        self.messages.append((now_ns, source, topic.name))
        return len(self.messages) - 1

    def fed(self, now_ns, node, event, number):
        self.deliveries.append((now_ns, node, event))


def run(delay_ms: int, end_ms: int = 200):
    tap, worker, sink = Recorder(), Worker(), Sink()
    step = Lockstep([Source(), worker, sink], delays_ns={"Worker": {"slow": delay_ms * MS}}, tap=tap)
    step.run_until(end_ms * MS)
    return tap, worker, sink, step


def test_outputs_become_visible_only_after_sensor_and_compute_delay():
    tap, *_ = run(delay_ms=7)
    outs = [t for t, _, topic in tap.messages if topic == "out"]
    slows = [t for t, _, topic in tap.messages if topic == "slow"]
    assert slows[:3] == [3 * MS, 23 * MS, 43 * MS]
    assert outs[:3] == [10 * MS, 30 * MS, 50 * MS]


def test_a_busy_node_keeps_every_fast_message_but_only_the_newest_slow_one():
    _, worker, _, step = run(delay_ms=35, end_ms=400)
    fast = [s for kind, s, _ in worker.log if kind == "fast"]
    assert fast == [10 * MS * k for k in range(len(fast))]  # none lost, in order
    slow = [s for kind, s, _ in worker.log if kind == "slow"]
    assert slow == sorted(set(slow)) and 8 <= len(slow) <= 12  # one per 35 ms and a gap
    assert step.dropped["Worker"] > 0


def test_deliveries_never_run_backwards_in_time():
    tap, *_ = run(delay_ms=13)
    times = [t for t, *_ in tap.deliveries]
    assert times == sorted(times)


def test_a_timer_keeps_its_pace():
    tap, *_ = run(delay_ms=0)
    ticks = [t for t, node, event in tap.deliveries if (node, event) == ("Source", "fast")]
    assert ticks == [10 * MS * k for k in range(21)]


def test_the_log_holds_every_message_and_the_hash_repeats(tmp_path):
    def fly(path, delay):
        log = FlightLog(path)
        step = Lockstep([Source(), Worker(), Sink()], delays_ns={"Worker": {"slow": delay}}, tap=log)
        step.run_until(100 * MS)
        log.close()
        return log

    a, b, c = fly(tmp_path / "a", MS), fly(tmp_path / "b", MS), fly(tmp_path / "c", 2 * MS)
    assert a.flight_hash == b.flight_hash != c.flight_hash
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    messages = [e for e in read_log(tmp_path / "a") if e[0] == 0]
    assert len(messages) == sum(a.counts.values())
    assert decode(messages[0][4], RangeReading).stamp_ns == 0


class Camera(Node):
    """Publishes promises; `slow_to_come`: they are not ready when they are due."""

    def __init__(self, slow_to_come: bool) -> None:
        self.slow_to_come = slow_to_come

    @every(hz=40)
    def frame(self, now_ns: int) -> Outputs:
        yield FAST(Promise(RangeReading(stamp_ns=now_ns, range_m=3.0), not self.slow_to_come), delay_ns=5 * MS)


class Promise:
    def __init__(self, value: RangeReading, ready: bool) -> None:
        self.value, self._ready = value, ready

    def result(self) -> RangeReading:
        return self.value

    def ready(self) -> bool:
        return self._ready


class Moody(Node):
    """Answers every third message."""

    def __init__(self) -> None:
        self.stamps: list[int] = []

    @on(FAST)
    def fast(self, msg: RangeReading) -> Outputs:
        self.stamps.append(msg.stamp_ns)
        if len(self.stamps) % 3 == 0:
            yield OUT(msg)

    @on(SLOW)
    def slow(self, msg: BaroReading) -> Outputs:
        yield OUT(RangeReading(stamp_ns=msg.stamp_ns, range_m=float(len(self.stamps))))


@pytest.mark.parametrize("delay_ms", [3, 10, 25])
def test_when_something_is_computed_changes_neither_messages_nor_deliveries(delay_ms):
    def fly(slow_to_come):
        tap, moody = Recorder(), Moody()
        delays = {"Moody": {"fast": delay_ms * MS, "slow": 7 * MS}, "Worker": {"slow": delay_ms * MS}}
        step = Lockstep([Source(), Camera(slow_to_come), moody, Worker(), Sink()], delays_ns=delays, tap=tap)
        step.run_until(300 * MS)
        step.settle()
        return tap.messages, tap.deliveries, step.dropped, moody.stamps

    assert fly(slow_to_come=True) == fly(slow_to_come=False)


class Counter(Node):
    def __init__(self) -> None:
        self.count = 0

    @on(SLOW)
    def slow(self, msg: BaroReading) -> Outputs:
        self.count += 1
        yield OUT(RangeReading(stamp_ns=msg.stamp_ns, range_m=0.0))


def test_the_wait_for_a_sensor_is_used_for_what_was_put_off():
    def computed_by(end_ms, slow_to_come):
        counter, delays = Counter(), {"Counter": {"slow": 40 * MS}}
        step = Lockstep([Source(), Camera(slow_to_come), counter], delays_ns=delays, tap=Recorder())
        step.run_until(end_ms * MS)
        return counter.count

    assert [computed_by(4, True), computed_by(6, True)] == [0, 1]  # heard at 3 ms, the camera is due at 5 ms
    assert [computed_by(22, False), computed_by(24, False)] == [0, 1]  # known when the next one comes, at 23 ms


class Broken(Node):
    @on(SLOW)
    def slow(self, msg: BaroReading) -> Outputs:
        raise ValueError(f"altitude {msg.altitude_m}")


def test_what_a_node_raises_is_raised_by_the_run():
    step = Lockstep([Source(), Broken()], delays_ns={"Broken": {"slow": MS}}, tap=Recorder())
    with pytest.raises(ValueError, match=r"altitude 2\.0"):
        step.run_until(100 * MS)


def test_a_torn_log_reads_up_to_the_tear(tmp_path):
    log = FlightLog(tmp_path / "a")
    for k in range(3):
        log.published(k, "x", FAST, RangeReading(stamp_ns=k, range_m=0.5))
    log.close()
    data = (tmp_path / "a").read_bytes()
    (tmp_path / "a").write_bytes(data[:-5])
    assert [e[1] for e in read_log(tmp_path / "a")] == [0, 1]


def test_messages_survive_the_codec():
    message = RangeReading(stamp_ns=5, range_m=float("nan"))
    assert encode(decode(encode(message), RangeReading)) == encode(message)
