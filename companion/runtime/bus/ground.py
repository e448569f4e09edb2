"""The ground link: telemetry for ground stations over mutual TLS, and nothing in return.

    settings = GroundSettings(endpoint="tls/0.0.0.0:7448", credentials=find_credentials(Path("certs")))
    with open_ground(settings, bus=ENDPOINT, vehicle="drone1"):
        ...

A router session of its own stands between the ground and the bus. One session with both endpoints
would not do: it tells the nodes of the bus where a ground station listens, they dial it, and those
links pass no access control (tried with Zenoh 1.10.2; see tests/unit/bus/test_ground.py).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import msgspec
import zenoh

from companion.core import topics
from companion.core.errors import InputError, LinkError
from companion.runtime.bus.certificate_files import Credentials
from companion.runtime.bus.session import COMMON, QUEUES, configured, tls_trust

RATES_HZ = {  # most per second on the ground link; other topics pass whole
    "sensors/imu": 10.0,
    "sensors/lidar": 1.0,
    "sensors/camera": 1.0,
    "sensors/range": 5.0,
    "sensors/baro": 5.0,
    "estimation/lio_state": 5.0,
    "estimation/likelihood": 5.0,
    "estimation/registered_scan": 1.0,
    "estimation/odometry": 10.0,
    "mapping/local_map": 0.5,
    "mapping/occupied": 0.5,
    "tracking/setpoint": 10.0,
    "safety/status": 5.0,
    "truth": 10.0,
    "odom": 10.0,
    "cloud": 1.0,
}
SHARED = ("tf", "tf_static", "diagnostics", "rosout", "clock")  # what ROS keeps outside any namespace
STATIONS = 16  # sessions at most
QUERY_BYTES = 4096  # a question from the ground needs no more
MESSAGE_BYTES = 64_000_000  # and no message is larger
SOCKET_BYTES = 65_536  # unsent bytes that no urgent message can overtake: more is late on slow links, less loses clouds
CONNECT_MS = 2000

_TOKENS, _DOMAIN = "@ros2_lv/0/**", "0"
_ENDPOINT = re.compile(r"tls/(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+):\d{1,5}")
_NAME = re.compile(r"[A-Za-z0-9_]+(/[A-Za-z0-9_]+)*")
_MESSAGES = (
    "put", "delete", "declare_subscriber", "query", "reply", "declare_queryable", "liveliness_token",
    "liveliness_query", "declare_liveliness_subscriber",
)  # fmt: skip
_CACHES = ("query", "liveliness_query", "declare_liveliness_subscriber")  # a late joiner asks for latched samples


class GroundSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Where ground stations connect, and what they get."""

    endpoint: str
    """Zenoh endpoint to listen on, tls/HOST:PORT."""
    credentials: Credentials
    rates_hz: dict[str, float] = msgspec.field(default_factory=dict)
    """Topic -> most messages per second, beside the defaults; 0 withholds a topic."""
    allowed: tuple[str, ...] = ()
    """Topics of the vehicle that the ground may publish; never one of the stack's own."""


def open_ground(settings: GroundSettings, *, bus: str, vehicle: str) -> zenoh.Session:
    """A session that passes the telemetry of `vehicle` from `bus` to whoever has a certificate.

    Raises InputError for settings that make no sense, LinkError if the endpoint is taken or the bus away.
    """
    config = ground_config(settings, bus=bus, vehicle=vehicle)
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise LinkError(f"no ground link on {settings.endpoint}: {str(error).split(' at /')[0]}") from error


def ground_config(settings: GroundSettings, *, bus: str, vehicle: str) -> zenoh.Config:
    """What `open_ground` opens; raises InputError for settings that make no sense."""
    if not _ENDPOINT.fullmatch(settings.endpoint):
        raise InputError(f"{settings.endpoint!r} is no endpoint", field="--ground", valid="tls/HOST:PORT")
    inner = bus.partition("/")[0]
    if inner == "tls":
        raise InputError("the bus itself cannot be over TLS beside a ground link", field="--bus", valid="tcp/HOST:PORT")
    return configured(
        COMMON
        | {
            "mode": "router",
            "listen/endpoints": [settings.endpoint],
            "connect/endpoints": [bus],
            "connect/exit_on_failure": True,
            "connect/timeout_ms": CONNECT_MS,
            "scouting/gossip/enabled": False,  # neither side learns where the other listens
            "transport/unicast/max_sessions": STATIONS + 1,
            "transport/link/rx/max_message_size": MESSAGE_BYTES,
            "transport/link/tx/queue/size": QUEUES | {"data_low": 16},  # a cloud of 1 MB finds room at once
            "transport/shared_memory/enabled": False,  # nobody outside maps this machine's memory
            "transport/link/tls": tls_trust(settings.credentials)
            | {
                "listen_certificate": str(settings.credentials.certificate),
                "listen_private_key": str(settings.credentials.key),
                "so_sndbuf": SOCKET_BYTES,
            },
            "access_control": access_control(vehicle, inner, allowed=settings.allowed, rates_hz=settings.rates_hz),
            "downsampling": [downsampling(vehicle, RATES_HZ | settings.rates_hz)],
            "low_pass_filter": [_small_questions()],
        }
    )


def access_control(
    vehicle: str, inner: str, *, allowed: Sequence[str] = (), rates_hz: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """Zenoh's rules: over `inner` (a link protocol) everything, over TLS only to read, and what is `allowed`.

    A denial outweighs a permission; what no rule names is denied.
    """
    own = _topic(vehicle, field="--name")
    read = [f"{_DOMAIN}/{own}/**", *(f"{_DOMAIN}/{name}/**" for name in SHARED)]
    caches = [f"{key}/@adv/**" for key in read]
    rules = [
        _rule("bus", _MESSAGES, ["ingress", "egress"], ["**", "@ros2_lv/**", "**/@adv/**"]),
        _rule("subscribe", ["declare_subscriber"], ["ingress"], read),
        _rule("ask for latched", _CACHES, ["ingress"], caches),
        _rule("ask who is there", ["liveliness_query", "declare_liveliness_subscriber"], ["ingress"], [_TOKENS]),
        _rule("tell", ["put", "reply"], ["egress"], [*read, *caches]),
        _rule("tell of latched", ["declare_queryable", "liveliness_token"], ["egress"], caches),
        _rule("tell who is there", ["liveliness_token"], ["egress"], [_TOKENS]),
    ]
    if allowed:
        keys = [f"{_DOMAIN}/{own}/{_allowed(name)}/*/*" for name in allowed]
        rules.append(_rule("take", ["put"], ["ingress"], keys))
        rules.append(_rule("want", ["declare_subscriber"], ["egress"], keys))
    if withheld := [name for name, rate in (rates_hz or {}).items() if rate == 0]:
        keys = [f"{_DOMAIN}/{own}/{_topic(name, field='--ground-rate')}/**" for name in withheld]
        rules.append(
            _rule("withhold", _MESSAGES, ["ingress", "egress"], [*keys, *(f"{k}/@adv/**" for k in keys)], "deny")
        )
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "bus", "link_protocols": [inner]}, {"id": "ground", "link_protocols": ["tls"]}],
        "policies": [
            {"rules": ["bus"], "subjects": ["bus"]},
            {"rules": [rule["id"] for rule in rules[1:]], "subjects": ["ground"]},
        ],
    }


def downsampling(vehicle: str, rates_hz: Mapping[str, float]) -> dict[str, Any]:
    """Zenoh's rule that leaves out what comes faster, on the ground link alone."""
    for name, rate in rates_hz.items():
        if not 0 <= rate <= 1000:
            raise InputError(f"{rate:g} Hz for {name}", field="--ground-rate", valid="0..1000")
    return {
        "id": "ground",
        "link_protocols": ["tls"],
        "flows": ["egress"],
        "messages": ["put"],
        "rules": [
            {"key_expr": f"{_DOMAIN}/{vehicle}/{_topic(name, field='--ground-rate')}/*/*", "freq": rate}
            for name, rate in rates_hz.items()
            if rate > 0
        ],
    }


def _small_questions() -> dict[str, Any]:
    return {
        "id": "ground",
        "link_protocols": ["tls"],
        "flows": ["ingress"],
        "messages": ["query"],
        "key_exprs": ["**", "**/@adv/**"],
        "size_limit": QUERY_BYTES,
    }


def _rule(
    name: str, messages: Sequence[str], flows: Sequence[str], keys: Sequence[str], permission: str = "allow"
) -> dict[str, Any]:
    return {
        "id": name,
        "permission": permission,
        "messages": list(messages),
        "flows": list(flows),
        "key_exprs": list(keys),
    }


def _allowed(name: str) -> str:
    if name in topics.BY_NAME:
        raise InputError(f"{name} is the stack's own: nobody on the ground may publish it", field="--ground-allow")
    return _topic(name, field="--ground-allow")


def _topic(name: str, *, field: str) -> str:
    if not _NAME.fullmatch(name):
        raise InputError(f"{name!r} is no name on the bus", field=field, valid="letters, digits, _ and / between")
    return name
