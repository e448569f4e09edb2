"""Keys, tokens, attachments and QoS against a real rmw_zenoh node (shared/data/rmw_zenoh_golden)."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core import topics
from companion.core.errors import InputError
from companion.runtime.wire import WireError, codec_of, service_type, wire_type
from companion.runtime.wire import keys as k

ZID = "e108351b93a5799c0745ce41b8566ee5"
HEAD = f"@ros2_lv/0/{ZID}/0"
STRING = "std_msgs::msg::dds_::String_/RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
TWIST = (
    "geometry_msgs::msg::dds_::TwistStamped_/RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64"
)
TRIGGER = "std_srvs::srv::dds_::Trigger_/RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f"
PARAMETER_EVENT = (
    "rcl_interfaces::msg::dds_::ParameterEvent_/RIHS01_043e627780fcad87a22d225bc2a037361dba713fca6a6b9f4b869a5aa0393204"
)
PARAMETER_TYPES = (
    "rcl_interfaces::srv::dds_::GetParameterTypes_/"
    "RIHS01_da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca"
)
DESCRIPTION = (
    "type_description_interfaces::srv::dds_::GetTypeDescription_/"
    "RIHS01_69b9c19c1021405984cc60dbbb1edceb147a6538b411d812ba6afabeed962cd5"
)
GOLDEN = {
    "0/NN/%/%drone1/talker": k.Qos(),
    f"10/MP/%/%drone1/talker/%drone1%chatter/{STRING}/::,10:,:,:,,": k.Qos(depth=10),
    f"11/MP/%/%drone1/talker/%abs%latched/{STRING}/:1:,1:,:,:,,": k.Qos(transient_local=True, depth=1),
    f"12/MP/%/%drone1/talker/%drone1%sensor/{STRING}/2::,5:,:,:,,": k.Qos(reliable=False, depth=5),
    f"13/MP/%/%drone1/talker/%drone1%all/{STRING}/::2,10:,:,:,,": k.Qos(keep_all=True, depth=10),
    f"14/MP/%/%drone1/talker/%drone1%sysdef/{STRING}/::,:,:,:,,": k.Qos(),
    f"15/MP/%/%drone1/talker/%drone1%d42/{STRING}/::,:,:,:,,": k.Qos(depth=42),
    f"16/MP/%/%drone1/talker/%drone1%be_tl/{STRING}/2:1:,5:,:,:,,": k.Qos(
        reliable=False, transient_local=True, depth=5
    ),
    f"17/MP/%/%drone1/talker/%drone1%dl/{STRING}/::,3:1,500:2,0:,3,0": k.Qos(
        depth=3, deadline_ns=1_000_000_500, lifespan_ns=2_000_000_000, lease_ns=3_000_000_000
    ),
    f"18/MS/%/%drone1/talker/%drone1%talker%private/{STRING}/::,7:,:,:,,": k.Qos(depth=7),
    f"19/MS/%/%drone1/talker/%drone1%cmd/{TWIST}/2::,5:,:,:,,": k.Qos(reliable=False, depth=5),
    f"2/MP/%/%drone1/talker/%parameter_events/{PARAMETER_EVENT}/::,1000:,:,:,,": k.Qos(depth=1000),
    f"20/SS/%/%drone1/talker/%drone1%trig/{TRIGGER}/::,10:,:,:,,": k.Qos(depth=10),
    f"21/SC/%/%drone1/talker/%other%trig/{TRIGGER}/::,10:,:,:,,": k.Qos(depth=10),
    f"5/SS/%/%drone1/talker/%drone1%talker%get_parameter_types/{PARAMETER_TYPES}/::,1000:,:,:,,": k.Qos(depth=1000),
    f"9/SS/%/%drone1/talker/%drone1%talker%get_type_description/{DESCRIPTION}/::,10:,:,:,,": k.Qos(depth=10),
}


@pytest.mark.parametrize("tail", GOLDEN)
def test_golden_token_is_built_from_parts_and_parsed(tail: str) -> None:
    text = f"{HEAD}/{tail}"
    entity_id, kind, _, _, _, *rest = tail.split("/")
    entity = k.Entity(
        kind=kind,
        zid=ZID,
        node_id=0,
        entity_id=int(entity_id),
        node="talker",
        namespace="/drone1",
        qos=GOLDEN[tail],
    )
    if rest:
        name = re.sub(r"(\w+)::(\w+)::dds_::(\w+)_", r"\1/\2/\3", rest[1])
        wire = service_type(name) if "/srv/" in name else wire_type(name)
        parts = {"topic": rest[0].replace("%", "/"), "type": name, "type_hash": wire.type_hash}
        entity = k.Entity(**{f: getattr(entity, f) for f in entity.__slots__} | parts)
        assert rest[1:3] == [wire.dds_name, wire.type_hash]
    assert k.token(entity) == text
    assert k.parse_token(text) == entity


def test_topic_key_of_a_real_sample() -> None:
    key = k.topic_key("/drone1/chatter", wire_type("std_msgs/msg/String"))
    assert key == f"0/drone1/chatter/{STRING}"
    assert k.parse_key(key) == k.Key(0, "drone1/chatter", "std_msgs/msg/String", STRING.split("/")[1])
    assert k.topic_key("drone1/trig", service_type("std_srvs/srv/Trigger"), domain=7) == f"7/drone1/trig/{TRIGGER}"
    for name in ("", "/", "a//b", "a/*/b", "a%b"):
        with pytest.raises(InputError, match="is no topic name"):
            k.topic_key(name, wire_type("std_msgs/msg/String"))


def test_golden_payload_of_a_real_talker() -> None:
    golden = bytes.fromhex("000100000800000068656c6c6f203000")
    assert wire_type("std_msgs/msg/String").encode({"data": "hello 0"}) == golden
    start = bytes.fromhex("000100008e59026bc513ba320f0000002f64726f6e65312f74616c6b65720000")  # of a ParameterEvent
    event = wire_type("rcl_interfaces/msg/ParameterEvent").decode(start + bytes(12))  # and no parameters
    assert event["node"] == "/drone1/talker"
    assert event["stamp"]["sec"] == 0x6B02598E


def test_gid_is_xxh3_of_the_token_low_half_first() -> None:
    """Known answer: XXH3-128 of no bytes is 99aa06d3014798d86001c324468d497f, high half first."""
    assert k.gid_of("").hex() == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1].hex()


def test_attachment_layout() -> None:
    data = k.pack_attachment(3, 1_700_000_000_000_000_001, bytes(range(16)))
    assert (
        data.hex()
        == "0300000000000000" + (1_700_000_000_000_000_001).to_bytes(8, "little").hex() + "10" + bytes(range(16)).hex()
    )
    assert k.unpack_attachment(memoryview(data)) == (3, 1_700_000_000_000_000_001, bytes(range(16)))
    for bad in (b"", data[:-1], data + b"0", data[:16] + b"\x0f" + data[17:]):
        with pytest.raises(WireError, match="33 are"):
            k.unpack_attachment(bad)


durations = st.none() | st.integers(0, 2**40)


@given(
    st.builds(
        k.Qos,
        reliable=st.booleans(),
        transient_local=st.booleans(),
        keep_all=st.booleans(),
        depth=st.integers(0, 5000),
        deadline_ns=durations,
        lifespan_ns=durations,
        liveliness=st.sampled_from((0, 1, 3)),
        lease_ns=durations,
    )
)
def test_qos_chunk_round_trip(qos: k.Qos) -> None:
    assert k.parse_qos(qos.chunk) == qos


def test_every_default_written_out_is_the_same_qos() -> None:
    assert k.parse_qos("1:2:1,42:,:,:0,,") == k.Qos()
    assert k.parse_qos("1:2:1,42:9223372036,854775807:,:0,,") == k.Qos()


@given(st.text(max_size=40) | st.text(alphabet="@ros2_lv/0NMPSC%:,", max_size=80))
def test_nonsense_is_a_wire_error(text: str) -> None:
    for parse in (k.parse_token, k.parse_key, k.parse_qos):
        try:
            parse(text)
        except WireError:
            continue


def test_qos_of_the_service_classes() -> None:
    assert k.qos_of(topics.SETPOINT).chunk == "::,1:,:,:,,"
    assert k.qos_of(topics.IMU).chunk == "::,10:,:,:,,"
    assert k.qos_of(topics.LIDAR).chunk == "2::,5:,:,:,,"
    assert k.qos_of(topics.GOAL).chunk == ":1:,1:,:,:,,"


def test_each_topic_has_its_own_key() -> None:
    found = {k.topic_key(f"drone1/{t.name}", codec_of(t).type) for t in topics.ALL}
    assert len(found) == len(topics.ALL)
