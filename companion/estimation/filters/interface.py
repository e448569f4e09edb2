"""What every estimator of the strapdown state answers to, and how one is made by its name."""

from __future__ import annotations

from typing import Literal, Protocol, get_args

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.estimation.filters.extended import ExtendedFilter
from companion.estimation.filters.fixed_lag import FixedLagFilter
from companion.estimation.filters.kalman import Innovation
from companion.estimation.filters.measurements import Measurement
from companion.estimation.filters.unscented import UnscentedFilter
from companion.estimation.propagation import ImuNoise
from companion.estimation.state import State

EstimatorName = Literal["ekf", "ukf", "graph"]
ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)


class Estimator(Protocol):
    """State, covariance (18, 18) in the order of `State.minus`, and time."""

    state: State
    P: Array
    t_s: float

    def predict(self, imu: Array, densities: Array) -> Array:
        """Run IMU pieces (N, 7: dt, rate, specific force); returns the nodes passed, (N, 22)."""
        ...

    def correct(self, measurement: Measurement, *, gate_nis: float = np.inf) -> Innovation:
        """Take a measurement, unless its normalised innovation squared exceeds `gate_nis`."""
        ...

    @property
    def is_sound(self) -> bool:
        """Finite, with positive variances."""
        ...


def make_estimator(name: str, state: State, P: Array, noise: ImuNoise, *, t_s: float = 0.0) -> Estimator:
    """An estimator that begins at `state` with covariance P; raises InputError for a name that is none."""
    if name == "ekf":
        return ExtendedFilter(state.copy(), P.copy(), t_s)
    if name == "ukf":
        return UnscentedFilter(state.copy(), P.copy(), t_s)
    if name == "graph":
        return FixedLagFilter(state, P, t_s, noise)
    raise InputError(f"{name!r}", field="estimator", valid=", ".join(ESTIMATORS))
