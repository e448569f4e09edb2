"""The bad line does what it is told, both ways, and the same for the same seed."""

from __future__ import annotations

import contextlib
import socket
import time

import pytest

from tests.live.middleman import Count, Faults, Middleman


@pytest.fixture
def ends():
    """Vehicle and stack as plain sockets."""
    with contextlib.ExitStack() as stack:
        socks = [stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) for _ in range(2)]
        for sock in socks:
            sock.bind(("127.0.0.1", 0))
            sock.settimeout(2.0)
        yield socks


def through(vehicle, stack, faults, *, seed=1, number=200, down=False):
    """What came of `number` numbered datagrams, and how long each took."""
    with Middleman(towards=stack.getsockname(), seed=seed, faults=None if down else faults) as line:
        vehicle.sendto(b"first", ("127.0.0.1", line.port))
        sender, receiver, to, count = vehicle, stack, ("127.0.0.1", line.port), line.up_count
        if down:
            _, to = stack.recvfrom(100)
            line.down = faults
            sender, receiver, count = stack, vehicle, line.down_count
        for i in range(number):
            sender.sendto(f"{i} {time.monotonic()}".encode(), to)
            time.sleep(0.0002)
        expected = number + (0 if down else 1)
        end = time.monotonic() + 5
        while count.taken < expected or count.passed < count.taken - count.lost + count.doubled:
            assert time.monotonic() < end
            time.sleep(0.01)
        got, ages = [], []
        receiver.settimeout(0.1)
        with contextlib.suppress(TimeoutError):
            while True:
                data = receiver.recv(100)
                if data != b"first":
                    number, sent = data.split()
                    got.append(int(number))
                    ages.append(time.monotonic() - float(sent))
    return got, ages, count


def test_a_good_line_passes_everything_in_order(ends):
    got, _, count = through(*ends, Faults())
    assert got == list(range(200)) and count == Count(taken=201, passed=201)


@pytest.mark.parametrize("down", [False, True])
def test_loss_doubles_and_reordering_are_as_frequent_as_told(ends, down):
    got, _, count = through(*ends, Faults(loss=0.5, duplicate=0.2, reorder=0.1), down=down)
    assert count.lost == pytest.approx(100, abs=30)
    assert count.doubled == pytest.approx(20, abs=15) and count.held_back == pytest.approx(10, abs=9)
    assert len(got) > len(set(got)) and got != sorted(got) and set(got) < set(range(200))


def test_delay_holds_each_datagram_back(ends):
    _, ages, _ = through(*ends, Faults(delay_s=0.2, jitter_s=0.02), number=50)
    assert min(ages) >= 0.2 and len(ages) == 50


def test_the_seed_decides_and_faults_change_while_it_runs(ends):
    vehicle, stack = ends
    runs = [sorted(through(*ends, Faults(loss=0.3), seed=s)[0]) for s in (5, 5, 6)]
    assert runs[0] == runs[1] != runs[2]
    stack.settimeout(2.0)
    with Middleman(towards=stack.getsockname(), seed=1) as line:
        line.both_ways(Faults(loss=1.0))
        vehicle.sendto(b"lost", ("127.0.0.1", line.port))
        while line.up_count.lost < 1:
            time.sleep(0.005)
        line.both_ways(Faults())
        vehicle.sendto(b"passes", ("127.0.0.1", line.port))
        assert stack.recv(100) == b"passes"
