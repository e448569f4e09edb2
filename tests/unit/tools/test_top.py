"""Diagnostics of a live stack, and `companion top` that reads them."""

import threading
import time

import pytest

from companion.core import topics
from companion.runtime.bus.gaps import Gaps
from companion.runtime.bus.graph import Arrival
from companion.runtime.bus.reports import Reports
from companion.runtime.clock import Clock
from companion.runtime.diagnostics import ERROR, OK, WARN, Diagnoses, GroupReport
from companion.runtime.pipes import Beat, NodeBeat
from companion.runtime.pulse import Pulse
from companion.runtime.tools.ear import Ear, Limits
from companion.runtime.tools.top import statuses_of
from companion.runtime.wire import wire_type
from companion.runtime.wire.keys import Attachment

S = 1_000_000_000
ODOMETRY = topics.ODOMETRY.name


def beat(t_s, **changes):
    node = {
        "name": "PropagatorNode", "handled": 100 * t_s, "ticks": 0, "late_ticks": 0, "dropped": 3, "refused": 0,
        "waiting": 1, "cpu_s": 0.1 * t_s, "busy_s": 0.0, "worst_late_s": 0.001,
    } | changes  # fmt: skip
    return Beat(
        group="control", state="running", stamp_ns=t_s * S, cpu_s=0.3 * t_s, memory_mb=100.0, nodes=(NodeBeat(**node),)
    )


def report(t_s, *, silence_s=0.01, pid=7, down="", restarts=0, figures=None, **changes):
    flow = {f"published {ODOMETRY}": 100.0 * t_s, f"published silence {ODOMETRY}": silence_s, "bus_lost": 0.0}
    return GroupReport(
        group="control", pid=pid, restarts=restarts, down=down, beat=beat(t_s, **changes),
        figures=flow | (figures or {}), figures_ns=t_s * S,
    )  # fmt: skip


def told(*reports):
    """Statuses after the last report, by name."""
    diagnoses = Diagnoses("v")
    for r in reports:
        array = diagnoses.array([r], r.figures_ns)
    kind = wire_type("diagnostic_msgs/msg/DiagnosticArray")
    assert kind.decode(kind.encode(array))["status"][0]["name"] == "v/control"
    return {s["name"]: s for s in array["status"]}, {s.name: s for s in statuses_of(array)}


def test_rates_and_cpu_are_of_the_last_second():
    raw, seen = told(report(1), report(2), report(3))
    assert seen["control"].figure("cpu_percent") == pytest.approx(30.0)
    assert seen["control/PropagatorNode"].figure("cpu_percent") == pytest.approx(10.0)
    assert seen["control/PropagatorNode"].figure("handled_hz") == pytest.approx(100.0)
    assert seen[ODOMETRY].figure("rate_hz") == pytest.approx(100.0)
    assert seen[ODOMETRY].figure("deadline_s") == topics.ODOMETRY.deadline_s
    assert {s["level"] for s in raw.values()} == {OK}
    assert raw[f"v/topics/{ODOMETRY}"]["message"] == "flows"


def test_figures_that_did_not_change_keep_their_rate():
    same = report(2)
    _, seen = told(report(1), same, same)
    assert seen[ODOMETRY].figure("rate_hz") == pytest.approx(100.0)


@pytest.mark.parametrize(
    ("now", "name", "level", "says"),
    [
        (report(2, busy_s=0.8), "v/control/PropagatorNode", WARN, "busy for 0.8 s"),
        (report(2, late_ticks=4), "v/control/PropagatorNode", WARN, "4 ticks"),
        (report(2, refused=2), "v/control/PropagatorNode", WARN, "2 messages refused"),
        (report(2, down="silent for 0.6 s"), "v/control/PropagatorNode", ERROR, "silent for 0.6 s"),
        (report(2, down="silent for 0.6 s"), "v/control", ERROR, "down"),
        (report(2, figures={"bus_lost": 5.0}), "v/control", WARN, "lost 5 messages"),
        (report(2, figures={"link_connected": 0.0}), "v/control", WARN, "no link"),
        (report(2, silence_s=0.3), f"v/topics/{ODOMETRY}", WARN, "was silent for 0.30 s, 0.2 s are allowed"),
        (
            report(2, silence_s=1.5, figures={f"published {ODOMETRY}": 100.0}),
            f"v/topics/{ODOMETRY}", ERROR, "silent for 1.5 s",
        ),
    ],
)  # fmt: skip
def test_what_is_wrong_is_a_level_with_a_reason(now, name, level, says):
    raw, _ = told(report(1), now)
    assert raw[name]["level"] == level
    assert says in raw[name]["message"]


def test_a_warning_goes_with_its_cause():
    raw, _ = told(report(1), report(2, late_ticks=4), report(3, late_ticks=4))
    assert raw["v/control/PropagatorNode"]["level"] == OK


def test_a_restarted_process_does_not_count_backwards():
    raw, seen = told(report(50), report(51), report(1, pid=8, restarts=1), report(2, pid=8, restarts=1))
    assert seen["control"].figure("cpu_percent") == pytest.approx(30.0)
    assert seen["control"].figure("restarts") == 1
    assert {s["level"] for s in raw.values()} == {OK}


def test_a_topic_is_counted_by_its_publisher_or_else_by_who_hears_it():
    imu = topics.IMU.name
    hearing = GroupReport(
        group="perception", pid=1, restarts=0, down="", beat=None, figures_ns=S,
        figures={f"heard {t}": 0.0 for t in (imu, ODOMETRY)} | {f"heard silence {t}": 9.0 for t in (imu, ODOMETRY)},
    )  # fmt: skip
    array = Diagnoses("v").array([hearing, report(1)], S)
    seen = {s.name: s for s in statuses_of(array)}
    assert seen[ODOMETRY].values["counted_by"] == "control, published"
    assert seen[imu].values["counted_by"] == "perception, heard"
    assert seen[imu].level == "error"  # never heard at all
    assert "9.0 s" in seen[imu].message


def test_pulse_counts_and_tells_the_longest_silence_since_it_was_asked():
    now = [0]
    pulse = Pulse([topics.IMU], clock=lambda: now[0])
    for at_s in (1.0, 1.5, 4.5, 5.0):
        now[0] = int(at_s * S)
        pulse.publish(topics.ODOMETRY, None, 0)
    figures = pulse.figures("published")
    assert figures[f"published {ODOMETRY}"] == 4
    assert figures[f"published silence {ODOMETRY}"] == pytest.approx(3.0)
    assert figures["published sensors/imu"] == 0
    assert figures["published silence sensors/imu"] == pytest.approx(5.0)
    now[0] = 7 * S
    assert pulse.figures("published")[f"published silence {ODOMETRY}"] == pytest.approx(2.0)


def test_gaps_count_per_sender_from_the_first_that_was_heard():
    gaps, a, b = Gaps(), bytes(16), bytes([1] * 16)
    for gid, number in ((a, 10), (b, 1), (a, 11), (a, 14), (b, 2), (a, 12), (a, 14), (b, 4)):
        gaps.note(Attachment(number, 0, gid))
    gaps.note(None)
    assert gaps.lost == 3


def test_an_ear_bounds_what_waits_and_counts_what_it_left_out():
    ear = Ear(most_bytes=10_000)
    for _ in range(50):
        ear.put(Arrival(bytes(1000), None))
    heard = list(ear.until(threading.Event(), Limits(for_s=0.2)))
    assert len(heard) + ear.left_out == 50
    assert 6 <= len(heard) <= 8
    ear.put(Arrival(b"x", None))  # there is room again
    assert ear.take(0.0).payload == b"x"


def test_top_prints_what_a_supervisor_reports_and_who_else_is_there(graph, companion):
    stack = Reports(graph, clock=Clock.of_host(), vehicle="v")
    graph.node("talker", namespace="/drone1")
    ended = threading.Event()

    def work():
        t_s = 1
        while not ended.wait(0.05):
            stack.look([report(t_s)])
            t_s += 1

    thread = threading.Thread(target=work)
    thread.start()
    try:
        text = companion("top", "--once").out
        rows = companion("top", "--for-s", "1.5", "--json").rows
    finally:
        ended.set()
        thread.join()
    assert "PropagatorNode" in text and ODOMETRY in text and "/drone1/talker" in text
    assert "supervisor_reports" not in text
    assert len(rows) >= 2
    assert rows[-1]["nodes"][0]["name"] == "control/PropagatorNode"
    assert rows[-1]["age_s"] < 2.0


def test_top_without_a_stack_says_so(graph, companion):
    graph.node("talker", namespace="/drone1")
    assert "no companion run reports on this bus" in companion("top", "--once").out


def test_events_go_to_rosout_and_late_joiners_read_them(graph, companion):
    stack = Reports(graph, clock=Clock.of_host(), vehicle="v")
    stack.event("world is down: silent for 0.6 s")
    row = companion("topic", "echo", "/rosout", "--once", "--for-s", "5", "--json").rows[0]
    assert row["name"] == "v.supervisor"
    assert row["msg"] == "world is down: silent for 0.6 s"
    assert row["level"] == 30
    assert row["stamp"]["sec"] == pytest.approx(time.time(), abs=30)


def test_diagnostics_of_others_are_no_part_of_the_picture():
    status = {
        "level": 2,
        "name": "motor",
        "message": "hot",
        "hardware_id": "m1",
        "values": [{"key": "t", "value": "90"}],
    }
    assert statuses_of({"status": [status]}) == []
