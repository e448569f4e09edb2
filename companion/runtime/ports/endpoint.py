"""Reads MAVLink URLs.

    parse_endpoint("udpin://127.0.0.1:14540", udp_means="in")
    Endpoint(kind='udpin', host='127.0.0.1', port=14540, path='', baud=0)

`udp://` means either side: a companion listens there, a vehicle (PX4, our simulator) sends there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Literal, get_args

from companion.core.errors import InputError

Kind = Literal["udpin", "udpout", "tcp", "tcpin", "serial"]
UdpMeans = Literal["in", "out"]

LOOPBACK: Final = "127.0.0.1"
VALID: Final = (
    "udpin://HOST:PORT, udp://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT, tcpin://HOST:PORT, "
    "serial:///dev/ttyX:BAUD; an IPv6 address in brackets: udpin://[::1]:14540"
)
_BAUD_MIN: Final = 1200
_URL = re.compile(r"(?P<scheme>[a-z0-9]+)://(?P<rest>.*)", re.DOTALL)
_ADDRESS = re.compile(r"(?:\[(?P<six>[0-9A-Fa-f:.%\w-]+)\]|(?P<host>[A-Za-z0-9._-]*)):(?P<port>\d{1,5})")
_DEVICE = re.compile(r"(?P<path>/[^:\s]+):(?P<baud>\d{1,8})")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One end of a link; `host` and `port` for a network, `path` and `baud` for a serial line."""

    kind: Kind
    host: str = ""
    port: int = 0
    path: str = ""
    baud: int = 0

    def __str__(self) -> str:
        """The URL in its plain form."""
        if self.kind == "serial":
            return f"serial://{self.path}:{self.baud}"
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{self.kind}://{host}:{self.port}"


def parse_endpoint(url: str, *, udp_means: UdpMeans = "in", field: str = "MAVLink URL") -> Endpoint:
    """The endpoint of a URL; raises InputError that names the URL, `field` and the valid forms.

    A listener without host (`udpin://:14540`) listens on loopback only.
    """
    match = _URL.fullmatch(url.strip())
    if match is None:
        raise _wrong(url, "is no MAVLink URL", field)
    scheme, rest = match["scheme"], match["rest"].rstrip("/")
    scheme = f"udp{udp_means}" if scheme == "udp" else scheme
    for kind in get_args(Kind):
        if kind == scheme:
            return _serial(url, rest, field) if kind == "serial" else _network(url, kind, rest, field)
    raise _wrong(url, f"has the unknown scheme {scheme}://", field)


def _network(url: str, kind: Kind, rest: str, field: str) -> Endpoint:
    match = _ADDRESS.fullmatch(rest)
    if match is None:
        raise _wrong(url, "needs HOST:PORT", field)
    host, port = match["six"] or match["host"], int(match["port"])
    if not 1 <= port <= 65535:
        raise _wrong(url, f"has port {port}, not 1..65535", field)
    if not host and kind not in ("udpin", "tcpin"):
        raise _wrong(url, "names no host to send to", field)
    return Endpoint(kind, host=host or LOOPBACK, port=port)


def _serial(url: str, rest: str, field: str) -> Endpoint:
    match = _DEVICE.fullmatch(rest)
    if match is None:
        raise _wrong(url, "needs a device and a baud rate, as in serial:///dev/ttyACM0:921600", field)
    if int(match["baud"]) < _BAUD_MIN:
        raise _wrong(url, f"has baud rate {match['baud']}, below {_BAUD_MIN}", field)
    return Endpoint("serial", path=match["path"], baud=int(match["baud"]))


def _wrong(url: str, problem: str, field: str) -> InputError:
    return InputError(f"{url!r} {problem}", field=field, valid=VALID)
