"""PID on a vector error, with a bounded integral that does not wind up."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array

Gain = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class PidConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Cross-track error (m) to velocity correction (m/s). The autopilot's own position gain comes on top."""

    kp_per_s: Gain = 0.8
    """Proportional gain."""
    ki_per_s2: Gain = 0.15
    """Integral gain."""
    kd: Gain = 0.0
    """Derivative gain."""
    integral_limit_m_s: Gain = 0.3
    """Largest share of the integral in the output, norm."""
    output_limit_m_s: Positive = 0.8
    """Largest correction, norm."""


class Pid:
    """`step` once per control period.

    >>> Pid(PidConfig()).step(np.array([0.0, 0.3, 0.0]), dt_s=0.02)
    """

    def __init__(self, config: PidConfig) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.integral = np.zeros(3)  # m/s, already times ki
        self._last: Array | None = None

    def step(self, error: Array, *, dt_s: float) -> Array:
        """Correction (3,) m/s for an error (3,) m.

        The integral stands still while the output is limited and the error would push on
        (conditional integration).
        """
        config = self.config
        slope = np.zeros(3) if self._last is None else (error - self._last) / dt_s
        self._last = error.copy()
        grown = _limited(self.integral + config.ki_per_s2 * error * dt_s, config.integral_limit_m_s)
        wished = config.kp_per_s * error + grown + config.kd * slope
        output = _limited(wished, config.output_limit_m_s)
        if np.array_equal(output, wished) or float(error @ wished) < 0.0:
            self.integral = grown
        return output


def _limited(v: Array, most: float) -> Array:
    size = float(np.linalg.norm(v))
    return v if size <= most else v * (most / size)
