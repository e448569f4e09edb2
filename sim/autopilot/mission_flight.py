"""Flies the stored mission item by item, as PX4's mission mode does.

A mission that begins on the ground takes off first: to the height of its first place. Items that
move nothing (speed, camera, gimbal, region of interest) are passed at once. After the last item
the vehicle stays where it is, in mission mode, and starts from the first when told to again.

Source: PX4 user guide, "Mission Mode"; MAV_CMD of mavlink.io.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Final, NamedTuple

from companion.core.messages import Array
from sim.autopilot.commander import Commander, Say
from sim.autopilot.flight import Phase
from sim.autopilot.mission_store import CHANGE_SPEED, DELAY, LAND, LOITER, MOVING, RETURN, TAKEOFF, MissionStore
from sim.autopilot.modes import Mode, Severity
from sim.autopilot.places import from_integers

HEIGHTLESS: Final = (LAND, RETURN)  # their altitude is not one to fly at
NEAR_M: Final = 1.0  # a leg so short does not turn the nose
NS: Final = 1_000_000_000
Place = Callable[[int, tuple[float, float, float]], Array]  # frame, (x, y, z) -> p_ned


class Item(NamedTuple):
    """One MISSION_ITEM_INT, as flown."""

    params: tuple[float, ...]  # 1..4
    x: int
    y: int
    z: float
    command: int
    frame: int

    @classmethod
    def of(cls, values: tuple[float, ...]) -> Item:
        """From the fields in the order of the wire."""
        return cls(values[0:4], int(values[4]), int(values[5]), values[6], int(values[8]), int(values[11]))


class MissionFlight:
    """One `step` per 10 ms, before the commander's; does nothing in other modes."""

    def __init__(self, store: MissionStore, commander: Commander, *, place: Place, say: Say) -> None:
        self._store, self._commander = store, commander
        self._place, self._say = place, say
        commander.mission_ready = lambda: store.flyable
        self._flown: tuple[int, int] | None = None  # version of the plan, index: what is flown now
        self._lifting = False
        self._since_ns = 0  # arrived there, or began a delay; 0: not yet

    def step(self, now_ns: int) -> None:
        """Notice arrivals, go on to the next item."""
        c, store = self._commander, self._store
        store.active = c.mode is Mode.MISSION and c.armed
        if not store.active:
            self._flown = None
            return
        if not store.flyable:
            c.set_mode(now_ns, Mode.HOLD)
        elif c.flight.phase is Phase.GROUND:
            self._on_ground()
        elif self._lifting:
            self._lifting = not c.arrived()
        else:
            self._in_the_air(now_ns)

    def _on_ground(self) -> None:
        c, store = self._commander, self._store
        if c.flight.has_flown:  # the commander disarms soon
            if store.items[0][store.current][8] == LAND:
                self._pass()
        else:
            self._lifting, self._flown = True, None
            c.climb_to(self._first_height_m())

    def _in_the_air(self, now_ns: int) -> None:
        if self._flown != (self._store.version, self._store.current):
            self._take_up(now_ns)
        elif not self._store.complete and self._is_done(now_ns):
            self._pass()

    def _take_up(self, now_ns: int) -> None:
        """Begin the current item; a plan that was over begins anew."""
        store = self._store
        if store.complete:
            store.go_to(0)
        self._flown, self._since_ns = (store.version, store.current), 0
        item, c = Item.of(store.items[0][store.current]), self._commander
        c.guidance.landing = False
        if item.command == CHANGE_SPEED and item.params[1] > 0:
            c.guidance.cruise = item.params[1]
        if item.command == RETURN:
            self._pass()
            c.set_mode(now_ns, Mode.RETURN)
        elif item.command == DELAY:
            c.brake()
        elif store.moves(store.current):
            self._go(item)

    def _go(self, item: Item) -> None:
        c = self._commander
        target = self._target(item)
        leg = target[:2] - c.position[:2]
        yaw = math.radians(item.params[3])
        if math.isnan(yaw) and math.hypot(leg[0], leg[1]) > NEAR_M:
            yaw = math.atan2(leg[1], leg[0])
        c.guidance.go(target, yaw)

    def _target(self, item: Item) -> Array:
        """p_ned; NaN components stay."""
        target = self._place(item.frame, (*from_integers(item.frame, item.x, item.y), item.z))
        if item.command == TAKEOFF:
            target[:2] = math.nan
        if item.command in HEIGHTLESS:
            target[2] = math.nan
        return target

    def _is_done(self, now_ns: int) -> bool:
        store, c = self._store, self._commander
        item = Item.of(store.items[0][store.current])
        if not store.moves(store.current):
            return True
        if item.command == LAND:
            c.guidance.landing = c.guidance.landing or c.arrived()
            return False  # the ground says when
        if item.command == LOITER or not (self._since_ns or item.command == DELAY or c.arrived()):
            return False
        self._since_ns = self._since_ns or now_ns
        stay_s = 0.0 if item.command == TAKEOFF or not item.params[0] > 0 else item.params[0]
        return now_ns - self._since_ns >= stay_s * NS

    def _pass(self) -> None:
        """The current item is done."""
        store = self._store
        if store.complete:
            return
        store.reached()
        if store.complete:
            self._flown = (store.version, store.current)
            self._say(Severity.INFO, "Mission finished, loitering")

    def _first_height_m(self) -> float:
        """Climb from here to the height of the first place; NaN: MIS_TAKEOFF_ALT."""
        for values in self._store.items[0][self._store.current :]:
            item = Item.of(values)
            if item.command in MOVING and item.command not in (DELAY, *HEIGHTLESS):
                down = float(self._target(item)[2])
                climb = float(self._commander.position[2]) - down
                return climb if climb > 0 else math.nan
        return math.nan
