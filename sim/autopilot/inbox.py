"""What comes over the link: each frame to the part that handles it, with PX4's rules of what to drop."""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from sim.autopilot.codec import BY_NAME, Encoder, Frame
from sim.autopilot.commander import Commander, Say
from sim.autopilot.commands import Commands
from sim.autopilot.estimator import Estimator
from sim.autopilot.frames import euler_from_quaternion
from sim.autopilot.mission_store import MissionStore
from sim.autopilot.modes import BY_NUMBERS, Severity
from sim.autopilot.params import ParameterService
from sim.autopilot.places import from_integers
from sim.autopilot.readings import ExternalPose
from sim.autopilot.setpoint import Refused, read_setpoint
from sim.autopilot.timesync import TimeSync

LOCAL_NED, BODY_FRD, LOCAL_FRD = 1, 12, 20
INT_FRAMES: Final = {0: 0, 3: 3, 5: 0, 6: 3}  # MAV_FRAME of a global setpoint: above sea, or above home
VISION_TYPES: Final = (0, 1, 2, 3)  # MAV_ESTIMATOR_TYPE: unknown, naive, vision, VIO; not LIDAR (8)
NAK, UNKNOWN_COMMAND = 129, 7  # FTP
POSE_PLACES, VELOCITY_PLACES = (0, 6, 11, 20), (0, 6, 11)  # diagonal places: x, y, z, yaw


class Inbox:
    """Dispatches frames; answers wait in `take()`."""

    def __init__(
        self, system_id: int, commander: Commander, estimator: Estimator, commands: Commands,
        *, encoder: Encoder, timesync: TimeSync, parameters: ParameterService, missions: MissionStore, say: Say,
    ) -> None:  # fmt: skip
        self._system, self._commander, self._estimator = system_id, commander, estimator
        self._commands, self._encoder, self._timesync = commands, encoder, timesync
        self._parameters, self._missions, self._say = parameters, missions, say
        self._out = bytearray()
        self._handlers = {
            BY_NAME[name].msg_id: handler
            for name, handler in {
                "SET_POSITION_TARGET_LOCAL_NED": self._setpoint,
                "SET_POSITION_TARGET_GLOBAL_INT": self._global_setpoint,
                "ODOMETRY": self._odometry,
                "TIMESYNC": self._time,
                "COMMAND_LONG": self._command_long,
                "COMMAND_INT": self._command_int,
                "SET_MODE": self._set_mode,
                "MANUAL_CONTROL": self._manual_control,
                "PING": self._ping,
                "SET_GPS_GLOBAL_ORIGIN": self._origin,
                "FILE_TRANSFER_PROTOCOL": self._file_transfer,
                "LOG_REQUEST_LIST": self._log_list,
            }.items()
        }

    def take(self) -> bytearray:
        """The answers so far; they are handed out once."""
        out, self._out = self._out, bytearray()
        return out

    def handle(self, now_ns: int, frame: Frame) -> None:
        """One frame of whatever kind from whomever."""
        if frame.system == self._system and frame.component == 1:
            return  # our own, come back
        handler = self._handlers.get(frame.layout.msg_id)
        if handler is not None:
            handler(now_ns, frame)
        elif frame.layout.name.startswith("PARAM_") and self._for_us(frame):
            self._out += self._parameters.handle(frame)
        elif frame.layout.name.startswith("MISSION_") and self._for_us(frame):
            self._out += self._missions.handle(now_ns, frame)

    def _for_us(self, frame: Frame) -> bool:
        named = frame.named
        return named.get("target_system", -1) in (0, self._system) and named.get("target_component", 0) in (0, 1)

    def _setpoint(self, now_ns: int, frame: Frame) -> None:
        values = frame.values
        if values[13] not in (0, self._system) or values[14] not in (0, 1):
            return
        self._accept(now_ns, values)

    def _global_setpoint(self, now_ns: int, frame: Frame) -> None:
        """The same with a place on Earth: it becomes a local one."""
        values = list(frame.values)  # time, latitude, longitude, altitude, v, a, yaw, yaw rate, mask, system...
        if values[13] not in (0, self._system) or values[14] not in (0, 1):
            return
        kind = INT_FRAMES.get(values[15])
        if kind is None:
            self._say(Severity.CRITICAL, f"SET_POSITION_TARGET_GLOBAL_INT coordinate frame {values[15]} unsupported")
            return
        values[1:4] = self._commands.place(kind, (*from_integers(kind, values[1], values[2]), values[3]))
        values[15] = LOCAL_NED
        self._accept(now_ns, tuple(values))

    def _accept(self, now_ns: int, values: tuple[float, ...]) -> None:
        setpoint = read_setpoint(values, euler_from_quaternion(self._estimator.q)[2])
        if isinstance(setpoint, Refused):
            self._say(Severity.CRITICAL, setpoint.text)
        else:
            self._commander.accept_setpoint(now_ns, setpoint)

    def _odometry(self, now_ns: int, frame: Frame) -> None:
        """PX4 takes LOCAL_NED or LOCAL_FRD poses with BODY_FRD or local velocities, of vision only."""
        v = frame.values
        frame_id, child, counter, kind, quality = v[56:61]
        if kind not in VISION_TYPES:
            self._say(Severity.CRITICAL, f"ODOMETRY: estimator_type {kind} unsupported")
            return
        if frame_id not in (LOCAL_NED, LOCAL_FRD):
            self._say(Severity.CRITICAL, f"ODOMETRY: frame_id {frame_id} unsupported")
            return
        velocity = np.array(v[8:11])
        if child not in (BODY_FRD, LOCAL_NED, LOCAL_FRD):
            self._say(Severity.CRITICAL, f"ODOMETRY: child_frame_id {child} unsupported")
            velocity[:] = np.nan
        pose_variance, velocity_variance = v[14:35], v[35:56]
        px, py, pz, yaw = (pose_variance[k] for k in POSE_PLACES)
        vx, vy, vz = (velocity_variance[k] for k in VELOCITY_PLACES)
        self._estimator.external_pose(
            ExternalPose(
                stamp_ns=self._timesync.to_autopilot(v[0] * 1000, now_ns),
                p=_finite(np.array(v[1:4])),
                v=_finite(velocity),
                v_in_body=child == BODY_FRD,
                yaw=_heading(v[4:8]),
                variance=_finite(np.array([px, py, pz, vx, vy, vz, yaw])),
                aligned_with_north=frame_id == LOCAL_NED,
                reset_counter=counter,
                quality=quality,
            )
        )

    def _time(self, now_ns: int, frame: Frame) -> None:
        theirs, ours = frame.values
        if theirs == 0:
            self._out += self._encoder(BY_NAME["TIMESYNC"], now_ns, ours)
        elif theirs > 0:
            self._timesync.answer(now_ns, theirs_ns=theirs, ours_ns=ours)

    def _command_long(self, now_ns: int, frame: Frame) -> None:
        number, system, component = frame.values[7:10]
        if system in (0, self._system) and component in (0, 1):
            result = self._commands.run(now_ns, number, frame.values[:7], integer=False)
            self._ack(number, result, frame)

    def _command_int(self, now_ns: int, frame: Frame) -> None:
        number, system, component, place = frame.values[7:11]
        if system in (0, self._system) and component in (0, 1):
            result = self._commands.run(now_ns, number, frame.values[:7], integer=True, frame=place)
            self._ack(number, result, frame)

    def _ack(self, number: int, result: int, frame: Frame) -> None:
        self._out += self._encoder(BY_NAME["COMMAND_ACK"], number, result, 0, 0, frame.system, frame.component)

    def _set_mode(self, now_ns: int, frame: Frame) -> None:
        custom, system, base = frame.values
        mode = BY_NUMBERS.get((custom >> 16 & 0xFF, custom >> 24))
        if system == self._system and base & 1 and mode is not None:
            self._commander.set_mode(now_ns, mode)

    def _manual_control(self, now_ns: int, frame: Frame) -> None:
        x, y, z, r, _, target = frame.values[:6]
        if target == self._system:
            sticks = np.array([x, y, 2 * z - 1000, r]) / 1000.0
            self._commander.accept_sticks(now_ns, np.clip(sticks, -1.0, 1.0))

    def _ping(self, now_ns: int, frame: Frame) -> None:
        stamp, sequence, system, component = frame.values
        if system == 0 and component == 0:
            self._out += self._encoder(BY_NAME["PING"], stamp, sequence, frame.system, frame.component)

    def _origin(self, now_ns: int, frame: Frame) -> None:
        latitude, longitude, altitude, system, _ = frame.values
        if system == self._system:
            self._commands.set_origin(latitude * 1e-7, longitude * 1e-7, altitude * 1e-3)

    def _file_transfer(self, now_ns: int, frame: Frame) -> None:
        """No files here: a NAK at once saves the client its time-out."""
        network, system, component = frame.values[:3]
        asked = frame.values[3:]
        if system not in (0, self._system) or component not in (0, 1):
            return
        sequence = (asked[0] | asked[1] << 8) + 1 & 0xFFFF
        answer = [0] * 251
        answer[0:6] = sequence & 0xFF, sequence >> 8, asked[2], NAK, 1, asked[3]
        answer[12] = UNKNOWN_COMMAND
        self._out += self._encoder(BY_NAME["FILE_TRANSFER_PROTOCOL"], network, frame.system, frame.component, *answer)

    def _log_list(self, now_ns: int, frame: Frame) -> None:
        if self._for_us(frame):
            self._out += self._encoder(BY_NAME["LOG_ENTRY"], 0, 0, 0, 0, 0)


def _finite(array: np.ndarray) -> np.ndarray:
    """Infinities and what cannot be (over 1000 km) to NaN, which means "not given"."""
    array[~(np.abs(array) < 1e6)] = np.nan
    return array


def _heading(q: tuple[float, ...]) -> float:
    size = math.sqrt(sum(c * c for c in q))
    if not (math.isfinite(size) and size > 0.1):
        return math.nan
    return euler_from_quaternion(np.array(q) / size)[2]
