"""A seat beside the flight: MAVSDK on an endpoint of its own, for requests that wait for answers.

The only module beside `companion.autopilot` that may import a MAVLink library. It is an optional extra, imported when a
vehicle is opened. MAVSDK 4.1 cannot sign: a vehicle that wants signed frames is heard, and does not answer.
"""

from __future__ import annotations

from types import TracebackType
from typing import Any, Final, Literal, Self

from companion.core.errors import CompanionError, InputError, LinkError
from companion.runtime.ports.endpoint import parse_endpoint

Plugin = Literal["param", "mission_raw"]
FIRST_HEARTBEAT_S: Final = 10.0
_SCHEME: Final = {"tcp": "tcpout"}  # MAVSDK's word, where it is another than ours
_BUSY: Final = "is another ground station listening there?"
INSTALL: Final = "this needs MAVSDK: run `python -m pip install 'understory[mavsdk]'`"


class GroundStation:
    """Connects, and waits for an autopilot's heartbeat; a context manager. `udp://` listens.

    Raises InputError for a bad URL, CompanionError without MAVSDK,
    LinkError if nobody is heard within `wait_s`.
    """

    def __init__(self, url: str, plugin: Plugin, *, wait_s: float) -> None:
        self.endpoint = parse_endpoint(url, udp_means="in", field="--vehicle")
        if ":" in self.endpoint.host:
            raise InputError(f"{url!r}: MAVSDK has no IPv6", field="--vehicle", valid="a name or an IPv4 address")
        self._mavsdk, self.plugin = _libraries(plugin)
        mavsdk = self._mavsdk
        mavsdk.log_subscribe(_keep_quiet)
        station = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        self._sdk = mavsdk.Mavsdk(station)
        try:
            self.system = self._connect(mavsdk.ConnectionResult, wait_s)
        except BaseException:
            self.close()
            raise

    def _connect(self, result: Any, wait_s: float) -> Any:
        scheme, rest = str(self.endpoint).split("://", 1)
        code = result(self._sdk.add_any_connection(f"{_SCHEME.get(scheme, scheme)}://{rest}"))
        if code != result.SUCCESS:
            hint = _BUSY if code == result.BIND_ERROR else ""
            raise LinkError(f"{self.endpoint}: {code.name.lower().replace('_', ' ')}; {hint}".rstrip("; "))
        system = self._sdk.first_autopilot(wait_s)
        if system is None:
            raise LinkError(
                f"{self.endpoint}: no autopilot heard within {wait_s:g} s: "
                "does the vehicle send there? `companion sim` sends to udp://127.0.0.1:14550"
            )
        return system

    def check_link(self) -> None:
        """Raises LinkError if the autopilot is not heard any more."""
        if not self.system.is_connected():
            raise LinkError(f"{self.endpoint}: the autopilot is not heard any more")

    def silent(self, what: str) -> LinkError:
        """The error for an answer that never came."""
        hint = "if its link is signed, MAVSDK cannot talk to it: use a link without a key"
        return LinkError(f"{self.endpoint}: the autopilot does not answer about {what}; {hint}")

    def close(self) -> None:
        """End MAVSDK's threads and close the connection."""
        self._sdk.destroy()
        self._mavsdk.log_unsubscribe()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _libraries(plugin: Plugin) -> tuple[Any, Any]:
    """MAVSDK and one of its plug-ins."""
    try:
        import mavsdk
        from mavsdk.plugins.mission_raw import mission_raw
        from mavsdk.plugins.param import param
    except ImportError as error:
        raise CompanionError(INSTALL) from error
    return mavsdk, {"param": param, "mission_raw": mission_raw}[plugin]


def _keep_quiet(_level: object, _message: str, _file: str | None, _line: int) -> bool:
    """MAVSDK's own words do not belong into the output; its results come as codes."""
    return True
