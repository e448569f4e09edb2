"""The ground link from outside: who gets in, what they hear, and that nothing they say is heard."""

import re
import socket
import ssl
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
import zenoh

from companion.core import messages as m
from companion.core import topics
from companion.core.errors import InputError, LinkError
from companion.runtime.bus import ground as ground_link
from companion.runtime.bus import session
from companion.runtime.bus.attach import BusOutlet, Hearing, bus_name
from companion.runtime.bus.certificate_files import find_credentials
from companion.runtime.bus.certificates import make_authority, make_certificate
from companion.runtime.bus.directory import Directory
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.ground import GroundSettings, access_control, downsampling, open_ground
from companion.runtime.bus.session import configured, open_session, tls_trust
from companion.runtime.clock import Clock
from companion.runtime.ports.endpoint import parse_endpoint
from companion.runtime.tools.desk import Desk
from companion.runtime.tools.ear import listen
from companion.runtime.tools.names import topics_of
from companion.runtime.vehicle_link import VehicleLink
from companion.runtime.wire import codec_of, service_type, wire_type
from companion.runtime.wire.keys import Qos, topic_key

NOW = datetime.now(UTC)
SHUT = (topics.GOAL, topics.SETPOINT, topics.HEALTH, topics.IMU, topics.RANGE, topics.VEHICLE_COMMAND)


class Box:
    def __init__(self):
        self.got = []

    def receive(self, topic, message, *, decode):
        self.got.append((topic.name, decode(message)))


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(session, "CONNECT_MS", 400)
    monkeypatch.setattr(ground_link, "CONNECT_MS", 400)


@pytest.fixture(scope="module")
def certs(tmp_path_factory):
    """Our authority's folder, with one pair that has expired; and a stranger's."""
    ours, theirs = tmp_path_factory.mktemp("ours"), tmp_path_factory.mktemp("theirs")
    for folder in (ours, theirs):
        make_authority(folder, now=NOW)
        make_certificate(folder, "drone1", hosts=["127.0.0.1"], now=NOW)
        make_certificate(folder, "laptop", now=NOW)
    make_certificate(ours, "late", now=NOW - timedelta(days=400), days=365)
    make_certificate(ours, "elsewhere", hosts=["192.0.2.1"], now=NOW)
    return ours, theirs


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def bus():
    return f"tcp/127.0.0.1:{free_port()}"


@pytest.fixture(scope="module")
def ground(bus, certs):
    """Endpoint of the ground link of a bus; the vehicle is v."""
    outside = f"tls/127.0.0.1:{free_port()}"
    settings = GroundSettings(
        endpoint=outside,
        credentials=find_credentials(certs[0] / "drone1"),
        rates_hz={"sensors/range": 10.0, "sensors/baro": 0.0},
        allowed=("note",),
    )
    with open_session("router", endpoint=bus), open_ground(settings, bus=bus, vehicle="v"):
        yield outside


@pytest.fixture
def inside(ground, bus):
    """Two nodes' graphs on the bus, peers of each other."""
    with (
        open_session("peer", endpoint=bus) as one,
        open_session("peer", endpoint=bus) as two,
        Graph(one) as first,
        Graph(two) as second,
    ):
        yield first, second


@pytest.fixture
def station(ground, certs):
    credentials = find_credentials(certs[0] / "laptop")
    with open_session("client", endpoint=ground, credentials=credentials) as opened, Graph(opened) as graph:
        yield graph


def as_mode(mode, endpoint, certs):
    """A ground station that is no client of ours: whatever it may declare, it has a good certificate."""
    pair = find_credentials(certs / "laptop")
    tls = tls_trust(pair) | {"connect_certificate": str(pair.certificate), "connect_private_key": str(pair.key)}
    return zenoh.open(
        configured(
            {
                "mode": mode,
                "connect/endpoints": [endpoint],
                "connect/exit_on_failure": True,
                "connect/timeout_ms": 400,
                "listen/endpoints": [] if mode == "client" else ["tcp/127.0.0.1:0"],
                "scouting/multicast/enabled": False,
                "transport/link/tls": tls,
            }
        )
    )


def key(topic):
    return topic_key(bus_name(topic, "v"), codec_of(topic).type)


def reading(k):
    return m.RangeReading(stamp_ns=k, range_m=float(k))


def test_a_station_hears_telemetry_at_the_rate_of_the_link(inside, station, eventually):
    box = Box()
    outlet = BusOutlet(inside[0], {"Source": [topics.RANGE, topics.MAP_STATUS]}, vehicle="v")
    Hearing(station, [topics.RANGE], box, listener="station", vehicle="v")
    eventually(lambda: outlet.publish(topics.RANGE, reading(0), 0) or box.got)
    before, began_s = len(box.got), time.monotonic()
    for k in range(1, 101):
        outlet.publish(topics.RANGE, reading(k), k)
        time.sleep(0.005)
    took_s = time.monotonic() - began_s
    assert 1 <= len(box.got) - before <= 10 * took_s + 2


def test_a_topic_that_is_withheld_is_not_heard(inside, station, eventually):
    box, alive = Box(), Box()
    outlet = BusOutlet(inside[0], {"Source": [topics.BARO, topics.RANGE]}, vehicle="v")
    Hearing(inside[1], [topics.BARO], alive, listener="inner", vehicle="v")
    Hearing(station, [topics.BARO, topics.RANGE], box, listener="station", vehicle="v")
    reading_of_baro = m.BaroReading(stamp_ns=1, altitude_m=1.0)
    eventually(lambda: outlet.publish(topics.BARO, reading_of_baro, 0) or alive.got)
    eventually(lambda: outlet.publish(topics.RANGE, reading(0), 0) or box.got)
    assert {name for name, _ in box.got} == {"sensors/range"}


def test_a_station_gets_latched_topics_and_sees_who_is_there(inside, station, eventually):
    tf, got = wire_type("tf2_msgs/msg/TFMessage"), []
    latched = Qos(transient_local=True, depth=1)
    publisher = inside[0].node("frames", namespace="/v").publisher("/tf_static", tf, latched)
    publisher.put(tf.encode({"transforms": []}), 1)
    station.node("viewer").subscribe("/tf_static", tf, latched, lambda arrival: got.append(arrival.payload))
    eventually(lambda: got)
    assert "frames" in {e.node for e in Directory(station).nodes()}
    assert "viewer" not in {e.node for e in Directory(inside[1]).nodes()}  # and is not seen itself


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_nothing_that_a_station_says_reaches_a_subscriber_on_the_bus(mode, ground, inside, certs, eventually):
    """Also if it is no client: as a peer it would be dialled by the nodes, could they learn of it."""
    heard = []
    everything = inside[1].session.declare_subscriber("0/**", lambda s: heard.append(s.payload.to_bytes()))
    aside = inside[1].session.declare_subscriber("**", lambda s: heard.append(s.payload.to_bytes()))
    with everything, aside, as_mode(mode, ground, certs[0]) as stranger:
        keys = [*map(key, SHUT), "0/v/mavlink/tx/a/b", "0/w/else/a/b", "0/tf/a/b", "other", "0/**", "**", "0/v/note/**"]
        for put_key in keys:
            stranger.declare_publisher(put_key).put(b"evil")
        for _ in range(10):
            for put_key in keys:
                stranger.put(put_key, b"evil", congestion_control=zenoh.CongestionControl.BLOCK)
                stranger.delete(put_key)
            time.sleep(0.02)
        inside[0].session.put("0/v/sign/a/b", b"the bus works")
        eventually(lambda: heard)
        zids = [str(z) for z in inside[1].session.info.peers_zid()]
        assert str(stranger.zid()) not in zids  # no link past the ground link
    assert set(heard) == {b"the bus works"}


def test_one_session_with_both_endpoints_would_let_a_peer_in(endpoint, certs, eventually):
    """Why the ground link is a session of its own: the nodes dial a peer that their router tells them of."""
    outside, pair = f"tls/127.0.0.1:{free_port()}", find_credentials(certs[0] / "drone1")
    both = {
        "mode": "router",
        "listen/endpoints": [endpoint, outside],
        "scouting/multicast/enabled": False,
        "transport/link/tls": tls_trust(pair)
        | {"listen_certificate": str(pair.certificate), "listen_private_key": str(pair.key)},
        "access_control": access_control("v", "tcp"),
    }
    heard = []
    with (
        zenoh.open(configured(both)),
        open_session("peer", endpoint=endpoint) as node,
        node.declare_subscriber(key(topics.GOAL), heard.append),
        as_mode("peer", outside, certs[0]) as stranger,
    ):
        eventually(lambda: stranger.put(key(topics.GOAL), b"evil") or heard)


@pytest.mark.parametrize("mode", ["client", "peer", "router"])
def test_a_station_serves_nothing_names_nothing_and_calls_nothing(mode, ground, inside, certs):
    trigger, served = service_type("std_srvs/srv/Trigger"), []

    def answer(request):
        served.append(request)
        return trigger.response.encode({"success": True, "message": ""})

    inside[0].node("server").serve("/v/land", trigger, answer)
    with as_mode(mode, ground, certs[0]) as stranger, Graph(stranger) as graph:
        graph.node("impostor", namespace="/v").serve("/v/other", trigger, answer)
        asked = trigger.request.encode({})
        caller = graph.node("caller")
        assert caller.call("/v/land", trigger, asked, stamp_ns=1, timeout_s=0.5) is None
        assert inside[1].node("n").call("/v/other", trigger, asked, stamp_ns=1, timeout_s=0.5) is None
        assert not {"impostor", "caller"} & {e.node for e in Directory(inside[1]).nodes()}
    assert served == []


def test_topic_tools_sit_on_the_ground_as_on_the_bus(inside, ground, certs, eventually):
    outlet = BusOutlet(inside[0], {"Source": [topics.RANGE]}, vehicle="v")
    with Desk(ground, certs=certs[0] / "laptop") as desk:
        (view,) = eventually(lambda: [t for t in topics_of(desk.entities()) if t.name == "/v/sensors/range"])
        ear = listen(desk, view, codec_of(topics.RANGE).type)
        heard = eventually(lambda: outlet.publish(topics.RANGE, reading(7), 7) or ear.take(0.1))
    assert codec_of(topics.RANGE).decode(heard.payload).range_m == 7.0


def test_a_topic_that_is_allowed_comes_through(inside, station, eventually):
    text, got = wire_type("std_msgs/msg/String"), []
    inside[1].node("reader", namespace="/v").subscribe("/v/note", text, Qos(), lambda a: got.append(a.payload))
    publisher = station.node("writer").publisher("/v/note", text, Qos())
    eventually(lambda: publisher.put(text.encode({"data": "hello"}), 1) or got)
    assert text.decode(got[0]) == {"data": "hello"}


@pytest.mark.parametrize("who", ["stranger", "late", "drone1", "nobody"])
def test_without_a_good_certificate_nobody_gets_in(who, ground, certs):
    ours, theirs = certs
    pair = find_credentials((theirs if who == "stranger" else ours) / ("laptop" if who == "stranger" else who)) \
        if who != "nobody" else None  # fmt: skip
    began_s = time.monotonic()
    with pytest.raises(LinkError, match="certificate"):
        if pair is None:
            nobody(ground, ours)
        else:
            trusting = pair._replace(authority=(ours / "ca.crt"))  # it believes us; do we believe it?
            open_session("client", endpoint=ground, credentials=trusting).close()
    assert time.monotonic() - began_s < 10  # it ends


def test_a_station_is_cut_off_when_its_certificate_expires(inside, ground, certs, eventually):
    soon = datetime.now(UTC) + timedelta(seconds=3) - timedelta(days=1)
    make_certificate(certs[0], "brief", now=soon, days=1, force=True)
    outlet, box = BusOutlet(inside[0], {"Source": [topics.MAP_STATUS]}, vehicle="v"), Box()
    status = m.MapStatus(stamp_ns=1, scans=1, blocks=1, cold_blocks=0, forgotten_blocks=0, memory_bytes=1)
    credentials = find_credentials(certs[0] / "brief")
    with open_session("client", endpoint=ground, credentials=credentials) as opened, Graph(opened) as graph:
        Hearing(graph, [topics.MAP_STATUS], box, listener="brief", vehicle="v")
        eventually(lambda: outlet.publish(topics.MAP_STATUS, status, 0) or box.got)
        eventually(lambda: not [*opened.info.routers_zid()])


def nobody(endpoint, folder):
    settings = {"mode": "client", "connect/endpoints": [endpoint], "connect/exit_on_failure": True,
                "connect/timeout_ms": 400, "scouting/multicast/enabled": False,
                "transport/link/tls": {"root_ca_certificate": str(folder / "ca.crt")}}  # fmt: skip
    try:
        zenoh.open(configured(settings)).close()
    except zenoh.ZError as error:
        raise LinkError("no certificate") from error


@pytest.mark.parametrize(("vehicle", "authority"), [("elsewhere", "ours"), ("drone1", "theirs"), ("laptop", "ours")])
def test_a_station_does_not_talk_to_who_is_not_the_vehicle(vehicle, authority, endpoint, certs):
    """Another host's certificate, another authority's, and that of another ground station."""
    outside = f"tls/127.0.0.1:{free_port()}"
    false = find_credentials(certs[authority == "theirs"] / vehicle)
    settings = GroundSettings(endpoint=outside, credentials=false)
    with (
        open_session("router", endpoint=endpoint),
        open_ground(settings, bus=endpoint, vehicle="v"),
        pytest.raises(LinkError, match="no ground link"),
    ):
        open_session("client", endpoint=outside, credentials=find_credentials(certs[0] / "laptop"))


def test_plain_tcp_gets_nothing_and_keeps_nobody_out(ground, certs):
    port = int(ground.rpartition(":")[2])
    with pytest.raises(LinkError, match="nobody answers"):
        open_session("client", endpoint=f"tcp/127.0.0.1:{port}")
    idle = [socket.create_connection(("127.0.0.1", port)) for _ in range(5)]
    with open_session("client", endpoint=ground, credentials=find_credentials(certs[0] / "laptop")) as opened:
        assert [*opened.info.routers_zid()]
    for connection in idle:
        connection.close()


def test_tls_without_client_certificate_is_shut_before_any_data(ground, certs):
    context = ssl.create_default_context(cafile=certs[0] / "ca.crt")
    port = int(ground.rpartition(":")[2])
    with (
        socket.create_connection(("127.0.0.1", port), timeout=5) as plain,
        pytest.raises((ssl.SSLError, ConnectionError)),
        context.wrap_socket(plain, server_hostname="127.0.0.1") as wrapped,
    ):
        assert wrapped.recv(1) == b""
        raise ConnectionError("shut")


def test_the_link_comes_back_when_the_bus_does(endpoint, certs, eventually):
    outside = f"tls/127.0.0.1:{free_port()}"
    settings = GroundSettings(endpoint=outside, credentials=find_credentials(certs[0] / "drone1"))
    laptop = find_credentials(certs[0] / "laptop")
    got = []
    router = open_session("router", endpoint=endpoint)
    with (
        open_ground(settings, bus=endpoint, vehicle="v"),
        open_session("client", endpoint=outside, credentials=laptop) as station,
        station.declare_subscriber("0/v/a/T/H", got.append),
    ):
        router.close()
        with open_session("router", endpoint=endpoint) as again:
            eventually(lambda: again.put("0/v/a/T/H", b"x") or got, timeout_s=20.0)


def listening(pid="self"):
    """Addresses on which this process listens: TCP in state LISTEN, UDP bound."""
    inodes = set()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            found = re.fullmatch(r"socket:\[(\d+)\]", str(link.readlink()))
        except OSError:
            continue
        if found:
            inodes.add(found[1])
    hosts = []
    for table in ("tcp", "tcp6", "udp", "udp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            fields = line.split()
            if fields[9] in inodes and (table.startswith("udp") or fields[3] == "0A"):
                hosts.append((table, fields[1].partition(":")[0]))
    return hosts


def test_without_a_ground_link_everything_binds_to_the_loopback(endpoint):
    before = listening()
    link = parse_endpoint(f"udpin://:{free_port()}")
    with (
        open_session("first", endpoint=endpoint),
        open_session("first", endpoint=endpoint),
        VehicleLink(str(link), clock=Clock.of_host()),
    ):
        opened = listening()
        for old in before:
            opened.remove(old)
    loopback = "0100007F"  # 127.0.0.1 as /proc writes it
    assert len([t for t, _ in opened if t == "tcp"]) >= 2  # the router and its peer
    assert {host for table, host in opened if table == "udp"} == {loopback}
    assert {host for _, host in opened} == {loopback}


def test_the_stacks_own_topics_cannot_be_allowed():
    for topic in topics.ALL:
        with pytest.raises(InputError, match="stack's own"):
            access_control("v", "tcp", allowed=[topic.name])
    with pytest.raises(InputError, match="no name"):
        access_control("v", "tcp", allowed=["mission/*"])


def test_settings_that_make_no_sense_are_told(endpoint, certs):
    pair = find_credentials(certs[0] / "drone1")
    with pytest.raises(InputError, match="tls/HOST:PORT"):
        open_ground(GroundSettings(endpoint="tcp/0.0.0.0:7448", credentials=pair), bus=endpoint, vehicle="v")
    with pytest.raises(InputError, match=r"0\.\.1000"):
        downsampling("v", {"cloud": -1.0})
    with pytest.raises(InputError, match="--certs"):
        open_session("client", endpoint="tls/127.0.0.1:7448")
    with pytest.raises(LinkError, match="no ground link"):
        open_ground(
            GroundSettings(endpoint=f"tls/127.0.0.1:{free_port()}", credentials=pair), bus=endpoint, vehicle="v"
        )
