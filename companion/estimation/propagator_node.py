"""Propagator node: filter states at 25 Hz and IMU at 200 Hz to odometry at 100 Hz."""

from __future__ import annotations

from collections.abc import Iterator

from companion.core.messages import ImuSample, LioState
from companion.core.node import Node, Output, on
from companion.core.topics import IMU, LIO_STATE, ODOMETRY
from companion.estimation.config import EstimationConfig
from companion.estimation.propagator import Propagator


class PropagatorNode(Node):
    """Says nothing before the first state, and nothing while the IMU is silent."""

    publishes = (ODOMETRY,)

    def __init__(self, config: EstimationConfig) -> None:
        self._propagator = Propagator(config.propagator, config.lio.noise, config.lio.imu_doubt)

    @on(IMU)
    def imu(self, sample: ImuSample) -> Iterator[Output]:
        """Advance, and publish when due."""
        odometry = self._propagator.advance(sample)
        if odometry is not None:
            yield ODOMETRY(odometry)

    @on(LIO_STATE)
    def correct(self, state: LioState) -> None:
        """Take the newest filter state as the new base."""
        self._propagator.correct(state)
