"""The laws of simulated time at the pace of a clock; the clock is an argument, so no test waits."""

import itertools
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.messages import BaroReading, RangeReading
from companion.core.node import Node, Outputs, Topic, every, on
from companion.runtime.paced import PATIENCE_NS, STEP_NS, Pace, Paced

MS = 1_000_000
START = 1_700_000_000_000_000_000  # a clock that counts since 1970
OUT = Topic("out", RangeReading, 100.0, "all")
SLOW = Topic("slow", BaroReading, 10.0)
IN = Topic("in", RangeReading, 0.0, "all")


class Rendered:
    """A message that is computed elsewhere, until it is told to be ready."""

    def __init__(self, message):
        self.message, self.there = message, False

    def ready(self):
        return self.there

    def result(self):
        assert self.there, "somebody waited for it"
        return self.message


class Vehicle(Node):
    publishes = (OUT, SLOW)

    def __init__(self, pending=None):
        self.heard, self.pending, self.now_ns = [], pending, 0

    @every(hz=100)
    def step(self, now_ns: int) -> Outputs:
        self.now_ns = now_ns
        yield OUT(RangeReading(stamp_ns=now_ns, range_m=0.0))
        if self.pending and now_ns == 10 * MS:
            yield SLOW(self.pending, delay_ns=5 * MS)

    @on(IN)
    def receive(self, msg: RangeReading) -> None:
        self.heard.append((self.now_ns, msg.range_m))


class Outlet:
    def __init__(self):
        self.sent = []

    def publish(self, topic, message, now_ns):
        self.sent.append((topic.name, message.stamp_ns, now_ns))

    def of(self, topic):
        return [(stamp, now) for name, stamp, now in self.sent if name == topic.name]


def run(paced, clock_ns, until_ns, *, cost_ns=100_000):
    """A loop that sleeps exactly and whose steps take `cost_ns` of the clock; returns the clock."""
    while clock_ns < until_ns:
        due_ns = paced.step(clock_ns)
        clock_ns = max(clock_ns + cost_ns, due_ns)
    return clock_ns


def flown(speed=1.0, pending=None):
    outlet, node = Outlet(), Vehicle(pending)
    return Paced([node], pace=Pace(START, speed=speed), outlets=[outlet]), node, outlet


@pytest.mark.parametrize("speed", [0.5, 1.0, 4.0])
def test_simulated_time_keeps_pace_and_stamps_count_from_the_start_of_the_clock(speed):
    paced, _, outlet = flown(speed)
    run(paced, START, START + 1_000 * MS)
    assert abs(paced.lockstep.now_ns - 1_000 * MS * speed) <= 2 * STEP_NS
    stamps = [stamp for stamp, _ in outlet.of(OUT)]
    assert stamps == [START + k * 10 * MS for k in range(len(stamps))]
    assert len(stamps) == pytest.approx(100 * speed, abs=2)
    assert paced.pace.slips == 0
    assert paced.late_ms(100) * MS < STEP_NS


def test_a_step_before_its_time_does_nothing_and_says_when_it_is_due():
    paced, _, _ = flown()
    assert paced.step(START + STEP_NS - 1) == START + STEP_NS
    assert paced.lockstep.now_ns == 0
    assert paced.step(START + STEP_NS) == START + 2 * STEP_NS
    assert paced.lockstep.now_ns == STEP_NS


def test_a_short_pause_is_caught_up_without_a_slip():
    paced, _, _ = flown()
    clock = run(paced, START, START + 500 * MS)
    clock = run(paced, clock + 150 * MS, clock + 400 * MS)
    assert paced.pace.slips == 0
    assert paced.lockstep.now_ns == pytest.approx(clock - START, abs=2 * STEP_NS)
    assert paced.late_ms(100) == pytest.approx(150.0, abs=3.0)


def test_a_long_pause_is_left_out_and_later_stamps_are_the_clocks_again():
    paced, _, outlet = flown()
    clock = run(paced, START, START + 500 * MS)
    clock = run(paced, clock + 1_000 * MS, clock + 1_500 * MS)
    assert paced.pace.slips == 1
    assert paced.pace.slipped_ns == pytest.approx(1_000 * MS, abs=2 * STEP_NS)
    stamps = [stamp for stamp, _ in outlet.of(OUT)]
    gaps = [b - a for a, b in itertools.pairwise(stamps)]
    assert sorted(gaps)[-2] == 10 * MS  # one gap, and no stamp twice
    assert max(gaps) == pytest.approx(1_010 * MS, abs=2 * STEP_NS)
    assert clock - stamps[-1] <= 10 * MS + 2 * STEP_NS


def test_a_computer_at_half_the_speed_slips_and_does_not_spiral():
    paced, _, outlet = flown()
    clock = run(paced, START, START + 10_000 * MS, cost_ns=2 * STEP_NS)
    assert paced.lockstep.now_ns == pytest.approx(5_000 * MS, rel=0.01)
    assert paced.pace.slipped_ns == pytest.approx(5_000 * MS, abs=2 * PATIENCE_NS)
    stamps = [stamp for stamp, _ in outlet.of(OUT)]
    assert clock - stamps[-1] <= PATIENCE_NS + 10 * MS + 2 * STEP_NS
    assert paced.late_ms(100) * MS <= PATIENCE_NS + 2 * STEP_NS


def test_what_was_sampled_before_a_slip_keeps_its_stamp():
    frame = Rendered(BaroReading(stamp_ns=9 * MS, altitude_m=0.0))
    paced, _, outlet = flown(pending=frame)
    clock = run(paced, START, START + 12 * MS)
    clock = run(paced, clock + 700 * MS, clock + 720 * MS)
    frame.there = True
    run(paced, clock, clock + 10 * MS)
    assert paced.pace.slips == 1
    ((stamp, now),) = outlet.of(SLOW)
    assert stamp == START + 9 * MS
    assert now > START + 700 * MS


def test_a_message_that_is_not_ready_comes_late_and_nobody_waits_for_it():
    frame = Rendered(BaroReading(stamp_ns=9 * MS, altitude_m=0.0))
    paced, _, outlet = flown(pending=frame)
    clock = run(paced, START, START + 300 * MS)
    assert len(outlet.of(OUT)) == pytest.approx(30, abs=1)
    assert outlet.of(SLOW) == []
    assert paced.lockstep.late == {"slow": 1}
    frame.there = True
    run(paced, clock, clock + 10 * MS)
    ((stamp, now),) = outlet.of(SLOW)
    assert stamp == START + 9 * MS
    assert now - START == pytest.approx(300 * MS, abs=2 * STEP_NS)


def test_a_message_that_is_ready_comes_in_time():
    frame = Rendered(BaroReading(stamp_ns=9 * MS, altitude_m=0.0))
    frame.there = True
    paced, _, outlet = flown(pending=frame)
    run(paced, START, START + 30 * MS)
    assert outlet.of(SLOW) == [(START + 9 * MS, START + 15 * MS)]
    assert paced.lockstep.late == {}


def test_posts_of_many_threads_all_arrive_in_each_threads_order_and_are_not_sent_back():
    paced, node, outlet = flown()

    def speak(first):
        for k in range(500):
            paced.post(IN(RangeReading(stamp_ns=0, range_m=float(first + k))))

    threads = [threading.Thread(target=speak, args=(1000 * n,)) for n in range(4)]
    for thread in threads:
        thread.start()
    clock = run(paced, START, START + 50 * MS)
    for thread in threads:
        thread.join()
    run(paced, clock, clock + 10 * MS)
    values = [value for _, value in node.heard]
    assert sorted(values) == sorted(float(1000 * n + k) for n in range(4) for k in range(500))
    for n in range(4):
        own = [v for v in values if 1000 * n <= v < 1000 * n + 500]
        assert own == sorted(own)
    assert {name for name, *_ in outlet.sent} == {"out"}


@given(st.floats(0.05, 20.0), st.integers(0, 10**14), st.integers(0, 10**12))
def test_due_and_clock_are_inverse(speed, sim_ns, slipped_ns):
    pace = Pace(START, speed=speed)
    pace.slip(0, slipped_ns)
    assert pace.due_ns(pace.clock_ns(sim_ns)) == pytest.approx(sim_ns, abs=speed + 1)
