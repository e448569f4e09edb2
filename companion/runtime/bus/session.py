"""Open a Zenoh session: the first on a host is the router, those after it are its peers.

Data flows directly between peers and survives the router's death; without multicast nothing
is found by accident, and nothing listens beyond the loopback unless it is told to.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Literal

import zenoh

from companion.core.errors import InputError, LinkError
from companion.runtime.bus.certificate_files import Credentials

Role = Literal["router", "peer", "client"]
ENDPOINT = "tcp/127.0.0.1:7447"
CONNECT_MS = 2000
PATIENCE_US = 5000  # a `put` waits at most so long for room before it drops: a busy core takes longer than 1 ms
QUEUES = {  # batches that may wait per priority; two are too few for 200 messages a second beside bulk
    "control": 4, "real_time": 16, "interactive_high": 16, "interactive_low": 4, "data_high": 4, "data": 4,
    "data_low": 4, "background": 2,
}  # fmt: skip
COMMON: dict[str, Any] = {
    "scouting/multicast/enabled": False,
    "transport/link/tx/queue/size": QUEUES,
    "transport/link/tx/queue/congestion_control/drop/wait_before_drop": PATIENCE_US,
    "timestamping/enabled": True,  # an advanced publisher wants it
}


def open_session(
    role: Role | Literal["first"], *, endpoint: str = ENDPOINT, credentials: Credentials | None = None
) -> zenoh.Session:
    """A session on `endpoint`; `first` is a router if nobody listens there, otherwise a peer.

    A `peer` goes on trying to reach the router; a `client` raises LinkError if nobody answers, a
    `router` if the endpoint is taken. A client of a ground link (`tls/HOST:PORT`) needs `credentials`.
    """
    if endpoint.startswith("tls/") and credentials is None:
        raise InputError(
            f"{endpoint} wants a certificate", field="--certs", valid="the folder of `companion keys cert`"
        )
    if role == "first":
        try:
            return open_session("router", endpoint=endpoint)
        except LinkError:
            return open_session("peer", endpoint=endpoint)
    try:
        return zenoh.open(_config(role, endpoint, credentials))
    except zenoh.ZError as error:
        raise LinkError(_explained(role, endpoint, str(error))) from error


def configured(settings: Mapping[str, Any]) -> zenoh.Config:
    """A Zenoh configuration from its keys; raises InputError that names a key Zenoh refuses."""
    config = zenoh.Config()
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as error:
            raise InputError(f"Zenoh refuses {value!r}: {error}", field=key) from error
    return config


def tls_trust(credentials: Credentials) -> dict[str, Any]:
    """Both sides of a TLS link show a certificate of one authority, and one that is valid now."""
    return {
        "root_ca_certificate": str(credentials.authority),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "close_link_on_expiration": True,
    }


def _config(role: Role, endpoint: str, credentials: Credentials | None) -> zenoh.Config:
    host = endpoint.rpartition(":")[0]
    listen = {"router": [endpoint], "peer": [f"{host}:0"], "client": []}[role]
    tls = {} if credentials is None else {"transport/link/tls": _shown(credentials)}
    return configured(
        COMMON
        | tls
        | {
            "mode": role,
            "connect/endpoints": [] if role == "router" else [endpoint],
            "connect/exit_on_failure": role == "client",
            "connect/timeout_ms": CONNECT_MS if role == "client" else 0,
            "listen/endpoints": listen,
            "scouting/gossip/enabled": True,
        }
    )


def _shown(credentials: Credentials) -> dict[str, Any]:
    return tls_trust(credentials) | {
        "connect_certificate": str(credentials.certificate),
        "connect_private_key": str(credentials.key),
    }


def _explained(role: Role, endpoint: str, error: str) -> str:
    if role == "client" and endpoint.startswith("tls/"):
        return (
            f"no ground link at {endpoint}: nobody listens, or one side does not take the other's certificate "
            "(another authority, expired, or made for another --host)"
        )
    if role == "client":
        return f"nobody answers on the bus at {endpoint}: start `companion sim`, `companion run` or a Zenoh router"
    if "in use" in error:
        return f"another bus router listens at {endpoint}"
    return f"no Zenoh session at {endpoint}: {error.split(' at /')[0]}"
