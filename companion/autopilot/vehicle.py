"""What the autopilot says of itself, gathered from its messages."""

from __future__ import annotations

from enum import IntEnum
from typing import Any, Final, NamedTuple

import numpy as np

from companion.autopilot import frames
from companion.autopilot.boot_clock import BootClock
from companion.autopilot.modes import AUTOPILOT_ARDUPILOT, Flavour, mode_name
from companion.core.messages import Array, VehicleStatus, freeze


class Id(IntEnum):
    """Ids of the messages that tell the vehicle's state."""

    HEARTBEAT = 0
    SYS_STATUS = 1
    SYSTEM_TIME = 2
    LOCAL_POSITION_NED = 32
    BATTERY_STATUS = 147
    EKF_STATUS_REPORT = 193  # ArduPilot's
    ESTIMATOR_STATUS = 230  # PX4's
    EXTENDED_SYS_STATE = 245
    STATUSTEXT = 253


_ARMED: Final = 0x80  # MAV_MODE_FLAG_SAFETY_ARMED
_NOT_AN_AUTOPILOT: Final = 8  # MAV_AUTOPILOT_INVALID
_ON_GROUND: Final = 1  # MAV_LANDED_STATE
_PREARM_CHECK: Final = 1 << 28  # MAV_SYS_STATUS_PREARM_CHECK
# ESTIMATOR_STATUS_FLAGS and EKF_STATUS_FLAGS share these bits
_OVERTAKEN_NS: Final = 250_000_000  # by so much one datagram may overtake another
_NEEDED: Final = 1 | 2 | 4 | 32  # attitude, horizontal and vertical velocity, height
_POSITION: Final = 8 | 16  # relative or absolute
_EKF_NO_AIDING: Final = 128 | 1024  # EKF_STATUS_REPORT only: constant position, uninitialised


class State(NamedTuple):
    """What counts as a change; position and battery do not. See VehicleStatus."""

    connected: bool
    armed: bool
    mode: str
    landed: bool
    ready: bool
    text: str


class Vehicle:
    """Feed decoded messages of the one autopilot with `take`; read `status`."""

    def __init__(self, *, heartbeat_timeout_s: float, data_timeout_s: float, require_prearm: bool) -> None:
        self._heartbeat_timeout_ns = round(heartbeat_timeout_s * 1e9)
        self._data_timeout_ns = round(data_timeout_s * 1e9)
        self._require_prearm = require_prearm
        self._boot_clock = BootClock()
        self.flavour: Flavour = "px4"
        self._forget()

    def _forget(self) -> None:
        self._heard: dict[int, int] = {}  # message id -> stamp of the newest
        self._sequence = 0  # of the newest heartbeat
        self._armed = False
        self._custom_mode = 0
        self._landed_state = 0
        self._prearm_ok = False
        self._estimator_ok = False
        self._battery = float("nan")
        self._p_odom, self._v_odom = np.full(3, np.nan), np.full(3, np.nan)
        self._text = _Text()

    def rebooted(self, msg_id: int, boot_ms: int) -> bool:
        """Note the time since boot that message `msg_id` tells; if it went back, forget what was before."""
        if not self._boot_clock.went_back(msg_id, boot_ms):
            return False
        self._forget()
        return True

    def take(self, msg_id: int, message: Any, now_ns: int, *, sequence: int = 0) -> bool:
        """Note one message; ids without meaning here are ignored. True if it shows a reboot.

        Heartbeats and positions that others overtook on the way are dropped; `sequence` is the frame's.
        """
        rebooted = False
        match msg_id:
            case Id.HEARTBEAT:
                if not self._take_heartbeat(message, sequence, now_ns):
                    return False
            case Id.SYS_STATUS:
                self._prearm_ok = bool(message.onboard_control_sensors_health & _PREARM_CHECK)
                self._take_battery(message.battery_remaining)
            case Id.SYSTEM_TIME:
                rebooted = self.rebooted(msg_id, message.time_boot_ms)
            case Id.LOCAL_POSITION_NED:
                rebooted = self.rebooted(msg_id, message.time_boot_ms)
                if self._boot_clock.is_late(msg_id, message.time_boot_ms):
                    return False
                self._p_odom = frames.swap_world(np.array(message[1:4]))
                self._v_odom = frames.swap_world(np.array(message[4:7]))
            case Id.BATTERY_STATUS:
                if message.id == 0:
                    self._take_battery(message.battery_remaining)
            case Id.EKF_STATUS_REPORT | Id.ESTIMATOR_STATUS:
                self._take_estimator(msg_id, message.flags)
            case Id.EXTENDED_SYS_STATE:
                self._landed_state = message.landed_state
            case Id.STATUSTEXT:
                self._text.take(message)
        self._heard[msg_id] = now_ns
        return rebooted

    def _take_heartbeat(self, message: Any, sequence: int, now_ns: int) -> bool:
        if message.autopilot == _NOT_AN_AUTOPILOT:
            return False
        before_ns = self._heard.get(Id.HEARTBEAT)
        ahead = (sequence - self._sequence) & 0xFF
        soon = before_ns is not None and now_ns - before_ns < _OVERTAKEN_NS
        if soon and ahead >= 128:
            return False
        self._sequence = sequence
        self.flavour = "ardupilot" if message.autopilot == AUTOPILOT_ARDUPILOT else "px4"
        self._armed = bool(message.base_mode & _ARMED)
        self._custom_mode = message.custom_mode
        return True

    def _take_battery(self, percent: int) -> None:
        if percent >= 0:  # -1: not measured
            self._battery = min(percent / 100, 1.0)

    def _take_estimator(self, msg_id: int, flags: int) -> None:
        aided = msg_id == Id.ESTIMATOR_STATUS or not flags & _EKF_NO_AIDING
        self._estimator_ok = flags & _NEEDED == _NEEDED and bool(flags & _POSITION) and aided

    def connected(self, now_ns: int) -> bool:
        """A heartbeat came within the timeout."""
        return self._fresh(Id.HEARTBEAT, now_ns, self._heartbeat_timeout_ns)

    def _fresh(self, msg_id: int, now_ns: int, timeout_ns: int) -> bool:
        heard = self._heard.get(msg_id)
        return heard is not None and now_ns - heard <= timeout_ns

    def _positioned(self, now_ns: int) -> bool:
        return self._fresh(Id.LOCAL_POSITION_NED, now_ns, self._data_timeout_ns)

    def _ready(self, now_ns: int) -> bool:
        if not self.connected(now_ns) or not self._positioned(now_ns) or not self._estimator_ok:
            return False
        slow_ns = 3 * self._data_timeout_ns  # sent at 1 Hz
        estimator = Id.ESTIMATOR_STATUS if self.flavour == "px4" else Id.EKF_STATUS_REPORT
        if not self._fresh(estimator, now_ns, slow_ns):
            return False
        return not self._require_prearm or (self._prearm_ok and self._fresh(Id.SYS_STATUS, now_ns, slow_ns))

    def state(self, now_ns: int) -> State:
        """The part of the status of which every change is news."""
        return State(
            self.connected(now_ns),
            self._armed,
            mode_name(self._custom_mode, self.flavour) if Id.HEARTBEAT in self._heard else "",
            self._landed(),
            self._ready(now_ns),
            self._text.newest,
        )

    @property
    def airborne(self) -> bool:
        """Armed and not on the ground."""
        return self._armed and not self._landed()

    def _landed(self) -> bool:
        """Without EXTENDED_SYS_STATE, disarmed rotors are the evidence."""
        return self._landed_state == _ON_GROUND if self._landed_state else not self._armed

    def status(self, now_ns: int) -> VehicleStatus:
        """Everything in our frames; position and velocity are NaN once they are stale."""
        fresh = self._positioned(now_ns)
        state = self.state(now_ns)
        status: VehicleStatus = freeze(
            VehicleStatus(
                stamp_ns=now_ns,
                connected=state.connected,
                armed=state.armed,
                mode=state.mode,
                landed=state.landed,
                ready=state.ready,
                battery_fraction=self._battery,
                p_odom=_copy_or_nan(self._p_odom, fresh),
                v_odom=_copy_or_nan(self._v_odom, fresh),
                text=state.text,
            )
        )
        return status


def _copy_or_nan(v: Array, fresh: bool) -> Array:
    return v.copy() if fresh else np.full(3, np.nan)


class _Text:
    """STATUSTEXT, joined again when it came in chunks (same id, rising chunk_seq)."""

    LENGTH_MAX: Final = 500

    def __init__(self) -> None:
        self.newest = ""
        self._id = 0

    def take(self, message: Any) -> None:
        text = message.text
        if message.id and message.id == self._id and message.chunk_seq:
            self.newest = (self.newest + text)[: self.LENGTH_MAX]
        else:
            self.newest = text
        self._id = message.id
