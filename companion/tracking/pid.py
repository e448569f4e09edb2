"""PID on a vector error: derivative on the measurement, and a bounded integral that does not wind up."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.tracking.demand import limited

Gain = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]


class PidConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Error from the path (m) to velocity correction (m/s). At hover the autopilot's own position gain adds to it."""

    kp_per_s: Gain = 3.0
    """Proportional gain."""
    ki_per_s2: Gain = 1.0
    """Integral gain."""
    kd: Gain = 1.0
    """Derivative gain, on the measured velocity across the path."""
    integral_limit_m_s: Gain = 0.3
    """Largest share of the integral in the output, norm."""
    output_limit_m_s: Positive = 1.0
    """Largest correction, norm."""


class Pid:
    """`step` once per control period.

    >>> Pid(PidConfig()).step(np.array([0.0, 0.3, 0.0]), measured_rate=np.zeros(3), dt_s=0.02)
    """

    def __init__(self, config: PidConfig) -> None:
        self.config = config
        self.reset()

    def reset(self) -> None:
        """Forget the past."""
        self.integral = np.zeros(3)  # m/s, already times ki

    def step(self, error: Array, *, measured_rate: Array, dt_s: float) -> Array:
        """Correction (3,) m/s for an error (3,) m and the rate (3,) m/s of what is measured.

        The derivative is that of the measurement: a reference that jumps gives no kick. The integral
        stands still while the output is limited and the error would push on (conditional integration;
        Astrom and Murray, Feedback Systems, 2008, 10.4).
        """
        config = self.config
        grown = limited(self.integral + config.ki_per_s2 * error * dt_s, config.integral_limit_m_s)
        wished = config.kp_per_s * error + grown - config.kd * measured_rate
        output = limited(wished, config.output_limit_m_s)
        if np.array_equal(output, wished) or float(error @ wished) < 0.0:
            self.integral = grown
        return output
