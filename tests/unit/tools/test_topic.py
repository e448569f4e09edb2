"""`companion topic list|info|echo|hz|bw|delay` against a node in another session."""

import time

import pytest

from companion.core.errors import CompanionError, InputError, LinkError
from companion.runtime.wire import foreign_type, service_type, wire_type
from companion.runtime.wire.keys import Qos

TEXT = "std_msgs/msg/String"
CLOUD = "sensor_msgs/msg/PointCloud2"


def words(k):
    return {"data": f"word {k}"}


def stamped(k):
    sec, nanosec = divmod(time.time_ns() - 50_000_000, 10**9)
    return {"header": {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": "odom"}, "twist": {"linear": {"x": k}}}


def test_list_shows_names_types_counts_and_hides_what_begins_with_an_underscore(graph, companion):
    node = graph.node("talker", namespace="/drone1")
    node.publisher("/drone1/said", wire_type(TEXT), Qos())
    node.publisher("/drone1/_secret", wire_type(TEXT), Qos())
    node.subscribe("/wanted", wire_type("std_msgs/msg/Bool"), Qos(), lambda arrival: None)
    assert companion("topic", "list").lines == ["/drone1/said", "/wanted"]
    assert companion("topic", "list", "--all").lines == ["/drone1/_secret", "/drone1/said", "/wanted"]
    assert companion("topic", "list", "-t").lines[0] == f"/drone1/said [{TEXT}]"
    assert companion("topic", "list", "--json").rows == [
        {"name": "/drone1/said", "types": [TEXT], "publishers": 1, "subscriptions": 0},
        {"name": "/wanted", "types": ["std_msgs/msg/Bool"], "publishers": 0, "subscriptions": 1},
    ]


def test_info_finds_a_bare_name_under_the_vehicle_and_shows_qos(graph, companion):
    graph.node("talker", namespace="/drone1").publisher(
        "/drone1/goal", wire_type(TEXT), Qos(transient_local=True, depth=1)
    )
    assert companion("topic", "info", "goal").lines == [
        "Topic: /drone1/goal", f"Type: {TEXT}", "Publisher count: 1", "Subscription count: 0",
    ]  # fmt: skip
    publisher = companion("topic", "info", "goal", "--json").rows[0]["publishers"][0]
    assert publisher["node"] == "/drone1/talker"
    assert publisher["durability"] == "transient_local"
    assert publisher["history"] == "keep_last (1)"
    assert publisher["type_hash"] == wire_type(TEXT).type_hash


def test_a_wrong_name_gives_the_nearest_ones(graph, companion):
    node = graph.node("talker", namespace="/drone1")
    for name in ("odometry", "lio_state"):
        node.publisher(f"/drone1/estimation/{name}", wire_type(TEXT), Qos())
    error = companion("topic", "hz", "estimation/odometri").error
    assert isinstance(error, InputError)
    assert error.exit_code == 2
    assert "/drone1/estimation/odometry" in str(error)
    assert "lio_state" not in str(error)


def test_no_bus_is_said_and_ends_with_3(companion, nowhere):
    for command in (("topic", "list"), ("topic", "hz", "x")):
        error = companion(*command, bus=nowhere).error
        assert isinstance(error, LinkError)
        assert error.exit_code == 3
        assert "companion sim" in str(error)


def test_echo_prints_yaml_blocks_as_ros2_does(talking, companion):
    with talking("/drone1/said", TEXT, words):
        result = companion("topic", "echo", "said", "-n", "3")
    assert result.code == 0
    assert result.lines[1::2] == ["---"] * 3
    numbers = [int(line.removeprefix("data: word ")) for line in result.lines[::2]]
    assert numbers == list(range(numbers[0], numbers[0] + 3))


def test_echo_of_a_field_as_csv_and_json(talking, companion):
    with talking("/drone1/twist", "geometry_msgs/msg/TwistStamped", stamped):
        linear = companion("topic", "echo", "twist", "--once", "--field", "twist.linear", "--csv").out
        frame = companion("topic", "echo", "twist", "--once", "--field", "header.frame_id").lines
        whole = companion("topic", "echo", "twist", "--once", "--json").rows[0]
        error = companion("topic", "echo", "twist", "--once", "--field", "twist.linar").error
    assert linear.strip().split(",")[1:] == ["0.0", "0.0"]
    assert frame == ["odom", "---"]
    assert whole["header"]["frame_id"] == "odom"
    assert isinstance(error, InputError)
    assert "linear, angular" in str(error)


def test_echo_cuts_long_arrays_but_not_in_json(talking, companion):
    with talking("/cloud", CLOUD, lambda k: {"data": bytes(range(200))}):
        text = companion("topic", "echo", "/cloud", "--once", "--field", "data").lines
        sizes = companion("topic", "echo", "/cloud", "--once", "--no-arr").out
        full = companion("topic", "echo", "/cloud", "--once", "--field", "data", "-f").lines
        rows = companion("topic", "echo", "/cloud", "--once", "--json").rows[0]
    assert text[:2] == ["- 0", "- 1"]
    assert text[127:] == ["- 127", "- '...'", "---"]
    assert "data: '<sequence of uint8, length: 200>'" in sizes or "data: <sequence of uint8, length: 200>" in sizes
    assert len(full) == 201
    assert rows["data"] == list(range(200))


def test_a_latched_message_is_echoed_though_it_was_said_before(graph, companion):
    kind = wire_type(TEXT)
    latched = Qos(transient_local=True, depth=1)
    graph.node("talker", namespace="/drone1").publisher("/drone1/goal", kind, latched).put(
        kind.encode({"data": "north"}), 1
    )
    assert companion("topic", "echo", "goal", "--once", "--for-s", "5").lines == ["data: north", "---"]


def test_silence_ends_with_1_and_says_so(graph, companion):
    graph.node("talker", namespace="/drone1").publisher("/drone1/said", wire_type(TEXT), Qos())
    for tool in ("echo", "hz", "bw"):
        error = companion("topic", tool, "said", "--for-s", "0.2").error
        assert isinstance(error, CompanionError)
        assert error.exit_code == 1
        assert "no message on /drone1/said" in str(error)


def test_hz_measures_rate_period_and_what_was_lost(talking, companion):
    with talking("/drone1/said", TEXT, words, hz=100.0, skip=range(30, 300, 10)):
        result = companion("topic", "hz", "said", "--for-s", "2.4", "--json")
    assert len(result.rows) == 3  # two seconds and the end
    last = result.rows[-1]
    assert last["rate_hz"] == pytest.approx(90.0, rel=0.1)
    assert last["lost"] == pytest.approx(20, abs=6)
    assert last["period_min_s"] <= 0.010 + 1e-3 < last["period_max_s"]


def test_hz_as_text_says_what_ros2_says(talking, companion):
    with talking("/drone1/said", TEXT, words, hz=100.0):
        lines = companion("topic", "hz", "said", "-n", "50").lines
    assert lines[-1].startswith("average rate: ")
    assert "window 49" in lines[-1]


def test_bw_measures_bytes(talking, companion):
    with talking("/cloud", CLOUD, lambda k: {"data": bytes(10_000)}, hz=50.0):
        last = companion("topic", "bw", "/cloud", "--for-s", "1.5", "--json").rows[-1]
    size = len(wire_type(CLOUD).encode({"data": bytes(10_000)}))
    assert last["size_min_bytes"] == last["size_max_bytes"] == size
    assert last["bytes_per_s"] == pytest.approx(50 * size, rel=0.15)


def test_delay_is_that_of_the_stamp_and_of_the_sending(talking, companion):
    with talking("/drone1/twist", "geometry_msgs/msg/TwistStamped", stamped):
        last = companion("topic", "delay", "twist", "-n", "40", "--json").rows[-1]
    assert 0.050 <= last["stamp_min_s"] < 0.070
    assert 0.0 < last["sent_min_s"] < 0.020
    assert last["stamp_mean_s"] - last["sent_mean_s"] == pytest.approx(0.05, abs=0.005)


def test_a_payload_that_is_none_is_reported_and_passed_over(graph, talking, companion):
    twist = wire_type("geometry_msgs/msg/TwistStamped")

    class Broken:
        name, dds_name, type_hash = twist.name, twist.dds_name, twist.type_hash

        def encode(self, value):
            return b"none" if value["twist"]["linear"]["x"] % 2 else twist.encode(value)

    with talking("/drone1/twist", Broken(), stamped):
        echoed = companion("topic", "echo", "twist", "-n", "6", "--field", "twist.linear.x", "--csv")
        measured = companion("topic", "delay", "twist", "-n", "6", "--json")
    assert len(echoed.lines) == 3
    assert all(float(x) % 2 == 0 for x in echoed.lines)
    assert measured.rows[-1]["window"] == 3


def test_control_characters_of_strangers_reach_no_terminal(talking, companion):
    with talking("/drone1/said", TEXT, lambda k: {"data": "a\x1b[31mb"}):
        lines = companion("topic", "echo", "said", "--once", "--csv").lines
    assert lines == ["a\N{REPLACEMENT CHARACTER}[31mb"]


def test_delay_of_a_type_without_header_is_refused(talking, companion):
    with talking("/drone1/said", TEXT, words):
        error = companion("topic", "delay", "said", "-n", "2").error
    assert "no header" in str(error)


STRANGE = """# of a package that is not bundled
int8 GOOD=3
int32[3] grid
geometry_msgs/Point[] corners
string<=10 label "none"
strange_msgs/Part[<=2] parts
"""
PART = "float32 x\nchar[] letters\nbool ok\nbyte flag\nwords/Nothing nothing\n"
RULE = "=" * 80
SCHEMA = (
    f"{STRANGE}{RULE}\nMSG: geometry_msgs/Point\nfloat64 x\nfloat64 y\nfloat64 z\n"
    f"{RULE}\nMSG: strange_msgs/Part\n{PART}{RULE}\nMSG: words/Nothing\n"
)
GETS = "type_description_interfaces/srv/GetTypeDescription"


def strange_type():
    return foreign_type("strange_msgs/msg/Whole", SCHEMA)


def strange_value(k):
    part = {"x": 0.5, "letters": b"ab", "ok": True, "flag": 7}
    return {"grid": [1, 2, k], "corners": [{"x": 1.0}], "label": "here", "parts": [part]}


def test_echo_of_a_type_that_is_not_bundled_needs_a_node_that_tells(talking, companion):
    with talking("/strange", strange_type(), strange_value):
        error = companion("topic", "echo", "/strange", "--once").error
        raw = companion("topic", "echo", "/strange", "--once", "--raw", "--json").rows[0]["raw"]
        measured = companion("topic", "hz", "/strange", "-n", "5").code
    assert "strange_msgs/msg/Whole" in str(error)
    assert "--raw" in str(error)
    assert strange_type().decode(bytes.fromhex(raw))["label"] == "here"
    assert measured == 0


def test_echo_builds_a_type_from_what_its_node_tells(graph, talking, companion, described):
    kind = service_type(GETS)
    asked = []

    def answer(request):
        asked.append(kind.request.decode(request))
        return kind.response.encode({"successful": True, "type_description": described(strange_type())})

    graph.node("talker", namespace="/drone1").serve("/drone1/talker/get_type_description", kind, answer)
    with talking("/strange", strange_type(), strange_value):
        row = companion("topic", "echo", "/strange", "--once", "--json").rows[0]
        part = companion("topic", "echo", "/strange", "--once", "--field", "parts.0.x").lines
    assert asked[0]["type_name"] == "strange_msgs/msg/Whole"
    assert asked[0]["type_hash"] == strange_type().type_hash
    assert row["grid"][:2] == [1, 2]
    assert row["corners"] == [{"x": 1.0, "y": 0.0, "z": 0.0}]
    assert row["parts"] == [{"x": 0.5, "letters": [97, 98], "ok": True, "flag": 7, "nothing": {}}]
    assert part == ["0.5", "---"]


def test_a_description_with_another_hash_is_refused(graph, talking, companion, described):
    kind = service_type(GETS)
    wrong = kind.response.encode({"successful": True, "type_description": described(wire_type(CLOUD))})
    graph.node("talker", namespace="/drone1").serve("/drone1/talker/get_type_description", kind, lambda request: wrong)
    with talking("/strange", strange_type(), strange_value):
        error = companion("topic", "echo", "/strange", "--once").error
    assert "another hash" in str(error)
