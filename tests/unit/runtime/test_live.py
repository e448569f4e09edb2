"""The laws of real time: keeping, order, isolation, pace; no test asserts how fast."""

import threading
import time

import pytest

from companion.core.errors import InputError
from companion.core.messages import BaroReading, RangeReading
from companion.core.node import Node, Outputs, Topic, every, on
from companion.runtime.bus.simulated_clock import set_by
from companion.runtime.clock import Clock
from companion.runtime.live import LiveGroup
from companion.runtime.mailbox import Bell, Mailbox, Parcel

FAST = Topic("fast", RangeReading, 100.0, "all")
SLOW = Topic("slow", BaroReading, 10.0, "latest")
OUT = Topic("out", RangeReading, 0.0, "all")


class Log:
    """Every entry in order, as a replay would read it."""

    def __init__(self):
        self.entries, self._lock = [], threading.Lock()

    def _note(self, *entry):
        with self._lock:
            self.entries.append(entry)
            return len(self.entries) - 1

    def received(self, now_ns, topic, message):
        return self._note("received", topic.name, message.stamp_ns)

    def published(self, now_ns, source, topic, message):
        return self._note("published", source, topic.name, message.stamp_ns)

    def fed(self, now_ns, node, event, number):
        self._note("fed", node, event, number)


class Wire:
    def __init__(self):
        self.sent = []

    def publish(self, topic, message, now_ns):
        self.sent.append((topic.name, message.stamp_ns))


class Relay(Node):
    publishes = (OUT,)

    def __init__(self):
        self.hold, self.seen = threading.Event(), []
        self.hold.set()

    @on(FAST)
    def fast(self, message: RangeReading) -> Outputs:
        self.hold.wait(5.0)
        self.seen.append(("fast", message.stamp_ns))
        yield OUT(RangeReading(stamp_ns=message.stamp_ns, range_m=message.range_m))

    @on(SLOW)
    def slow(self, message: BaroReading) -> None:
        self.seen.append(("slow", message.stamp_ns))


class Ear(Node):
    def __init__(self):
        self.stamps, self.ticks = [], []

    @on(OUT)
    def out(self, message: RangeReading) -> None:
        self.stamps.append(message.stamp_ns)

    @every(hz=200)
    def beat(self, now_ns: int) -> None:
        self.ticks.append(now_ns)


class Faulty(Node):
    @on(FAST)
    def fast(self, message: RangeReading) -> None:
        raise ZeroDivisionError("on purpose")


def reading(k):
    return RangeReading(stamp_ns=k, range_m=1.0)


def eventually(condition):
    for _ in range(1000):
        if condition():
            return
        time.sleep(0.01)
    raise AssertionError("never came true")


def group_of(*nodes, shared=False):
    log, wire = Log(), Wire()
    return LiveGroup(nodes, clock=Clock.of_host(), log=log, outlets=[wire], shared=shared), log, wire


def test_a_newer_message_replaces_the_waiting_one_and_all_means_all():
    box = Mailbox(Bell(), limit=3)
    for k in range(5):
        box.put(Parcel(FAST, reading(k)))
        box.put(Parcel(SLOW, BaroReading(stamp_ns=k, altitude_m=0.0)))
    taken = [(p.topic.name, p.open(lambda *_: 0)[0].stamp_ns) for p in iter(box.take, None)]
    assert [t for t in taken if t[0] == "slow"] == [("slow", 4)]
    assert [s for n, s in taken if n == "fast"] == [2, 3, 4][-len(taken) + 1 :]
    assert box.dropped == 10 - len(taken)


def test_a_bell_that_was_rung_before_is_heard_and_a_waiting_thread_is_woken():
    bell = Bell()
    with bell.lock:
        bell.ring()
    bell.wait(60.0)
    waiter = threading.Thread(target=bell.wait, args=(60.0,))
    waiter.start()
    Mailbox(bell).put(Parcel(FAST, reading(0)))
    waiter.join(5.0)
    assert not waiter.is_alive()


@pytest.mark.parametrize("shared", [False, True])
def test_messages_flow_through_the_group_in_order_and_out_of_it(shared):
    relay, ear = Relay(), Ear()
    group, log, wire = group_of(relay, ear, shared=shared)
    assert [t.name for t in group.wanted] == ["fast", "slow"]
    group.start()
    for k in range(50):
        group.receive(FAST, reading(k))
    eventually(lambda: len(ear.stamps) == 50)
    assert group.stop() == []
    assert ear.stamps == list(range(50))
    assert wire.sent == [("out", k) for k in range(50)]
    for number, entry in enumerate(log.entries):  # what is fed was noted before, under that number
        if entry[0] == "fed" and entry[3] >= 0:
            assert entry[3] < number
            assert entry[2] in log.entries[entry[3]]


def test_a_slow_node_holds_up_nobody_else():
    relay, ear = Relay(), Ear()
    relay.hold.clear()
    group, _, _ = group_of(relay, ear)
    group.start()
    group.receive(FAST, reading(0))
    for k in range(1, 6):
        group.receive(SLOW, BaroReading(stamp_ns=k, altitude_m=0.0))
    eventually(lambda: len(ear.ticks) > 20)
    assert relay.seen == []
    relay.hold.set()
    eventually(lambda: len(relay.seen) == 2)
    assert group.stop() == []
    assert relay.seen == [("fast", 0), ("slow", 5)]


def test_ticks_never_go_back_and_skip_what_was_missed():
    ear = Ear()
    group, _, _ = group_of(ear)
    group.start()
    eventually(lambda: len(ear.ticks) > 20)
    group.stop()
    assert ear.ticks == sorted(ear.ticks)
    (seat,) = group.seats
    span = round((ear.ticks[-1] - ear.ticks[0]) / 5e6)
    assert abs(len(ear.ticks) + seat.statistics.late_ticks - 1 - span) <= 2


def test_on_a_shared_thread_timers_come_between_messages():
    relay, ear = Relay(), Ear()
    group, _, _ = group_of(relay, ear, shared=True)
    group.start()
    for k in range(3000):
        group.receive(FAST, reading(k))
    eventually(lambda: ear.stamps and ear.stamps[-1] == 2999)
    assert group.stop() == []
    gaps = [b - a for a, b in zip(ear.ticks, ear.ticks[1:], strict=False)]
    assert len(ear.ticks) > 5 and sorted(gaps)[len(gaps) // 2] < 20e6  # the flood did not come first


def test_a_payload_is_decoded_once_for_all_and_a_bad_one_stops_nobody():
    calls = []

    def decode(payload):
        calls.append(payload)
        if payload == b"bad":
            raise InputError("no message")
        return reading(7)

    first, second = Relay(), Relay()
    group, log, _ = group_of(first, second)
    group.start()
    group.receive(FAST, b"bad", decode=decode)
    group.receive(FAST, b"good", decode=decode)
    eventually(lambda: first.seen and second.seen)
    group.stop()
    assert first.seen == second.seen == [("fast", 7)]
    assert calls.count(b"good") == 1
    assert [e for e in log.entries if e[0] == "received"] == [("received", "fast", 7)]
    assert [s.statistics.refused for s in group.seats] == [1, 1]


def test_a_node_that_raises_is_named():
    group, _, _ = group_of(Faulty())
    group.start()
    group.receive(FAST, reading(0))
    assert group.failed.wait(5.0)
    assert group.failure is not None and group.failure[0] == "Faulty"
    with pytest.raises(ZeroDivisionError):
        raise group.failure[1]
    group.stop()


def test_the_clock_never_steps_back():
    clock = Clock.of_host()
    stamps = [clock.now_ns() for _ in range(1000)]
    assert stamps == sorted(stamps)
    assert abs(stamps[-1] - time.time_ns()) < 5_000_000_000


@pytest.mark.parametrize("speed", [0.25, 0.5, 3.0])
def test_a_clock_set_by_a_simulators_shows_the_same_time_however_late_its_word_came(speed):
    now_ns = 1_800_000_000_000_000_000
    truth = Clock(0, speed, now_ns - 7_000_000_000)
    late_ns = (4_000_000, 200_000, 30_000_000, 1_000_000)
    sent_ns = [now_ns + k * 20_000_000 for k in range(4)]
    heard = [(sent + late, truth.shown_ns(sent)) for sent, late in zip(sent_ns, late_ns, strict=True)]
    clock = set_by(heard, Clock(0), speed=speed)
    error_ns = clock.shown_ns(now_ns) - truth.shown_ns(now_ns)
    assert -200_000 * max(speed, 1) - 1000 <= error_ns <= 0  # the least late word counts
    assert clock.shown_ns(now_ns + 10**9) - clock.shown_ns(now_ns) == pytest.approx(speed * 1e9)
