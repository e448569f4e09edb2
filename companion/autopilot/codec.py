"""Messages <-> payloads: struct fast paths for the hot ids, pymavlink's objects for the rest.

    parser, encoder = Parser(), Encoder(system=1, component=191)
    for frame in parser.feed(data):
        message = decode(frame)  # a named tuple below, or a pymavlink message
    data = encoder.encode(Timesync(tc1=0, ts1=now_ns))

Field names and units are MAVLink's own (mavlink.io/en/messages/common.html); the order is
that of the wire.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any, Final, NamedTuple

from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import all as dialect

from companion.autopilot.signing import Signing
from companion.autopilot.wire import CRC_EXTRA, MAGIC_V2, SIGNED_FLAG, Frame

Floats = tuple[float, ...]


class Heartbeat(NamedTuple):
    """HEARTBEAT, id 0."""

    custom_mode: int
    type: int
    autopilot: int
    base_mode: int
    system_status: int
    mavlink_version: int = 3


class AttitudeQuaternion(NamedTuple):
    """ATTITUDE_QUATERNION, id 31: q_ned_frd (w, x, y, z) and FRD rates."""

    time_boot_ms: int
    q1: float
    q2: float
    q3: float
    q4: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float
    repr_offset_q: Floats = (0.0, 0.0, 0.0, 0.0)


class LocalPositionNed(NamedTuple):
    """LOCAL_POSITION_NED, id 32."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float


class CommandLong(NamedTuple):
    """COMMAND_LONG, id 76."""

    param1: float
    param2: float
    param3: float
    param4: float
    param5: float
    param6: float
    param7: float
    command: int
    target_system: int
    target_component: int
    confirmation: int


class SetPositionTarget(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED, id 84."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float
    type_mask: int
    target_system: int
    target_component: int
    coordinate_frame: int


class HighresImu(NamedTuple):
    """HIGHRES_IMU, id 105: FRD; m/s2, rad/s, gauss, hPa, degC."""

    time_usec: int
    xacc: float
    yacc: float
    zacc: float
    xgyro: float
    ygyro: float
    zgyro: float
    xmag: float
    ymag: float
    zmag: float
    abs_pressure: float
    diff_pressure: float
    pressure_alt: float
    temperature: float
    fields_updated: int
    id: int = 0


class Timesync(NamedTuple):
    """TIMESYNC, id 111: tc1 0 in a request, else the answering clock; ts1 the asking clock, ns."""

    tc1: int
    ts1: int


class Odometry(NamedTuple):
    """ODOMETRY, id 331; covariances are row-major upper triangles of 6x6."""

    time_usec: int
    x: float
    y: float
    z: float
    q: Floats
    vx: float
    vy: float
    vz: float
    rollspeed: float
    pitchspeed: float
    yawspeed: float
    pose_covariance: Floats
    velocity_covariance: Floats
    frame_id: int
    child_frame_id: int
    reset_counter: int
    estimator_type: int
    quality: int


class StatusText(NamedTuple):
    """STATUSTEXT, id 253, to send; what comes is decoded by pymavlink's class."""

    severity: int
    text: bytes
    id: int = 0
    chunk_seq: int = 0


HotMessage = (
    Heartbeat
    | AttitudeQuaternion
    | LocalPositionNed
    | CommandLong
    | SetPositionTarget
    | HighresImu
    | Timesync
    | Odometry
    | StatusText
)

_LAYOUTS: Final[dict[type[Any], tuple[int, struct.Struct]]] = {
    Heartbeat: (0, struct.Struct("<IBBBBB")),
    AttitudeQuaternion: (31, struct.Struct("<I11f")),
    LocalPositionNed: (32, struct.Struct("<I6f")),
    CommandLong: (76, struct.Struct("<7fHBBB")),
    SetPositionTarget: (84, struct.Struct("<I11fHBBB")),
    HighresImu: (105, struct.Struct("<Q13fHB")),
    Timesync: (111, struct.Struct("<qq")),
    Odometry: (331, struct.Struct("<Q55fBBBBb")),
    StatusText: (253, struct.Struct("<B50sHB")),
}


def decode(frame: Frame) -> Any:
    """The message of a frame: a named tuple of this file, a pymavlink message, or None.

    None: the id is unknown to pymavlink, so nobody here can read the payload.
    """
    fast = _FAST.get(frame.msg_id)
    return fast(frame.payload) if fast else _decode_other(frame)


def _padded(payload: bytes, size: int) -> bytes:
    """Trailing zeros that v2 cut off come back; fields newer than our layout go."""
    return payload if len(payload) == size else payload.ljust(size, b"\0")[:size]


def _flat(cls: type[Any]) -> Callable[[bytes], Any]:
    layout = _LAYOUTS[cls][1]
    unpack, make, size = layout.unpack, cls._make, layout.size
    return lambda payload: make(unpack(_padded(payload, size)))


def _decode_attitude(payload: bytes) -> AttitudeQuaternion:
    layout = _LAYOUTS[AttitudeQuaternion][1]
    values = layout.unpack(_padded(payload, layout.size))
    return AttitudeQuaternion._make((*values[:8], values[8:]))


def _decode_odometry(payload: bytes) -> Odometry:
    layout = _LAYOUTS[Odometry][1]
    v = layout.unpack(_padded(payload, layout.size))
    return Odometry._make((*v[:4], v[4:8], *v[8:14], v[14:35], v[35:56], *v[56:]))


_FAST: Final[dict[int, Callable[[bytes], Any]]] = {
    **{msg_id: _flat(cls) for cls, (msg_id, _) in _LAYOUTS.items() if cls is not StatusText},
    31: _decode_attitude,
    331: _decode_odometry,
}


def _decode_other(frame: Frame) -> Any:
    kind = dialect.mavlink_map.get(frame.msg_id)
    if kind is None:
        return None
    values = kind.unpacker.unpack(_padded(frame.payload, kind.unpacker.size))
    fields: list[Any] = []
    at = 0
    for length in kind.lengths:  # in wire order; a string is one value, an array several
        first = values[at]
        if isinstance(first, bytes):
            fields.append(first.rstrip(b"\0"))
            at += 1
        elif length == 0 or length == 1:
            fields.append(first)
            at += 1
        else:
            fields.append(list(values[at : at + length]))
            at += length
    return kind(*(fields[order] for order in kind.orders))


class Encoder:
    """Packs MAVLink 2 frames from one sender with its own sequence numbers; signs them if it can."""

    def __init__(self, *, system: int, component: int, signing: Signing | None = None) -> None:
        self._system, self._component, self._signing = system, component, signing
        self.sequence = 0  # of the next frame

    def encode(self, message: HotMessage, now_ns: int = 0) -> bytes:
        """The frame of a message of this file; `now_ns` matters to signatures only."""
        msg_id, layout = _LAYOUTS[type(message)]
        return self.frame(msg_id, layout.pack(*_flatten(message)), now_ns)

    def frame(self, msg_id: int, payload: bytes, now_ns: int = 0) -> bytes:
        """Header, payload without trailing zeros (one byte stays), CRC and signature."""
        payload = payload.rstrip(b"\0") or payload[:1]
        flags = SIGNED_FLAG if self._signing else 0
        low, high = msg_id & 0xFFFF, msg_id >> 16
        body = _HEADER.pack(len(payload), flags, 0, self.sequence, self._system, self._component, low, high) + payload
        self.sequence = (self.sequence + 1) & 0xFF
        crc = mcrf4xx(body + bytes([CRC_EXTRA[msg_id]]))
        frame = _MAGIC + body + crc.to_bytes(2, "little")
        return frame + self._signing.signature(frame, now_ns) if self._signing else frame


_HEADER = struct.Struct("<BBBBBBHB")
_MAGIC = bytes([MAGIC_V2])


def _flatten(message: HotMessage) -> tuple[Any, ...]:
    if isinstance(message, AttitudeQuaternion):
        return (*message[:8], *message.repr_offset_q)
    if isinstance(message, Odometry):
        m = message
        return (*m[:4], *m.q, *m[5:11], *m.pose_covariance, *m.velocity_covariance, *m[13:])
    return message
