"""Nodes of a window, and how what is said of them comes into one system of equations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve

from companion.core.messages import Array
from companion.estimation.normal import Normal
from companion.estimation.state import State
from companion.estimation.window.joint_planes import Sweep
from companion.estimation.window.preintegration import ImuResidual, Preintegrated, imu_residual


@dataclass(slots=True)
class Node:
    """A state at the time of a sweep or an image; its gravity is that of the window."""

    number: int
    state: State
    imu: Preintegrated | None  # from the node before
    P: Array  # (6, 6), of the pose as it was predicted
    sweep: Sweep | None = None
    seen: Normal | None = None  # what an image said
    silent_s: float = 0.0  # of the IMU since the node before


def residual_between(first: Node, second: Node) -> ImuResidual:
    """Of the IMU between two nodes, where they are now; the first node of all has none before it."""
    if second.imu is None:
        raise ValueError("no IMU before the first node")
    return imu_residual(second.imu, first.state, second.state, second.state.g)


def add_at(H: Array, g: Array, at: NDArray[np.int_], equations: tuple[Array, Array]) -> None:
    """Normal equations of some of the variables to those of all, in place."""
    H[np.ix_(at, at)] += equations[0]
    g[at] += equations[1]


def marginal(root: tuple[Array, bool], at: NDArray[np.int_], size: int) -> Array:
    """Covariance of some of the variables, from the Cholesky root of the whole information."""
    columns = np.zeros((size, len(at)))
    columns[at, np.arange(len(at))] = 1.0
    P = cho_solve(root, columns, check_finite=False)[at]
    return np.asarray(0.5 * (P + P.T))
