"""CDR: round trips of every bundled type, the independent serializer of rosbags, laws of the layout."""

import struct
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rosbags.typesys import Stores, get_typestore

from companion.core.errors import InputError
from companion.runtime.wire import WireError, WireType, bundled_types, foreign_type, plain, service_type, wire_type

MESSAGES = [n for n in bundled_types() if "/msg/" in n]
HALVES = [f"{n}_{half}" for n in bundled_types() if "/srv/" in n for half in ("Request", "Response")]
ROSBAGS = get_typestore(Stores.ROS2_KILTED)
ZOO = """
uint8 LIMIT=3
bool[3] flags
char letter 65
byte raw
float64 ratio 1.5
int16[<=3] few [1, -2]
string<=5 short "a#b"
string<=5[<=2] shorts
string[2] pair
geometry_msgs/Vector3[2] ends
geometry_msgs/Point32[<=2] corners
std_msgs/Empty nothing
std_msgs/Empty[] nothings
builtin_interfaces/Time[] times
float64[] last
"""


@pytest.fixture(scope="module")
def zoo() -> WireType:
    return foreign_type("zoo_msgs/msg/Zoo", ZOO)


@pytest.mark.parametrize("name", MESSAGES + HALVES)
def test_round_trip_in_both_byte_orders(name: str, random_value: Any) -> None:
    wire, rng = wire_type(name), np.random.default_rng(7)
    for _ in range(12):
        value = random_value(wire, rng)
        payload = wire.encode(value)
        again = wire.decode(payload)
        np.testing.assert_equal(plain(again), plain(value))
        assert wire.encode(again) == payload
        assert wire.encode(plain(value)) == payload
    assert wire.encode({}) == wire.encode(wire.default())


@pytest.mark.parametrize("name", [n for n in MESSAGES if n in ROSBAGS.types])
def test_same_bytes_as_rosbags(name: str, random_value: Any) -> None:
    wire, rng = wire_type(name), np.random.default_rng(11)
    for _ in range(8):
        value = random_value(wire, rng)
        payload = wire.encode(value)
        theirs = bytes(ROSBAGS.serialize_cdr(_rosbags(name, value), name))
        assert theirs == payload or theirs.rstrip(b"\0") == payload.rstrip(b"\0")
        big = bytes(ROSBAGS.serialize_cdr(_rosbags(name, value), name, little_endian=False))
        np.testing.assert_equal(plain(wire.decode(big)), plain(value))


def test_rosbags_knows_nearly_all() -> None:
    missing = [n for n in MESSAGES if n not in ROSBAGS.types and not n.startswith("understory_msgs/")]
    assert missing == []


def _rosbags(name: str, value: dict[str, Any]) -> Any:
    kind = ROSBAGS.types[name]
    parts = {}
    for field in wire_type(name).fields:
        inner = value[field.name]
        if field.type.nested:
            inner = (
                _rosbags(field.type.base, inner)
                if field.type.array == "one"
                else [_rosbags(field.type.base, v) for v in inner]
            )
        elif (field.type.base, field.type.array) == ("byte", "one"):
            inner -= 256 if inner > 127 else 0  # rosbags has it signed; the bits are the same
        parts[field.name] = inner
    return kind(**parts)


def test_layout_by_hand() -> None:
    """Header, then string: count 3 with NUL, padding to 8 before the double."""
    wire = foreign_type("a_msgs/msg/A", "string s\nfloat64 x\nuint8 b\nuint16 h\n")
    expected = b"\0\1\0\0" + b"\3\0\0\0ab\0" + b"\0" + struct.pack("<d", 2.0) + b"\7" + b"\0" + b"\1\2"
    assert wire.encode({"s": "ab", "x": 2.0, "b": 7, "h": 0x0201}) == expected
    big = b"\0\0\0\0" + b"\0\0\0\3ab\0" + b"\0" + struct.pack(">d", 2.0) + b"\7" + b"\0" + b"\2\1"
    assert wire.decode(big) == wire.decode(expected) == {"s": "ab", "x": 2.0, "b": 7, "h": 0x0201}


def test_defaults_of_the_text(zoo: WireType) -> None:
    value = plain(zoo.default())
    assert (value["letter"], value["ratio"], value["few"], value["short"]) == (65, 1.5, [1, -2], "a#b")
    assert value["flags"] == [False] * 3 and value["pair"] == ["", ""] and value["nothing"] == {}
    assert zoo.constants == {"LIMIT": 3}
    assert wire_type("geometry_msgs/msg/Quaternion").default() == {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}


@given(seed=st.integers(0, 2**32), data=st.data())
def test_zoo_round_trip(zoo: WireType, seed: int, data: Any) -> None:
    rng = np.random.default_rng(seed)
    texts = st.text(max_size=1)
    value = zoo.default() | {
        "flags": np.array(data.draw(st.lists(st.booleans(), min_size=3, max_size=3))),
        "shorts": data.draw(st.lists(texts, max_size=2)),
        "pair": data.draw(st.lists(st.text(), min_size=2, max_size=2)),
        "ends": rng.normal(size=(2, 3)),
        "corners": rng.normal(size=(data.draw(st.integers(0, 2)), 3)).astype(np.float32),
        "nothings": [{}] * data.draw(st.integers(0, 3)),
        "times": [{"sec": s, "nanosec": 1} for s in data.draw(st.lists(st.integers(-9, 9), max_size=3))],
        "last": rng.normal(size=data.draw(st.integers(0, 3))),
    }
    payload = zoo.encode(value)
    again = zoo.decode(payload)
    assert zoo.encode(again) == payload
    for name in ("flags", "last"):
        assert again[name].tobytes() == value[name].tobytes()
    assert again["ends"].tobytes() == value["ends"].tobytes()
    assert again["corners"].view("f4").tobytes() == value["corners"].tobytes()
    assert (again["shorts"], again["pair"]) == (value["shorts"], value["pair"])


def test_struct_sequences_take_arrays_lists_and_mixed_numbers() -> None:
    wire = wire_type("geometry_msgs/msg/Polygon")
    rows = [{"x": 1.0, "y": 2.0, "z": 3.0}, {"x": 4.0, "y": 5.0, "z": 6.0}]
    listed = wire.encode({"points": rows})
    array = np.array([[1, 2, 3], [4, 5, 6]], np.float32)
    wide = np.zeros((4, 3), np.float32)
    wide[::2] = array
    for points in (array, array.astype(float), array.tolist() and wide[::2], np.asfortranarray(array)):
        assert wire.encode({"points": points}) == listed
    assert wire.encode({"points": wire.decode(listed)["points"]}) == listed
    assert wire.encode(SimpleNamespace(points=[SimpleNamespace(**row) for row in rows])) == listed


def test_bytes_are_not_copied_and_numbers_are_aligned_and_read_only() -> None:
    image = wire_type("sensor_msgs/msg/Image")
    payload = image.encode({"height": 1, "width": 4, "data": b"abcd"})
    data = image.decode(payload)["data"]
    assert np.shares_memory(data, np.frombuffer(payload, np.uint8)) and not data.flags.writeable
    scan = wire_type("sensor_msgs/msg/LaserScan")
    ranges = scan.decode(bytearray(scan.encode({"ranges": np.arange(5, dtype=np.float32)})))["ranges"]
    assert ranges.flags.aligned and not ranges.flags.writeable
    multi = wire_type("std_msgs/msg/Float64MultiArray")
    assert multi.decode(multi.encode({"data": [1.0, 2.0]}))["data"].flags.aligned


BAD_VALUES = [
    ("geometry_msgs/msg/PoseStamped", {"pose": {"positon": {}}}, "pose.positon: .*meant position.*valid: position"),
    ("geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": "1"}}}, "pose.position.x: '1' is no float64"),
    ("geometry_msgs/msg/PoseStamped", {"pose": 3}, "pose: 3 is no geometry_msgs/msg/Pose"),
    ("std_msgs/msg/UInt8", {"data": 256}, r"data: 256 is no uint8 \(valid: 0..255\)"),
    ("std_msgs/msg/UInt8", {"data": 1.0}, "data: 1.0 is no uint8"),
    ("std_msgs/msg/Bool", {"data": "false"}, "data: 'false' is no bool"),
    ("std_msgs/msg/Float32", {"data": 1e39}, "does not fit into float32"),
    ("std_msgs/msg/Float64", {"data": True}, "data: True is no float64"),
    ("std_msgs/msg/String", {"data": b"x"}, "data: b'x' is no string"),
    ("std_msgs/msg/String", {"data": "\ud800"}, "no valid Unicode"),
    ("std_msgs/msg/Header", {"stamp": {"sec": 2**31}}, "stamp.sec: 2147483648 is no int32"),
    ("sensor_msgs/msg/Imu", {"orientation_covariance": [1.0]}, "orientation_covariance: 1 elements, 9 wanted"),
    ("sensor_msgs/msg/Imu", {"orientation_covariance": [None] * 9}, r"orientation_covariance\[0\]: None is no"),
    ("nav_msgs/msg/Path", {"poses": [{}, {"header": {"frame": ""}}]}, r"poses\[1\].header.frame"),
    ("nav_msgs/msg/Path", {"poses": "ab"}, "poses: 'ab' is no list of geometry_msgs/msg/PoseStamped"),
    ("geometry_msgs/msg/Polygon", {"points": np.zeros((2, 2))}, r"valid: \(N, 3\)"),
    ("rcl_interfaces/msg/ParameterDescriptor", {"integer_range": [{}, {}]}, "2 elements, 1 is the most"),
    ("std_msgs/msg/String", [1], r"\[1\] is no std_msgs/msg/String"),
]


@pytest.mark.parametrize(("name", "value", "match"), BAD_VALUES)
def test_a_wrong_value_is_named(name: str, value: Any, match: str) -> None:
    with pytest.raises(InputError, match=match):
        wire_type(name).complete(value)


def test_what_the_writer_cannot_take_is_named_by_encode() -> None:
    with pytest.raises(InputError, match=r"pose\.positon"):
        wire_type("geometry_msgs/msg/PoseStamped").encode({"pose": {"positon": {}}})


BAD_PAYLOADS = [
    ("std_msgs/msg/String", "", "no CDR header"),
    ("std_msgs/msg/String", "000700000100000000", "no CDR header"),  # XCDR2
    ("std_msgs/msg/String", "00010000ffffffff6100", "does not end"),
    ("std_msgs/msg/String", "00010000020000006161", "does not end"),
    ("std_msgs/msg/String", "0001000002000000ff00", "malformed"),
    ("std_msgs/msg/Float64MultiArray", "000100000000000000000000ffffffff", "4294967295 elements announced"),
    ("nav_msgs/msg/Path", "00010000" + "00" * 12 + "ffffff0f", "elements announced"),
    ("std_msgs/msg/Int64", "0001000001", "malformed"),
]


@pytest.mark.parametrize(("name", "payload", "match"), BAD_PAYLOADS)
def test_a_malformed_payload_is_a_wire_error(name: str, payload: str, match: str) -> None:
    with pytest.raises(WireError, match=match):
        wire_type(name).decode(bytes.fromhex(payload))


def test_bytes_behind_the_value_are_ignored() -> None:
    """Fast CDR leaves 24 of them behind a ParameterEvent."""
    wire = wire_type("rcl_interfaces/msg/ParameterEvent")
    assert plain(wire.decode(wire.encode({"node": "/a"}) + bytes(24)))["node"] == "/a"


def test_bounds_hold_on_the_wire_too(zoo: WireType) -> None:
    loose = foreign_type("zoo_msgs/msg/Zoo", ZOO.replace("<=5", "").replace("<=3", "").replace("<=2", ""))
    for name, value in (("short", "123456"), ("few", [1, 2, 3, 4]), ("shorts", ["", "", ""]), ("corners", [{}] * 3)):
        with pytest.raises(WireError, match="is the most"):
            zoo.decode(loose.encode({name: value}))
        with pytest.raises(InputError, match="is the most"):
            zoo.encode({name: value})


def test_a_service_is_two_types() -> None:
    trigger = service_type("std_srvs/srv/Trigger")
    reply = trigger.response.encode({"success": True, "message": "up"})
    assert trigger.response.decode(reply) == {"success": True, "message": "up"}
    assert trigger.request.encode({}) == b"\0\1\0\0\0"  # an empty struct is one byte
    with pytest.raises(InputError, match="valid: std_srvs/srv/Trigger"):
        service_type("std_srvs/srv/Triger")
