"""Whether sweeps still fit the map as they are used to: a registration that went wrong tells so here first."""

from __future__ import annotations

from companion.estimation.normal import Normal

_FALL = 0.3  # of the usual share of points on planes: less is a fall
_SWEEPS = 20  # that the usual share is a mean of, nearly


class FitWatch:
    """Keeps the usual share, and whether a doubt is open: then a sweep must agree with the map before it counts."""

    def __init__(self) -> None:
        self._usual = 0.0
        self.doubts = False

    def falls(self, normal: Normal) -> bool:
        """Whether far fewer points of this sweep met planes than usual."""
        return normal.used < _FALL * self._usual * normal.offered

    def took(self, normal: Normal) -> None:
        """A sweep has been used."""
        self.doubts = False
        if normal.offered:
            self._usual += (normal.used / normal.offered - self._usual) / _SWEEPS
