"""Interface texts and the identity of types, against hashes that rosidl itself made."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.errors import InputError
from companion.runtime.wire import bundled_types, foreign_type, service_type, wire_type
from companion.runtime.wire.idl import Field, FieldType, parse_msg, parse_srv
from companion.runtime.wire.library import Library
from companion.runtime.wire.type_hash import type_hash

ROSIDL = {  # of a real rmw_zenoh graph and of ROS 2 Kilted's share/*/*.json
    "std_msgs/msg/String": "df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18",
    "geometry_msgs/msg/TwistStamped": "5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "rcl_interfaces/msg/ParameterEvent": "043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204",
    "rcl_interfaces/msg/Log": "e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac",
    "builtin_interfaces/msg/Time": "b106235e25a4c5ed35098aa0a61a3ee9c9b18d197f398b0e4206cea9acf9c197",
    "service_msgs/msg/ServiceEventInfo": "41bcbbe07a75c9b52bc96bfd5c24d7f0fc0a08c0cb7921b3373c5732345a6f45",
    "type_description_interfaces/msg/FieldType": "a70b6dd919645a03a3586f7f821defbc886ea3e531a1d95cc0f380a3973ccaa6",
    "tf2_msgs/msg/TFMessage": "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "rcl_interfaces/srv/GetParameterTypes": "da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
    "type_description_interfaces/srv/GetTypeDescription": (
        "69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"
    ),
    "type_description_interfaces/srv/GetTypeDescription_Event": (
        "491e3350e7a0b11918fb16a523cf01a22d76fdaa53c43b52164fea14aabb5612"
    ),
    "type_description_interfaces/srv/GetTypeDescription_Request": (
        "470f56ccbcf13d55c78c8b735fb12da03e639e5acded994426c89d94778d9e28"
    ),
}


@pytest.mark.parametrize("name", ROSIDL)
def test_type_hash_is_rosidls(name: str) -> None:
    assert type_hash(Library(), name) == "RIHS01_" + ROSIDL[name]


def test_names_on_the_bus() -> None:
    assert wire_type("sensor_msgs/msg/Imu").dds_name == "sensor_msgs::msg::dds_::Imu_"
    assert service_type("std_srvs/srv/Trigger").dds_name == "std_srvs::srv::dds_::Trigger_"


def test_comments_defaults_and_constants_are_no_part_of_the_identity() -> None:
    bare = foreign_type("a_msgs/msg/A", "int32 x\nstring s\n")
    told = foreign_type("a_msgs/msg/A", "# why\nint32 MOST=3\nint32 x 5  # five\n\nstring s 'a # b'\n")
    assert told.type_hash == bare.type_hash
    assert told.default() == {"x": 5, "s": "a # b"} and told.constants == {"MOST": 3}
    assert foreign_type("a_msgs/msg/A", "string s\nint32 x\n").type_hash != bare.type_hash


@pytest.mark.parametrize("name", [n for n in bundled_types() if "/msg/" in n])
def test_schema_is_whole(name: str) -> None:
    """The concatenated text alone gives the same type, as a reader of an MCAP file needs it."""
    wire = wire_type(name)
    again = foreign_type(name, wire.schema)
    assert (again.type_hash, again.constants) == (wire.type_hash, wire.constants)


def test_schema_of_a_header() -> None:
    expected = "builtin_interfaces/Time stamp\nstring frame_id\n" + "=" * 80 + "\nMSG: builtin_interfaces/Time\n"
    assert wire_type("std_msgs/msg/Header").schema == expected + "int32 sec\nuint32 nanosec\n"


def test_every_bundled_text_is_of_facts_only() -> None:
    """Comments stand in our own messages alone."""
    for name in bundled_types():
        if "/msg/" in name and not name.startswith("understory_msgs/"):
            assert "#" not in Library().struct(name).text


def test_grammar() -> None:
    text = """
    string<=7[<=3] names ["a, b", 'c']   # two
    Header header
    Local local
    other_msgs/Thing[4] things
    other_msgs/msg/Thing thing
    float32[2] pair [1.5, -2]
    bool on true
    uint8 HEX=0xff
    string WORD="a#b"
    string BARE= plain words  # and a comment
    """
    struct = parse_msg("own_msgs/msg/A", text)
    assert struct.fields == (
        Field("names", FieldType("string", "bounded", 3, 7), ["a, b", "c"]),
        Field("header", FieldType("std_msgs/msg/Header")),
        Field("local", FieldType("own_msgs/msg/Local")),
        Field("things", FieldType("other_msgs/msg/Thing", "array", 4)),
        Field("thing", FieldType("other_msgs/msg/Thing")),
        Field("pair", FieldType("float32", "array", 2), [1.5, -2.0]),
        Field("on", FieldType("bool"), True),
    )
    assert struct.constants == {"HEX": 255, "WORD": "a#b", "BARE": "plain words"}


BAD_LINES = [
    ("int32", "'int32' is neither a field nor a constant"),
    ("int32 Big", r"Big: no field name \(valid: lower_case\)"),
    ("int32 small=3", r"small: no constant name \(valid: UPPER_CASE\)"),
    ("int8 A=128", "A: 128 does not fit into int8"),
    ("uint8 a -1", "a: -1 does not fit into uint8"),
    ("bool a maybe", r"a: 'maybe' is no bool \(valid: true, false\)"),
    ("float64 a x", "a: 'x' is no float64"),
    ("int32[0] a", "a: needs room for one element"),
    ("int32[<=] a", "a: needs room for one element"),
    ("int32<=3 a", "a: only a string is bounded"),
    ("int32[2] a [1]", "a: 1 values for room 2"),
    ("int32[2] a 1", "a: '1' is no list"),
    ("Thing a 1", "a: a nested type takes no default"),
    ("Thing A=1", "A: a constant cannot have type Thing"),
    ("wstring a", "a: wstring has no single layout"),
    ("in-t a", "a: 'in-t' is no type"),
    ("int32 first", "first: the field stands there twice"),
]


@pytest.mark.parametrize(("line", "match"), BAD_LINES)
def test_a_wrong_line_is_named(line: str, match: str) -> None:
    with pytest.raises(InputError, match=rf"a\.msg:3: {match}"):
        parse_msg("own_msgs/msg/A", f"int32 first\n\n{line}\n", file="a.msg")


@given(st.text(alphabet="int32[]<=3 abAB_#'\"=.-/\n", max_size=60) | st.text(max_size=30))
def test_any_text_parses_or_is_an_input_error(text: str) -> None:
    try:
        struct = parse_msg("own_msgs/msg/A", text)
    except InputError:
        return
    assert len({f.name for f in struct.fields}) == len(struct.fields)


def test_services_have_two_halves() -> None:
    request, response = parse_srv("a_srvs/srv/A", "int32 x\n---\nbool y\n")
    assert [f.name for f in request.fields + response.fields] == ["x", "y"]
    with pytest.raises(InputError, match=r"a\.srv: a service has one line ---"):
        parse_srv("a_srvs/srv/A", "int32 x\n", file="a.srv")
    with pytest.raises(InputError, match=r"a\.srv:3: Y: no field name"):
        parse_srv("a_srvs/srv/A", "int32 x\n---\nbool Y\n", file="a.srv")


def test_unknown_and_impossible_types() -> None:
    with pytest.raises(InputError, match=r"no ROS 2 type 'sensor_msgs/msg/Imo' is known .valid: sensor_msgs/msg/Imu"):
        wire_type("sensor_msgs/msg/Imo")
    for name in ("Imu", "sensor_msgs/Imu", "sensor_msgs/msg/../../x", "a/action/B", ""):
        with pytest.raises(InputError, match=r"is no ROS 2 type name|is known"):
            wire_type(name)
    rule = "=" * 80 + "\n"
    with pytest.raises(InputError, match="a/msg/A contains itself"):
        foreign_type("a/msg/A", f"B b\n{rule}MSG: a/B\nA[] a\n")
    chain = [f"MSG: a/T{i}\nT{i + 1}[] a\nT{i + 1}[] b\nT{i + 1}[] c\n" for i in range(12)] + ["MSG: a/T12\nint32 x\n"]
    with pytest.raises(InputError, match=r"\d+ fields, 20000 is the most"):
        foreign_type("a/msg/A", rule.join(["T0 t\n", *chain]))
    with pytest.raises(InputError, match="heads no part of a schema"):
        foreign_type("a/msg/A", f"B b\n{rule}B\nint32 a\n")
