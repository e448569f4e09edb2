"""Whether the autopilot rebooted: its clocks start anew."""

from __future__ import annotations

from typing import Final

BACK_MS: Final = 2000  # a datagram overtaken by another goes back less
WRAP_MS: Final = 1 << 32


class BootClock:
    """Times since boot, by source (each message may have a clock of its own)."""

    def __init__(self) -> None:
        self._newest: dict[int, int] = {}

    def is_late(self, source: int, boot_ms: int) -> bool:
        """Older than what came before from that source, as after reordering."""
        return boot_ms < self._newest.get(source, boot_ms)

    def went_back(self, source: int, boot_ms: int) -> bool:
        """Note a time; true if it shows a reboot, after which all sources start anew."""
        newest = self._newest.get(source, boot_ms)
        if boot_ms < newest - BACK_MS and not self._wrapped(boot_ms, newest):
            self._newest = {source: boot_ms}
            return True
        self._newest[source] = boot_ms if self._wrapped(boot_ms, newest) else max(newest, boot_ms)
        return False

    @staticmethod
    def _wrapped(boot_ms: int, newest: int) -> bool:
        """32 bits of milliseconds last 49.7 days."""
        return newest > WRAP_MS - 60_000 and boot_ms < 60_000
