"""Finds a recorded flight in a saved map: its scans, in windows of a second, are looked up until the answer is sure."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from companion.core.errors import InputError
from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, Array32, RegisteredScan
from companion.estimation.places.locate import Located, Locator, Search
from companion.mapping.formats.stored_map import StoredMap
from companion.runtime.flight_folder import logs_of, read_header, rebuild
from companion.runtime.log_file import Message
from companion.runtime.map_places import locator_of
from companion.runtime.replay import Replay

WINDOW_NS = 1_000_000_000
_GROUND_SHARE, _UNDER_M = 0.05, 3.0  # of the points under the vehicle, the lowest are ground


@dataclass(frozen=True, slots=True)
class Window:
    """Scans of a second, in axes of odom about the place of the last of them."""

    stamp_ns: int
    points: Array32  # (N, 3), m
    p_odom: Array  # (3,)

    @property
    def height_m(self) -> float:
        """Above the ground that is seen below."""
        below = self.points[np.hypot(self.points[:, 0], self.points[:, 1]) < _UNDER_M, 2]
        if not len(below):
            raise InputError("no ground is seen below the vehicle", field="--at", valid="a time in the air")
        return float(-np.quantile(below, _GROUND_SHARE))


@dataclass(frozen=True, slots=True)
class Found:
    """What a search came to."""

    located: Located | None
    windows: int
    stamp_ns: int  # of the newest scan looked at
    p_odom: Array  # where odometry was then, (3,)


def locate(stored: StoredMap, flight: Path, *, at_s: float, most_windows: int) -> Found:
    """Where the flight's scans from `at_s` on lie in the map; raises InputError if it stored no scans."""
    search: Search | None = None
    p_before = np.zeros(3)
    for number, window in enumerate(windows(_scans(flight), begin_ns=round(at_s * 1e9)), start=1):
        if search is None:
            search, p_before = Search(_locator(stored, window)), window.p_odom
        located = search.look(window.points, np.eye(3), window.p_odom - p_before)
        p_before = window.p_odom
        if located is not None or number == most_windows:
            return Found(located, number, window.stamp_ns, window.p_odom)
    raise InputError("the flight ends before a second of scans", field="--at", valid="an earlier time")


def windows(scans: Iterable[RegisteredScan], *, begin_ns: int) -> Iterable[Window]:
    """Whole windows from a time on."""
    parts: list[tuple[Array32, Array]] = []
    end_ns = begin_ns + WINDOW_NS
    for scan in scans:
        if scan.stamp_ns < begin_ns:
            continue
        turned = scan.points_body @ rotation_from_quaternion(scan.q_odom_body).T.astype(np.float32)
        parts.append((turned, scan.p_odom))
        if scan.stamp_ns >= end_ns:
            last = scan.p_odom
            points = np.concatenate([part + (p - last).astype(np.float32) for part, p in parts])
            yield Window(scan.stamp_ns, points, last)
            parts, end_ns = [], scan.stamp_ns + WINDOW_NS


def _locator(stored: StoredMap, window: Window) -> Locator:
    return locator_of(stored, height_m=window.height_m)


class _Ear:
    """Keeps the registered scans that a replay computes again."""

    def __init__(self) -> None:
        self.scans: list[RegisteredScan] = []

    def heard(self, entry: Message, message: Any) -> None:
        """One message."""
        if isinstance(message, RegisteredScan):
            self.scans.append(message)


def _scans(flight: Path) -> Iterable[RegisteredScan]:
    """Registered scans of a flight flown with --record, in order."""
    log = next((file for file in logs_of(flight) if "LioNode" in read_header(file).nodes), None)
    if log is None:
        raise InputError("no log of it has LioNode", file=str(flight), valid="the folder of a flight")
    ear = _Ear()
    replay = Replay(log, rebuild(read_header(log)), only="LioNode", listener=ear)
    for _ in replay.run():
        yield from ear.scans
        ear.scans.clear()
