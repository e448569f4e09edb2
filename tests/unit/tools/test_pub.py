"""`companion topic pub`, `node`, `service` against endpoints in another session."""

import itertools
import threading
import time

import pytest

from companion.core.errors import CompanionError, InputError, LinkError
from companion.runtime.tools.values import parse_values, stamped
from companion.runtime.wire import WireError, service_type, wire_type
from companion.runtime.wire.keys import Qos

TWIST = "geometry_msgs/msg/TwistStamped"


class Inbox:
    """Decoded messages of a subscription."""

    def __init__(self, graph, name, kind):
        self.got, self.attachments = [], []
        self._kind = wire_type(kind)
        graph.node("listener", namespace="/drone1").subscribe(name, self._kind, Qos(), self._take)

    def _take(self, arrival):
        self.got.append(self._kind.decode(arrival.payload))
        self.attachments.append(arrival.attachment)


def test_every_published_message_arrives_with_numbers_from_1_and_fresh_stamps(graph, companion):
    inbox = Inbox(graph, "/drone1/cmd", TWIST)
    before_ns = time.time_ns()
    result = companion(
        "topic", "pub", "cmd", "geometry_msgs/TwistStamped", "{header: auto, twist: {linear: {x: 1e-3}}}",
        "-r", "50", "-t", "5", "--json",
    )  # fmt: skip
    assert result.error is None
    assert len(inbox.got) == len(result.rows) == 5
    assert [a.sequence for a in inbox.attachments] == [1, 2, 3, 4, 5]
    assert inbox.got[0]["twist"] == {
        "linear": {"x": 1e-3, "y": 0.0, "z": 0.0}, "angular": {"x": 0.0, "y": 0.0, "z": 0.0},
    }  # fmt: skip
    stamps = [m["header"]["stamp"]["sec"] * 10**9 + m["header"]["stamp"]["nanosec"] for m in inbox.got]
    assert before_ns <= stamps[0] and stamps[-1] <= time.time_ns()
    assert [b - a for a, b in itertools.pairwise(stamps)] == pytest.approx([2e7] * 4, rel=0.5)


def test_nobody_listens_is_said_unless_told_not_to_wait(graph, companion):
    error = companion("topic", "pub", "/cmd", TWIST, "--once", "--wait-s", "0.3").error
    assert isinstance(error, LinkError)
    assert "0 of 1 subscriptions to /cmd" in str(error)
    assert companion("topic", "pub", "/cmd", TWIST, "--once", "-w", "0").code == 0


def test_it_waits_for_a_subscription_that_comes(graph, companion):
    boxes = []
    timer = threading.Timer(0.5, lambda: boxes.append(Inbox(graph, "/cmd", TWIST)))
    timer.start()
    assert companion("topic", "pub", "/cmd", TWIST, "--once").code == 0
    timer.join()
    assert len(boxes[0].got) == 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (("geometry_msgs/msg/TwistStampd",), "geometry_msgs/msg/TwistStamped"),
        ((TWIST, "{twist: {liner: {x: 1}}}"), "linear, angular"),
        ((TWIST, "{twist: {linear: {x: fast}}}"), "twist.linear.x"),
        ((TWIST, "[1, 2]"), "no mapping"),
        ((TWIST, "{x: ["), "no YAML"),
        (("std_msgs/msg/String",), TWIST),
        ((TWIST, "{}", "--qos-reliability", "perhaps"), "reliable, best_effort"),
    ],
)
def test_what_is_wrong_is_named_before_anything_is_sent(graph, companion, arguments, says):
    inbox = Inbox(graph, "/cmd", TWIST)
    error = companion("topic", "pub", "/cmd", *arguments, "--once").error
    assert isinstance(error, InputError)
    assert says in str(error)
    assert inbox.got == []


def test_now_and_auto_reach_into_lists_and_only_where_a_time_is_meant():
    path, text = wire_type("nav_msgs/msg/Path"), wire_type("std_msgs/msg/String")
    filled = stamped(path, {"header": "auto", "poses": [{"header": {"stamp": "now"}}]}, 3_000_000_005)
    assert filled["header"] == {"stamp": {"sec": 3, "nanosec": 5}}
    assert filled["poses"][0]["header"] == {"stamp": {"sec": 3, "nanosec": 5}}
    assert stamped(text, {"data": "now"}, 1) == {"data": "now"}
    assert parse_values("") == {}


def test_a_latched_publication_is_kept_for_late_joiners_while_it_runs(graph, companion):
    boxes = []
    listening = threading.Timer(0.6, lambda: boxes.append(LatchedInbox(graph)))
    listening.start()
    companion(
        "topic", "pub", "/said", "std_msgs/msg/String", "data: north", "-w", "0", "-r", "0.5", "--for-s", "2",
        "--qos-durability", "transient_local", "--qos-depth", "1",
    )  # fmt: skip
    listening.join()
    assert boxes[0].got == ["north"]


class LatchedInbox:
    def __init__(self, graph):
        self.got = []
        kind = wire_type("std_msgs/msg/String")
        latched = Qos(transient_local=True, depth=1)
        graph.node("late").subscribe("/said", kind, latched, lambda a: self.got.append(kind.decode(a.payload)["data"]))


def test_nodes_and_what_they_speak(graph, companion):
    node = graph.node("talker", namespace="/drone1")
    node.publisher("/drone1/said", wire_type("std_msgs/msg/String"), Qos())
    node.subscribe("/cmd", wire_type(TWIST), Qos(), lambda arrival: None)
    node.serve("/drone1/talker/reset", service_type("std_srvs/srv/Trigger"), lambda request: request)
    graph.node("_hidden")
    assert companion("node", "list").lines == ["/drone1/talker"]
    assert companion("node", "list", "--all").lines == ["/_hidden", "/drone1/talker"]
    assert companion("node", "info", "talker").lines == [
        "/drone1/talker",
        "  Subscribers:",
        f"    /cmd: {TWIST}",
        "  Publishers:",
        "    /drone1/said: std_msgs/msg/String",
        "  Service Servers:",
        "    /drone1/talker/reset: std_srvs/srv/Trigger",
        "  Service Clients:",
    ]
    row = companion("node", "info", "talker", "--json").rows[0]
    assert row["service_servers"] == {"/drone1/talker/reset": "std_srvs/srv/Trigger"}
    assert "/drone1/talker" in str(companion("node", "info", "tolker").error)


def test_services_are_listed_and_called(graph, companion):
    kind = service_type("std_srvs/srv/SetBool")

    def answer(request):
        on = kind.request.decode(request)["data"]
        return kind.response.encode({"success": on, "message": "lamp"})

    graph.node("talker", namespace="/drone1").serve("/drone1/lamp", kind, answer)
    assert companion("service", "list", "-t").lines == ["/drone1/lamp [std_srvs/srv/SetBool]"]
    assert companion("service", "call", "lamp", "std_srvs/SetBool", "{data: true}").lines == [
        "success: true", "message: lamp",
    ]  # fmt: skip
    assert companion("service", "call", "lamp", "", "--json").rows == [{"success": False, "message": "lamp"}]
    assert "data" in str(companion("service", "call", "lamp", "", "{date: true}").error)
    assert "/drone1/lamp" in str(companion("service", "call", "lump", "").error)


def test_a_service_that_refuses_or_keeps_silent_ends_with_1(graph, companion):
    kind = service_type("std_srvs/srv/Trigger")

    def refuse(request):
        raise WireError("not now")

    def sleep(request):
        time.sleep(0.5)
        return kind.response.encode({})

    node = graph.node("talker", namespace="/drone1")
    node.serve("/drone1/refuses", kind, refuse)
    node.serve("/drone1/sleeps", kind, sleep)
    refused = companion("service", "call", "refuses", "").error
    silent = companion("service", "call", "sleeps", "", "--timeout-s", "0.1").error
    assert isinstance(refused, CompanionError) and "not now" in str(refused) and refused.exit_code == 1
    assert isinstance(silent, CompanionError) and "0.1 s" in str(silent) and silent.exit_code == 1
