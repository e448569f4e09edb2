"""The extended Kalman filter: the front end's error-state filter, with measurements of any kind."""

from __future__ import annotations

import numpy as np

from companion.estimation.filter import Filter
from companion.estimation.filters.kalman import Innovation, gain, joseph
from companion.estimation.filters.measurements import Measurement


class ExtendedFilter(Filter):
    """Linearises at the mean; the covariance follows the Jacobians.

    Source: J. Sola, "Quaternion kinematics for the error-state Kalman filter", 2017, ch. 6.
    """

    def correct(self, measurement: Measurement, *, gate_nis: float = np.inf) -> Innovation:
        """Take a measurement, unless its normalised innovation squared exceeds `gate_nis`."""
        H = measurement.jacobian(self.state)
        residual = measurement.z - measurement.expected(self.state)
        said = Innovation(residual, H @ self.P @ H.T + measurement.noise)
        if said.nis > gate_nis:
            return said
        K = gain(self.P, H, said.covariance)
        self.state.retract(K @ residual)
        self.P = joseph(self.P, K, H, measurement.noise)
        return said
