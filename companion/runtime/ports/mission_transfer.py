"""Missions to and from an autopilot's own memory, by MAVSDK, on an endpoint of its own.

with MissionTransfer("udpin://127.0.0.1:14550") as transfer:
    transfer.upload(items_of(places))
    transfer.download()
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import TracebackType
from typing import Any, Final, Self

from companion.autopilot import mission_items as mi
from companion.autopilot.mission_items import MissionItem
from companion.core.errors import CompanionError
from companion.mission.on_earth import Place
from companion.runtime.ports.ground_station import FIRST_HEARTBEAT_S, GroundStation

MISSION: Final = 0  # MAV_MISSION_TYPE


class TransferRefused(CompanionError):
    """The autopilot does not take the mission."""


def items_of(places: Sequence[Place]) -> list[MissionItem]:
    """Places as items; a speed is said when it changes, and a landing is where the last place is."""
    items: list[MissionItem] = []
    speed, here = math.nan, (math.nan, math.nan)
    for place in places:
        if place.do in ("takeoff", "fly"):
            here = (place.latitude_deg, place.longitude_deg)
            command = mi.TAKEOFF if place.do == "takeoff" else mi.WAYPOINT
            items.append(mi.at_place(command, *here, place.height_m))
        elif place.do == "hover":
            items.append(mi.wait(place.seconds))
        elif place.do == "land":
            items.append(mi.at_place(mi.LAND, *here, 0.0))
        else:
            items.append(mi.go_home())
        if place.speed != speed and place.do in ("takeoff", "fly"):
            speed = place.speed  # behind the take-off, before every other way
            items.insert(len(items) - (place.do != "takeoff"), mi.fly_at(speed))
    return items


class MissionTransfer:
    """A context manager; raises what `GroundStation` raises. Every call ends within some seconds."""

    def __init__(self, url: str, *, wait_s: float = FIRST_HEARTBEAT_S) -> None:
        self._station = GroundStation(url, "mission_raw", wait_s=wait_s)
        self._plugin = self._station.plugin
        self._missions = self._plugin.MissionRaw(self._station.system)

    def upload(self, items: Sequence[MissionItem]) -> None:
        """Replace the stored mission, and read it back: TransferRefused if it is another then."""
        self._station.check_link()
        try:
            self._missions.upload_mission([self._raw(number, item) for number, item in enumerate(items)])
        except self._plugin.MissionRawError as error:
            raise self._refused(error) from error
        kept = self.download()
        for number, (sent, found) in enumerate(zip(items, kept, strict=False)):
            if not _same(sent, found):
                raise TransferRefused(f"item {number + 1}: the vehicle kept {mi.described(found)}")
        if len(kept) != len(items):
            raise TransferRefused(f"the vehicle kept {len(kept)} of {len(items)} items")

    def download(self) -> list[MissionItem]:
        """The stored mission."""
        self._station.check_link()
        try:
            found = self._missions.download_mission()
        except self._plugin.MissionRawError as error:
            raise self._refused(error) from error
        return [MissionItem(i.frame, i.command, (i.param1, i.param2, i.param3, i.param4), i.x, i.y, i.z) for i in found]

    def close(self) -> None:
        """Close the connection."""
        self._station.close()

    def _raw(self, number: int, item: MissionItem) -> Any:
        place = dict(zip(("param1", "param2", "param3", "param4"), item.params, strict=True))
        return self._plugin.MissionItem(
            seq=number, frame=item.frame, command=item.command, current=int(number == 0), autocontinue=1,
            x=item.x, y=item.y, z=item.z, mission_type=MISSION, **place,
        )  # fmt: skip

    def _refused(self, error: Any) -> CompanionError:
        result = self._plugin.MissionRawResult
        if error.result in (result.TIMEOUT, result.NO_SYSTEM):
            return self._station.silent("the mission")
        return TransferRefused(f"the autopilot refuses the mission: {error.result.name.lower().replace('_', ' ')}")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def _same(sent: MissionItem, found: MissionItem) -> bool:
    """But for a float's 32 bits; NaN is NaN."""
    numbers = zip((*sent.params, sent.z), (*found.params, found.z), strict=True)
    alike = all((math.isnan(a) and math.isnan(b)) or math.isclose(a, b, rel_tol=1e-6, abs_tol=1e-6) for a, b in numbers)
    return alike and (sent.command, sent.x, sent.y) == (found.command, found.x, found.y)
