"""The last seconds of IMU samples, and the pieces of them between two times."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array, ImuSample

_CAPACITY = 4096  # 20 s at 200 Hz
_LEAP_NS = 1_000_000_000
_BACK_IN_A_ROW = 10  # samples older than the newest, one after the other: the clock went back
_SOON_NS = 20_000_000  # a leap is believed one sample after the measurement that leapt with it
_LONGEST_STEP_S = 0.02  # longer gaps are bridged in steps of this length


class ImuBuffer:
    """Samples in stamp order; a bad or late one is refused and counted."""

    def __init__(self, *, most_rate_rad_s: float = np.inf, most_force_m_s2: float = np.inf) -> None:
        """From these values on (any axis) the sensor is at its stop."""
        self._most = np.repeat([most_rate_rad_s, most_force_m_s2], 3)
        self._stamps = np.empty(_CAPACITY, np.int64)
        self._values = np.empty((_CAPACITY, 6))
        self._count = 0
        self._leap_ns = -(2**62)
        self._behind = (0, 0, 0)  # first and last stamp, and count, of ascending samples in a row older than the newest
        self._hidden: tuple[int, int] = (-(2**62), 0)  # stamp of the first sample after such a row, and its time
        self.refused = 0

    def append(self, sample: ImuSample) -> bool:
        """Take a sample; False if it is not finite, at the sensor's stop, or not newer than the last one."""
        values = np.concatenate([sample.angular_velocity_body, sample.specific_force_body])
        if not (np.abs(values) < self._most).all() or not self._is_next(sample.stamp_ns):  # NaN is never below
            self.refused += 1
            return False
        if self._count == _CAPACITY:
            half = _CAPACITY // 2
            self._stamps[:half] = self._stamps[half:]
            self._values[:half] = self._values[half:]
            self._count = half
        self._stamps[self._count] = sample.stamp_ns
        self._values[self._count] = values
        self._count += 1
        return True

    def _is_next(self, stamp_ns: int) -> bool:
        """Newer, and not far ahead unless the one before said so, too: one wild stamp must not stop us."""
        before, self._leap_ns = self._leap_ns, -(2**62)
        if stamp_ns <= self.newest_ns:
            first, last, count = self._behind
            follows = count > 0 and stamp_ns > last
            self._behind = (first, stamp_ns, count + 1) if follows else (stamp_ns, stamp_ns, 1)
            return False
        if self._behind[2] >= _BACK_IN_A_ROW:
            self._hidden = stamp_ns, stamp_ns - self._behind[0]
        self._behind = (0, 0, 0)
        if not self._count or stamp_ns - self.newest_ns < _LEAP_NS or 0 < stamp_ns - before < _LEAP_NS:
            return True
        self._leap_ns = stamp_ns
        return False

    def __len__(self) -> int:
        return self._count

    @property
    def newest_ns(self) -> int:
        """Stamp of the newest sample; the smallest integer if there is none."""
        return int(self._stamps[self._count - 1]) if self._count else -(2**62)

    @property
    def newest_gap_s(self) -> float:
        """Time between the two newest samples, as `longest_gap_s` has it; 0 before there are two."""
        if self._count < 2:
            return 0.0
        hidden_ns = self._hidden[1] if self._hidden[0] == self.newest_ns else 0
        return max(self.newest_ns - int(self._stamps[self._count - 2]), hidden_ns) * 1e-9

    @property
    def newest_rate(self) -> Array:
        """Angular velocity of the newest sample, rad/s, (3,), biased."""
        return self._values[self._count - 1, :3].copy()

    def longest_gap_s(self, start_ns: int, end_ns: int) -> float:
        """Of the samples that fill (start, end], the longest time between two, in s.

        Time that the clock went back by, and so was there twice, counts: what happened then is not in the samples.
        """
        hidden_s = self._hidden[1] * 1e-9 if start_ns < self._hidden[0] <= end_ns else 0.0
        stamps = self._stamps[: self._count]
        first = max(int(np.searchsorted(stamps, start_ns, side="right")) - 1, 0)
        inside = stamps[first : int(np.searchsorted(stamps, end_ns)) + 1]
        if not len(inside):
            return max((end_ns - start_ns) * 1e-9, hidden_s)
        return max(float(np.diff(np.append(inside, max(end_ns, int(inside[-1])))).max()) * 1e-9, hidden_s)

    def covers(self, stamp_ns: int) -> bool:
        """Whether the buffer reaches back to a time."""
        return self._count > 0 and int(self._stamps[0]) <= stamp_ns

    def since(self, start_ns: int) -> Array:
        """Rate and specific force of the samples after `start_ns`, (N, 6)."""
        first = int(np.searchsorted(self._stamps[: self._count], start_ns, side="right"))
        return self._values[first : self._count].copy()

    def between(self, start_ns: int, end_ns: int) -> Array:
        """Pieces that fill (start, end]: dt, rate, specific force, (N, 7).

        A sample is the mean over the interval that ends at its stamp, so the pieces at both
        ends are cut; what is missing at the end is bridged with the newest sample, and gaps
        in between by interpolation.
        """
        if end_ns <= start_ns or not self._count:
            return np.empty((0, 7))
        stamps = self._stamps[: self._count]
        first = min(int(np.searchsorted(stamps, start_ns, side="right")), self._count - 1)
        last = min(int(np.searchsorted(stamps, end_ns)), self._count - 1)
        ends = np.minimum(stamps[first : last + 1], end_ns)
        ends[-1] = end_ns
        pieces = np.empty((len(ends), 7))
        pieces[1:, 0] = ends[1:] - ends[:-1]
        pieces[0, 0] = ends[0] - start_ns
        pieces[:, 0] *= 1e-9
        pieces[:, 1:] = self._values[first : last + 1]
        return pieces if pieces[:, 0].max() <= _LONGEST_STEP_S else self._split(pieces, start_ns)

    def is_clock_in_doubt(self, start_ns: int, end_ns: int, *, longer_s: float) -> bool:
        """Whether silence of more than `longer_s` began and ended in between, with all sensors: or a clock was set."""
        if start_ns < self._hidden[0] <= end_ns:
            return True
        stamps = self._stamps[: self._count]
        last = int(np.searchsorted(stamps, end_ns + _SOON_NS, side="right"))
        inside = stamps[int(np.searchsorted(stamps, start_ns)) : last]
        return len(inside) > 1 and bool(np.diff(inside).max() > 1e9 * longer_s)

    def had_the_clock_jumped(self, start_ns: int, end_ns: int, *, longer_s: float) -> Array:
        """`between`, if stamps lie: silence of more than `longer_s` was none, and what was there twice was flown."""
        pieces: Array = self.between(start_ns, end_ns)
        ends_ns = start_ns + np.round(1e9 * pieces[:, 0].cumsum()).astype(np.int64)
        stamps = self._stamps[: self._count]
        after = np.minimum(np.searchsorted(stamps, ends_ns - 1000), self._count - 1)  # 1000: rounding
        silent = stamps[after] - stamps[np.maximum(after - 1, 0)] > 1e9 * longer_s
        if not start_ns < self._hidden[0] <= end_ns:
            spoken: Array = pieces[~silent]
            return spoken
        at = int(np.searchsorted(ends_ns, self._hidden[0] - 1000))
        steps = int(np.ceil(self._hidden[1] * 1e-9 / _LONGEST_STEP_S))
        flown = np.linspace(pieces[max(at - 1, 0)], pieces[min(at, len(pieces) - 1)], steps)
        flown[:, 0] = self._hidden[1] * 1e-9 / steps
        inserted: Array = np.insert(pieces, at, flown, axis=0)
        return inserted

    def _split(self, pieces: Array, start_ns: int) -> Array:
        """No piece longer than `_LONGEST_STEP_S`; the parts of one lie between the samples before and after."""
        parts = np.ceil(pieces[:, 0] / _LONGEST_STEP_S).astype(np.int64)
        split = np.repeat(pieces, parts, axis=0)
        split[:, 0] /= np.repeat(parts, parts)
        middle_ns = start_ns + 1e9 * (split[:, 0].cumsum() - 0.5 * split[:, 0])
        stamps = self._stamps[: self._count].astype(np.float64)
        for k in np.flatnonzero(np.repeat(parts > 1, parts)):
            split[k, 1:] = [np.interp(middle_ns[k], stamps, v) for v in self._values[: self._count].T]
        return split
