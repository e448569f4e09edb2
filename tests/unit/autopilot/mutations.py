"""Frames that nobody should send: every message with senseless values, damaged in every way, from a seed."""

from __future__ import annotations

import random
import re
import struct
from collections.abc import Iterator
from typing import Any

from fastcrc.crc16 import mcrf4xx

from sim.autopilot.codec import BY_NAME, LAYOUTS, Layout

VARIANTS = 12  # of each message
EXTREME = {
    "f": [0.0, -0.0, 1.0, -1.0, float("nan"), float("inf"), float("-inf"), 3e38, -3e38, 1e-45, 47.4, 1e7],
    "d": [0.0, float("nan"), float("inf"), 1e308, -1e308],
}
OFTEN = (
    "HEARTBEAT", "SYS_STATUS", "SYSTEM_TIME", "LOCAL_POSITION_NED", "COMMAND_ACK", "TIMESYNC", "BATTERY_STATUS",
    "EKF_STATUS_REPORT", "ESTIMATOR_STATUS", "EXTENDED_SYS_STATE", "STATUSTEXT", "COMMAND_LONG", "COMMAND_INT",
    "SET_POSITION_TARGET_LOCAL_NED", "ODOMETRY", "SET_MODE", "MANUAL_CONTROL", "PING", "SET_GPS_GLOBAL_ORIGIN",
    "FILE_TRANSFER_PROTOCOL", "LOG_REQUEST_LIST", "PARAM_SET", "PARAM_REQUEST_READ", "MISSION_COUNT",
    "MISSION_ITEM_INT", "MISSION_REQUEST_INT", "MISSION_REQUEST_LIST", "MISSION_CLEAR_ALL", "MISSION_ACK",
)  # fmt: skip


def batches(seed: int, number: int, *, size: int, system: int, component: int) -> Iterator[bytes]:
    """`number` frames in pieces of `size`, cut where frames end or not."""
    rng = random.Random(seed)
    corpus = _corpus(rng, system, component)
    rest = b""
    for _ in range(0, number, size):
        data = rest + b"".join(_damage(rng.choice(corpus), rng.randrange(8), rng) for _ in range(size))
        cut = len(data) if rng.random() < 0.5 else rng.randrange(len(data))
        rest = data[cut:]
        yield data[:cut]


def _corpus(rng: random.Random, system: int, component: int) -> list[bytes]:
    """Intact frames: all messages alike, and as many of those that somebody listens to."""
    names = [layout.name for layout in LAYOUTS.values()]
    often = list(OFTEN) * (len(names) // len(OFTEN))
    head = system, component
    return [
        _frame(BY_NAME[n], _payload(BY_NAME[n], rng), rng.randrange(256), head)
        for n in names + often
        for _ in range(VARIANTS)
    ]


def _payload(layout: Layout, rng: random.Random) -> bytes:
    """Extreme values; or noise; mostly addressed to 1/1 so that it is not passed over."""
    if rng.random() < 0.3:
        return rng.randbytes(layout.packer.size)
    chars = [c for count, c in re.findall(r"(\d*)([a-zA-Z])", layout.packer.format) for c in _repeated(count, c)]
    names = [f for f, n in zip(layout.fields, layout.lengths, strict=True) for _ in range(n)]
    return layout.packer.pack(*(_value(c, n, rng) for c, n in zip(chars, names, strict=True)))


def _repeated(count: str, char: str) -> list[str]:
    return [count + char] if char == "s" else [char] * int(count or 1)


def _value(char: str, name: str, rng: random.Random) -> Any:
    if char.endswith("s"):
        return rng.choice([b"", b"MPC_XY_VEL_MAX", rng.randbytes(int(char[:-1]))])
    if char == "c":
        return rng.randbytes(1)
    if char in EXTREME:
        return rng.choice(EXTREME[char]) if rng.random() < 0.7 else rng.gauss(0, 100)
    if name in ("target_system", "target_component"):
        return rng.choice([0, 1, 1, 1, 255])
    if name == "command":
        return rng.choice([16, 20, 21, 22, 176, 192, 241, 246, 300, 400, 511, 512, 519, 520, 65535])
    bits = 8 * struct.calcsize(f"<{char}")
    low, high = (0, (1 << bits) - 1) if char.isupper() else (-(1 << bits - 1), (1 << bits - 1) - 1)
    return rng.choice([low, high, max(low, -1), 0, 1, 2, 3, 6, 20, rng.randint(low, high)])


def _frame(layout: Layout, payload: bytes, sequence: int, head: tuple[int, int]) -> bytes:
    cut = payload.rstrip(b"\0") or b"\0"
    body = struct.pack(
        "<BBBBBBHB", len(cut), 0, 0, sequence, *head, layout.msg_id & 0xFFFF, layout.msg_id >> 16
    ) + cut  # fmt: skip
    return b"\xfd" + body + mcrf4xx(body + layout.seed).to_bytes(2, "little")


def _damage(frame: bytes, fate: int, rng: random.Random) -> bytes:
    """Half stay as they are."""
    if fate < 4:
        return frame
    at = rng.randrange(len(frame))
    if fate == 4:  # a flipped bit
        return frame[:at] + bytes([frame[at] ^ 1 << rng.randrange(8)]) + frame[at + 1 :]
    if fate == 5:  # cut
        return frame[:at]
    if fate == 6:  # noise inside
        return frame[:at] + rng.randbytes(rng.randrange(1, 40)) + frame[at:]
    return frame[:at] + b"\xfd" + frame[at + 1 :]  # a start where none is
