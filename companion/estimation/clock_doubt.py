"""What silence of all sensors may mean: that time passed, or that the clock was set.

Stamps alone do not tell the two. So a second course runs on from before the silence as if the clock had
jumped, and the first sweep that fits the map from one of them, and better than from the other, decides.
"""

from __future__ import annotations

from collections.abc import Callable

from companion.core.messages import Array
from companion.estimation.course import Course


class ClockDoubt:
    """Nothing, or the course of the other meaning."""

    def __init__(self) -> None:
        self._other: Course | None = None

    @property
    def is_open(self) -> bool:
        """Whether nobody knows yet."""
        return self._other is not None

    def arise(self, before: Course, otherwise: Array, densities: Array) -> None:
        """From the course before the silence; `otherwise`: IMU pieces (N, 7) up to now, if the clock has jumped."""
        self._other = before.copy()
        self._other.predict(otherwise, densities)

    def predict(self, imu: Array, densities: Array) -> None:
        """Time passes for both."""
        if self._other is not None:
            self._other.predict(imu, densities)

    def settle(self, course: Course, fits: Callable[[Course], float], *, at_least: float) -> None:
        """Ask how well (share of points) the newest sweep fits from both; if one does, `course` is that from now on."""
        if self._other is None:
            return
        self._other.shift(course.filter.t_s)
        ours, other = fits(course), fits(self._other)
        if max(ours, other) < at_least:
            return
        if other > ours:
            course.become(self._other)
        self._other = None
