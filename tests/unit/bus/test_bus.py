"""The bus between two sessions: what ROS 2 sees of us, what arrives, what is lost and counted."""

import numpy as np
import pytest

from companion.core import messages as m
from companion.core import topics
from companion.core.errors import InputError, LinkError
from companion.core.rig import Rig
from companion.runtime.bus.attach import BusOutlet, Hearing, bus_name
from companion.runtime.bus.directory import Directory
from companion.runtime.bus.scene import SceneOutlet
from companion.runtime.bus.session import configured, open_session
from companion.runtime.wire import WireError, codec_of, service_type, wire_type
from companion.runtime.wire.keys import Qos


class Box:
    """Keeps what a group would get."""

    def __init__(self):
        self.got = []

    def receive(self, topic, message, *, decode):
        self.got.append((topic.name, decode(message)))


def reading(k):
    return m.RangeReading(stamp_ns=k, range_m=float(k))


def goal(k):
    return m.Goal(
        stamp_ns=k, id=k, kind="fly", p_odom=np.array([1.0, 2.0, 3.0]), agl_m=float("nan"), radius_m=0.5,
        fly_through=False, next_p_odom=np.zeros((0, 3)), yaw=0.0, if_blocked="fail",
        limits=m.Limits(
            speed=1.0, climb=1.0, accel=1.0, jerk=10.0, yaw_rate=1.0, clearance=0.3, unknown="blocked",
            agl_min=0.0, agl_max=5.0,
        ),
    )  # fmt: skip


def test_what_is_published_arrives_in_order_and_nothing_is_counted_lost(pair, eventually):
    first, second = pair
    box = Box()
    outlet = BusOutlet(first, {"Source": [topics.RANGE]}, vehicle="v")
    hearing = Hearing(second, [topics.RANGE], box, listener="ear", vehicle="v")
    eventually(lambda: outlet.publish(topics.RANGE, reading(0), 0) or outlet.sent)
    for k in range(1, 200):
        outlet.publish(topics.RANGE, reading(k), k)
    eventually(lambda: box.got and box.got[-1][1].stamp_ns == 199)
    stamps = [message.stamp_ns for _, message in box.got]
    assert stamps == sorted(set(stamps))
    lost = hearing.figures()["bus_lost"]
    assert len(stamps) + lost == stamps[-1] - stamps[0] + 1  # what did not come is known


def test_nobody_listens_nothing_is_encoded(pair):
    outlet = BusOutlet(pair[0], {"Source": [topics.LIDAR]}, vehicle="v")
    outlet.publish(topics.LIDAR, "no scan at all", 0)
    assert outlet.sent == {}


def test_a_gap_in_the_senders_numbers_is_a_loss(pair, eventually):
    first, second = pair
    box = Box()
    hearing = Hearing(second, [topics.RANGE], box, listener="ear", vehicle="v")
    codec = codec_of(topics.RANGE)
    publisher = first.node("n").publisher(bus_name(topics.RANGE, "v"), codec.type, Qos())
    eventually(lambda: publisher.wanted)
    publisher.put(codec.encode(reading(1)), 1)
    publisher.sequence += 3
    publisher.put(codec.encode(reading(2)), 2)
    eventually(lambda: len(box.got) == 2)
    assert hearing.lost == {"sensors/range": 3}


def test_a_late_joiner_gets_the_newest_goal(pair, eventually):
    first, second = pair
    outlet = BusOutlet(first, {"MissionNode": [topics.GOAL]}, vehicle="v")
    for k in (1, 2, 3):
        outlet.publish(topics.GOAL, goal(k), k)
    box = Box()
    Hearing(second, [topics.GOAL], box, listener="late", vehicle="v")
    eventually(lambda: box.got)
    assert [message.id for _, message in box.got] == [3]


def test_vehicles_do_not_hear_each_other_and_nobody_on_the_bus_speaks_mavlink(pair, eventually):
    first, second = pair
    box = Box()
    published = {"Source": [topics.RANGE, topics.MAVLINK_RX]}
    outlets = [BusOutlet(first, published, vehicle=v) for v in ("one", "two")]
    Hearing(second, [topics.RANGE, topics.MAVLINK_RX, topics.MAVLINK_TX], box, listener="ear", vehicle="two")
    eventually(lambda: outlets[1].publish(topics.RANGE, reading(2), 0) or box.got)
    outlets[0].publish(topics.RANGE, reading(1), 0)
    outlets[1].publish(topics.MAVLINK_RX, m.MavlinkBytes(stamp_ns=0, data=b"\xfd"), 0)
    assert {name for name, _ in box.got} == {"sensors/range"}
    assert {message.stamp_ns for _, message in box.got} == {2}
    assert not [e for e in Directory(second).entities() if "mavlink" in e.topic]


def test_the_directory_tells_nodes_topics_types_and_qos(pair, eventually):
    first, second = pair
    BusOutlet(first, {"MappingNode": [topics.LOCAL_MAP], "MissionNode": [topics.GOAL]}, vehicle="drone7")
    Hearing(first, [topics.ODOMETRY], Box(), listener="ear", vehicle="drone7")
    found = eventually(lambda: entities if len(entities := Directory(second).entities()) == 6 else None)
    assert {(e.namespace, e.node) for e in found if e.kind == "NN"} == {
        ("/drone7", "MappingNode"),
        ("/drone7", "MissionNode"),
        ("/drone7", "ear"),
    }
    by_topic = {e.topic: e for e in found if e.kind in ("MP", "MS")}
    assert by_topic["/drone7/mission/goal"].qos == Qos(transient_local=True, depth=1)
    assert not by_topic["/drone7/mapping/local_map"].qos.reliable
    assert by_topic["/drone7/estimation/odometry"].kind == "MS"
    assert by_topic["/drone7/mission/goal"].type_hash == wire_type("understory_msgs/msg/Goal").type_hash


def test_what_closes_is_gone_from_the_graph(pair, eventually, endpoint):
    with open_session("peer", endpoint=endpoint) as session:
        from companion.runtime.bus.graph import Graph

        with Graph(session) as graph:
            graph.node("brief")
            eventually(lambda: "brief" in [e.node for e in Directory(pair[0]).nodes()])
        eventually(lambda: "brief" not in [e.node for e in Directory(pair[0]).nodes()])


def test_a_service_answers_and_an_error_is_told(pair, eventually):
    first, second = pair
    trigger = service_type("std_srvs/srv/Trigger")

    def answer(request):
        if request == b"":
            raise WireError("an empty request")
        trigger.request.decode(request)
        return trigger.response.encode({"success": True, "message": "done"})

    first.node("server").serve("/v/trigger", trigger, answer)
    client = second.node("client")
    asked = trigger.request.encode({})
    response = eventually(lambda: client.call("/v/trigger", trigger, asked, stamp_ns=1, timeout_s=1.0))
    assert trigger.response.decode(response) == {"success": True, "message": "done"}
    with pytest.raises(WireError, match="an empty request"):
        client.call("/v/trigger", trigger, b"", stamp_ns=1, timeout_s=1.0)
    assert client.call("/v/nobody", trigger, asked, stamp_ns=1, timeout_s=0.2) is None


def test_the_first_session_is_the_router_and_the_second_its_peer(endpoint):
    with open_session("first", endpoint=endpoint) as one, open_session("first", endpoint=endpoint) as two:
        assert [str(z) for z in two.info.routers_zid()] == [str(one.zid())]
        with pytest.raises(LinkError, match="another bus router listens"):
            open_session("router", endpoint=endpoint)


def test_without_a_bus_a_client_is_told_what_to_start(endpoint):
    with pytest.raises(LinkError, match="start `companion sim`"):
        open_session("client", endpoint=endpoint)


def test_a_setting_that_zenoh_refuses_is_named():
    with pytest.raises(InputError, match="no/such/key"):
        configured({"no/such/key": 1})


def test_viewers_get_frames_of_ours_only_while_they_look(pair, eventually):
    first, second = pair
    scene = SceneOutlet(first, [topics.SMOOTHED, topics.GOAL], name="scene", vehicle="v")
    scene.publish(topics.GOAL, "nobody looks, so nobody turns this into a view", 0)
    frames, tf = [], wire_type("tf2_msgs/msg/TFMessage")
    second.node("rviz").subscribe("/tf", tf, Qos(), lambda arrival: frames.append(tf.decode(arrival.payload)))
    state = m.SmoothedState(
        stamp_ns=7_000_000_005, p_map=np.zeros(3), q_map_body=np.array([1.0, 0, 0, 0]), v_map=np.zeros(3),
        gyro_bias_body=np.zeros(3), accel_bias_body=np.zeros(3), p_map_odom=np.array([1.0, 2.0, 3.0]),
        q_map_odom=np.array([0.6, 0.0, 0.0, 0.8]), pose_variance=np.zeros(6), factors=1,
    )  # fmt: skip
    eventually(lambda: scene.publish(topics.SMOOTHED, state, 0) or frames)
    (transform,) = frames[0]["transforms"]
    assert transform["header"] == {"stamp": {"sec": 7, "nanosec": 5}, "frame_id": "map"}
    assert transform["child_frame_id"] == "odom"
    assert transform["transform"]["translation"] == {"x": 1.0, "y": 2.0, "z": 3.0}
    assert transform["transform"]["rotation"] == {"x": 0.0, "y": 0.0, "z": 0.8, "w": 0.6}


def test_sensor_frames_are_there_for_who_comes_late(pair, eventually):
    first, second = pair
    SceneOutlet(first, [], name="scene", vehicle="v").show_sensors(Rig(), 1)
    got, tf = [], wire_type("tf2_msgs/msg/TFMessage")
    late = Qos(transient_local=True, depth=1)
    second.node("rviz").subscribe("/tf_static", tf, late, lambda arrival: got.append(tf.decode(arrival.payload)))
    eventually(lambda: got)
    assert {t["child_frame_id"] for t in got[0]["transforms"]} == {"lidar", "camera", "range_finder"}
