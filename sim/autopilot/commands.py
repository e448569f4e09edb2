"""COMMAND_LONG and COMMAND_INT: what each MAV_CMD does, and the answers to requests for messages."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from companion.core.messages import Array
from sim.autopilot.codec import BY_NAME, LAYOUTS, Encoder
from sim.autopilot.commander import FORCE, Commander
from sim.autopilot.mission_store import MissionStore
from sim.autopilot.modes import BY_NUMBERS, Mode, Result
from sim.autopilot.places import from_integers, place
from sim.autopilot.streams import Streams
from sim.autopilot.telemetry import Telemetry

# Capabilities: MISSION_INT, COMMAND_INT, PARAM_ENCODE_BYTEWISE, SET_POSITION_TARGET_LOCAL_NED,
# MAVLINK2, MISSION_FENCE, MISSION_RALLY.
CAPABILITIES: Final = 4 | 8 | 16 | 128 | 8192 | 16384 | 32768
VERSION: Final = 0x01120000 | 255  # 1.18.0, release
FARTHEST_M: Final = 1e5  # no place beyond is flown to


class Command(NamedTuple):
    """A command of either kind; a COMMAND_INT's x and y stay integers of 1e-7 degrees or 1e-4 m."""

    now_ns: int
    params: tuple[float, ...]  # 1..7
    integer: bool
    frame: int


class Commands:
    """Executes commands; `extra` takes the frames that a command asks for."""

    def __init__(
        self, commander: Commander, telemetry: Telemetry, streams: Streams, encoder: Encoder,
        *, missions: MissionStore, uid: int,
    ) -> None:  # fmt: skip
        self._commander, self._telemetry, self._streams = commander, telemetry, streams
        self._encoder, self._missions, self._uid = encoder, missions, uid
        self.extra = bytearray()
        self._actions: dict[int, Callable[[Command], Result]] = {
            20: lambda c: self._commander.set_mode(c.now_ns, Mode.RETURN),
            21: lambda c: self._commander.set_mode(c.now_ns, Mode.LAND),
            22: self._take_off,
            115: self._turn,
            176: self._do_set_mode,
            178: self._change_speed,
            179: self._set_home,
            192: self._reposition,
            224: self._set_current,
            300: lambda c: self._commander.set_mode(c.now_ns, Mode.MISSION),
            400: self._arm,
            510: self._get_interval,
            511: self._set_interval,
            512: self._request,
            520: lambda c: self._send(148),
            611: self._set_origin,
        }

    def run(self, now_ns: int, number: int, params: tuple[Any, ...], *, integer: bool, frame: int = 0) -> Result:
        """Result of MAV_CMD `number`; unknown ones are UNSUPPORTED."""
        action = self._actions.get(number)
        if action is None:
            return Result.UNSUPPORTED
        return action(Command(now_ns, params, integer, frame))

    def _arm(self, c: Command) -> Result:
        force = c.params[1] == FORCE
        if c.params[0] == 1.0:
            return self._commander.arm(c.now_ns, force=force)
        return self._commander.disarm(force=force) if c.params[0] == 0.0 else Result.DENIED

    def _do_set_mode(self, c: Command) -> Result:
        base, main, sub = c.params[:3]
        if not (math.isfinite(base) and int(base) & 1):
            return Result.UNSUPPORTED
        numbers = int(main) if math.isfinite(main) else -1, int(sub) if math.isfinite(sub) else 0
        mode = BY_NUMBERS.get(numbers)
        return self._commander.set_mode(c.now_ns, mode) if mode else Result.DENIED

    def _take_off(self, c: Command) -> Result:
        """To an altitude above sea level; one that is too low is raised and said, as PX4 does."""
        altitude = c.params[6]
        down = float(self._commander.position[2])
        climb = altitude - self._telemetry.origin[2] + down if math.isfinite(altitude) else math.nan
        return self._commander.take_off(c.now_ns, climb)

    def _turn(self, c: Command) -> Result:
        """CONDITION_YAW: heading in degrees, absolute, or relative with the direction of param 3."""
        degrees, _, direction, relative = c.params[:4]
        if not math.isfinite(degrees) or self._commander.mode is not Mode.HOLD or self._commander.flight.landed:
            return Result.TEMPORARILY_REJECTED
        yaw = math.radians(degrees)
        if relative == 1.0:
            yaw = self._commander.heading + math.copysign(yaw, direction if direction else 1.0)
        self._commander.guidance.go(np.full(3, np.nan), yaw)
        return Result.ACCEPTED

    def _change_speed(self, c: Command) -> Result:
        if not (math.isfinite(c.params[1]) and c.params[1] > 0):
            return Result.DENIED
        self._commander.guidance.cruise = c.params[1]
        return Result.ACCEPTED

    def _reposition(self, c: Command) -> Result:
        target = self._place(c)
        if (np.abs(target) > FARTHEST_M).any():
            return Result.DENIED
        return self._commander.reposition(c.now_ns, target, c.params[3])

    def _set_current(self, c: Command) -> Result:
        return Result.ACCEPTED if self._missions.go_to(_integer(c.params[0])) else Result.DENIED

    def _set_home(self, c: Command) -> Result:
        home = self._commander.position.copy() if c.params[0] == 1.0 else self._place(c)
        if not (np.abs(home) < FARTHEST_M).all():
            return Result.DENIED
        self._commander.set_home(home)
        self._send(242)
        return Result.ACCEPTED

    def _set_origin(self, c: Command) -> Result:
        if not c.integer:
            return Result.DENIED
        return self.set_origin(c.params[4] * 1e-7, c.params[5] * 1e-7, c.params[6])

    def set_origin(self, latitude: float, longitude: float, altitude: float) -> Result:
        """Where the local frame's origin lies on Earth; announced by GPS_GLOBAL_ORIGIN."""
        if not (abs(latitude) < 89.0 and abs(longitude) <= 180.0 and abs(altitude) < FARTHEST_M):
            return Result.DENIED
        self._telemetry.origin = latitude, longitude, altitude
        self._telemetry.origin_known = True
        scaled = round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3)
        self.extra += self._encoder(BY_NAME["GPS_GLOBAL_ORIGIN"], *scaled, self._commander.now_ns // 1000)
        return Result.ACCEPTED

    def place(self, frame: int, xyz: tuple[float, float, float]) -> Array:
        """p_ned (3,) of a place in a MAV_FRAME."""
        return place(self._telemetry.origin, self._commander.home, frame, xyz)

    def _place(self, c: Command) -> Array:
        """Target NED of parameters 5-7; unset components are NaN."""
        x, y, z = c.params[4:7]
        if c.integer:
            x, y = from_integers(c.frame, int(x), int(y))
        return self.place(c.frame, (x, y, z))

    def _get_interval(self, c: Command) -> Result:
        msg_id = _integer(c.params[0])
        period = self._streams.period_ns.get(msg_id)
        interval = round(period / 1e3) if period else -1 if msg_id in self._telemetry.ids else 0
        self.extra += self._encoder(BY_NAME["MESSAGE_INTERVAL"], interval, msg_id & 0xFFFF)
        return Result.ACCEPTED

    def _set_interval(self, c: Command) -> Result:
        msg_id = _integer(c.params[0])
        done = self._streams.set_interval(
            self._commander.now_ns, msg_id, c.params[1], known=msg_id in self._telemetry.ids
        )
        return Result.ACCEPTED if done else Result.DENIED

    def _request(self, c: Command) -> Result:
        return self._send(_integer(c.params[0]), max(_integer(c.params[1]), 0))

    def _send(self, msg_id: int, wanted: int = 0) -> Result:
        if msg_id == 148:
            self.extra += self._version()
        elif msg_id == 435:
            return self._send_modes(wanted)
        elif msg_id in self._telemetry.ids:
            frame = self._telemetry.pack(msg_id)
            self.extra += frame
            return Result.ACCEPTED if frame else Result.FAILED
        else:
            return Result.UNSUPPORTED if msg_id not in LAYOUTS else Result.DENIED
        return Result.ACCEPTED

    def _version(self) -> bytes:
        none = (0,) * 8
        return self._encoder(
            BY_NAME["AUTOPILOT_VERSION"], CAPABILITIES, self._uid, VERSION, VERSION, 0, 1, 0, 0,
            *none, *none, *none, *((0,) * 18),
        )  # fmt: skip

    def _send_modes(self, wanted: int) -> Result:
        """AVAILABLE_MODES of number `wanted`, from 1; 0: of all."""
        modes = list(BY_NUMBERS.values())
        if wanted > len(modes):
            return Result.DENIED
        for index, mode in enumerate(modes, 1):
            if wanted in (0, index):
                text = mode.value[2].encode()
                self.extra += self._encoder(
                    BY_NAME["AVAILABLE_MODES"], mode.custom_mode, 0, len(modes), index, 0, text
                )  # fmt: skip
        return Result.ACCEPTED


def _integer(value: float) -> int:
    return int(value) if math.isfinite(value) else -1
