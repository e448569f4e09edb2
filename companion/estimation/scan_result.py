"""What the front end has to say of a sweep."""

from __future__ import annotations

from dataclasses import dataclass

from companion.core.messages import Array32
from companion.estimation.normal import Normal


@dataclass(frozen=True, slots=True)
class ScanResult:
    """A deskewed scan, and what it said (None: nothing, e.g. the first)."""

    points_body: Array32  # (N, 3)
    normal: Normal | None
    agrees: bool = True  # False: it came after a gap and does not fit the map; nothing was corrected
