"""Acknowledgement, retransmission, timeout, replacement."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from companion.autopilot.commands import CommandDesk, Verdict
from companion.autopilot.modes import mode_name, order


def ack(command: int, result: int) -> SimpleNamespace:
    return SimpleNamespace(command=command, result=result)


def ask(kind: str, flavour="px4"):
    return order(kind, flavour, system=1, component=1)


def desk() -> CommandDesk:
    return CommandDesk(ack_ticks=5, attempts=3)


@pytest.mark.parametrize(
    ("result", "verdict"),
    [
        (0, Verdict("arm", True, "")),
        (1, Verdict("arm", False, "temporarily rejected")),
        (2, Verdict("arm", False, "denied")),
        (3, Verdict("arm", False, "not supported")),
        (4, Verdict("arm", False, "failed")),
        (200, Verdict("arm", False, "result 200")),
    ],
)
def test_an_acknowledgement_ends_its_command_once(result, verdict):
    d = desk()
    assert d.submit("arm", ask("arm")) == (True, None)
    assert d.acknowledge(ack(176, result)) is None  # of another command
    assert d.acknowledge(ack(400, result)) == verdict
    assert d.acknowledge(ack(400, result)) is None  # a duplicate


def test_retransmission_counts_up_then_gives_up():
    d = desk()
    d.submit("arm", ask("arm"))
    log = [d.tick() for _ in range(20)]
    again = [(i + 1, r.confirmation) for i, (requests, _) in enumerate(log) for r in requests]
    ended = [(i + 1, v) for i, (_, verdicts) in enumerate(log) for v in verdicts]
    assert again == [(5, 1), (10, 2)]
    assert ended == [(15, Verdict("arm", False, "timeout"))]


def test_in_progress_keeps_it_waiting():
    d = desk()
    d.submit("land", ask("land"))
    for _ in range(10):
        for _ in range(4):
            assert d.tick() == ([], [])
        assert d.acknowledge(ack(176, 5)) is None
    assert d.acknowledge(ack(176, 0)) == Verdict("land", True, "")


def test_the_same_command_is_not_sent_twice_and_a_newer_mode_replaces_the_older():
    d = desk()
    d.submit("offboard", ask("offboard"))
    assert d.submit("offboard", ask("offboard")) == (False, None)
    assert d.submit("land", ask("land")) == (True, Verdict("offboard", False, "replaced by land"))
    assert d.submit("disarm", ask("disarm")) == (True, None)  # another MAV_CMD waits beside it
    assert d.acknowledge(ack(176, 0)) == Verdict("land", True, "")


@pytest.mark.parametrize(
    ("kind", "px4", "copter"),
    [
        ("arm", (400, 1, 0, 0), (400, 1, 0, 0)),
        ("disarm", (400, 0, 0, 0), (400, 0, 0, 0)),
        ("offboard", (176, 1, 6, 0), (176, 1, 4, 0)),
        ("hold", (176, 1, 4, 3), (176, 1, 17, 0)),
        ("return", (176, 1, 4, 5), (176, 1, 6, 0)),
        ("land", (176, 1, 4, 6), (176, 1, 9, 0)),
    ],
)
def test_orders(kind, px4, copter):
    for flavour, expected in (("px4", px4), ("ardupilot", copter)):
        m = ask(kind, flavour)
        assert (m.command, m.param1, m.param2, m.param3) == expected
        assert (m.param4, m.param7, m.confirmation) == (0, 0, 0)


@pytest.mark.parametrize("kind", ["offboard", "hold", "return", "land"])
def test_an_ordered_mode_is_reported_under_the_same_word(kind):
    px4, copter = ask(kind), ask(kind, "ardupilot")
    px4_mode = int(px4.param2) << 16 | int(px4.param3) << 24
    assert mode_name(px4_mode, "px4") == kind.upper()
    assert mode_name(int(copter.param2), "ardupilot") == kind.upper()
