"""MAVLink 2 message signing: who holds the key may speak, and nothing said before counts again.

    signing = Signing(key)
    frame = body + signing.signature(body, now_ns)       # body: magic .. CRC, with the flag "signed"
    signing.accepts(frame, now_ns)

Source: mavlink.io/en/guide/message_signing.html. A signature is the link id (1 byte), a timestamp
(6 bytes, units of 10 us since 2015-01-01) and the first 6 bytes of SHA-256 over key, frame, link
id and timestamp.
"""

from __future__ import annotations

import hashlib
import hmac
from dataclasses import dataclass
from typing import Final

from companion.core.errors import InputError

KEY_BYTES: Final = 32
SIGNATURE_BYTES: Final = 13
UNIT_NS: Final = 10_000
EPOCH_NS: Final = 1_420_070_400 * 10**9  # 2015-01-01 in ns since 1970
NEW_STREAM_UNITS: Final = 60 * 100_000  # so far behind us a sender not heard before may be
STREAMS_MAX: Final = 1024
_LAST_UNIT: Final = (1 << 48) - 1
_MAC_BYTES: Final = 6
_V2: Final = 0xFD
_SIGNED: Final = 0x01


@dataclass(slots=True)
class Rejected:
    """Frames that were not accepted, by reason."""

    unsigned: int = 0
    forged: int = 0  # signed with another key, or altered
    replayed: int = 0  # not newer than what was heard before

    @property
    def total(self) -> int:
        """All of them."""
        return self.unsigned + self.forged + self.replayed


def units(now_ns: int) -> int:
    """A time in ns since 1970 as a timestamp; 0 for a clock that stands before 2015."""
    return min(max(0, (now_ns - EPOCH_NS) // UNIT_NS), _LAST_UNIT)


class Signing:
    """Both directions of one link. Time is ours, in ns since 1970; it need not be right nor monotonic."""

    def __init__(self, key: bytes, *, link_id: int = 0) -> None:
        """`key` is the secret of 32 bytes that both sides hold."""
        if len(key) != KEY_BYTES:
            raise InputError(f"has {len(key)} bytes", field="signing key", valid=f"{KEY_BYTES} bytes")
        self._hash = hashlib.sha256(key)
        self._link = bytes([link_id])
        self._newest = 0  # sent or accepted
        self._streams: dict[tuple[int, int, int], int] = {}  # (system, component, link) -> newest accepted
        self.rejected = Rejected()

    def signature(self, body: bytes, now_ns: int) -> bytes:
        """The 13 bytes that follow `body`; its timestamp is higher than that of every earlier one."""
        self._newest = min(max(self._newest + 1, units(now_ns)), _LAST_UNIT)
        head = self._link + self._newest.to_bytes(6, "little")
        return head + self._mac(body + head)

    def accepts(self, frame: bytes, now_ns: int) -> bool:
        """Whether an intact frame counts. A frame that does not changes nothing but `rejected`."""
        if frame[0] != _V2 or not frame[2] & _SIGNED:
            self.rejected.unsigned += 1
            return False
        if not hmac.compare_digest(self._mac(frame[:-_MAC_BYTES]), frame[-_MAC_BYTES:]):
            self.rejected.forged += 1
            return False
        stamp = int.from_bytes(frame[-12:-6], "little")
        stream = frame[5], frame[6], frame[-SIGNATURE_BYTES]
        if not self._is_new(stream, stamp, now_ns):
            self.rejected.replayed += 1
            return False
        self._streams[stream] = stamp
        self._newest = max(self._newest, stamp)
        return True

    def _is_new(self, stream: tuple[int, int, int], stamp: int, now_ns: int) -> bool:
        last = self._streams.get(stream)
        if last is not None:
            return stamp > last
        here = max(self._newest, units(now_ns))
        return stamp >= here - NEW_STREAM_UNITS and len(self._streams) < STREAMS_MAX

    def _mac(self, data: bytes) -> bytes:
        digest = self._hash.copy()
        digest.update(data)
        return digest.digest()[:_MAC_BYTES]
