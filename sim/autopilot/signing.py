"""The autopilot's side of MAVLink 2 signing: sign what goes out, drop what is not signed with the key.

An autopilot has no right clock at boot: it takes the time over from the newest frame that it accepted.
Source: mavlink.io/en/guide/message_signing.html.
"""

from __future__ import annotations

import hashlib
from typing import Final

TAIL: Final = 13  # link id 1, timestamp 6, hash 6
SIGNED: Final = 1
TICK_NS: Final = 10_000
START_NS: Final = 1_420_070_400_000_000_000  # 2015-01-01
MINUTE: Final = 6_000_000  # ticks
TOP: Final = (1 << 48) - 1


class Signing:
    """Set `now_ns` before use; `dropped` counts the frames that were refused, by reason."""

    def __init__(self, key: bytes, *, link: int = 0) -> None:
        if len(key) != 32:
            raise ValueError(f"a signing key has 32 bytes, not {len(key)}")
        self._key, self._link = key, link
        self._clock = 0
        self._last: dict[bytes, int] = {}
        self.now_ns = 0
        self.dropped = {"unsigned": 0, "forged": 0, "replayed": 0}

    def tail(self, frame: bytes) -> bytes:
        """What follows a frame that carries the flag."""
        self._clock = min(max(self._clock + 1, self._now()), TOP)
        stamp = bytes([self._link]) + self._clock.to_bytes(6, "little")
        return stamp + self._hash(frame + stamp)

    def accepts(self, frame: bytes) -> bool:
        """Whether a whole frame with a right CRC is to be heard."""
        reason = self._refusal(frame)
        if reason:
            self.dropped[reason] += 1
        return not reason

    def _refusal(self, frame: bytes) -> str:
        if frame[0] != 0xFD or not frame[2] & SIGNED:
            return "unsigned"
        if self._hash(frame[:-6]) != frame[-6:]:
            return "forged"
        stamp, sender = int.from_bytes(frame[-12:-6], "little"), frame[5:7] + frame[-TAIL : -TAIL + 1]
        least = self._last[sender] + 1 if sender in self._last else max(self._clock, self._now()) - MINUTE
        if stamp < least:
            return "replayed"
        self._last[sender] = stamp
        self._clock = max(self._clock, stamp)
        return ""

    def _now(self) -> int:
        return max(0, (self.now_ns - START_NS) // TICK_NS)

    def _hash(self, data: bytes) -> bytes:
        return hashlib.sha256(self._key + data).digest()[:6]
