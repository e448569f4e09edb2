"""What is known of the oldest node of a window from all that was before it, and how a node leaves it there.

Source: G. Sibley et al., "Sliding window filter with application to planetary landing", JFR 2010, sec. 4: the node that
leaves is marginalised by a Schur complement, linearised where it is at last.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.geometry import log_so3
from companion.core.messages import Array
from companion.estimation.normal import Normal
from companion.estimation.state import State
from companion.estimation.window.preintegration import NODE_ERROR, ImuResidual

_GRAVITY = slice(2 * NODE_ERROR, 2 * NODE_ERROR + 3)


@dataclass(frozen=True, slots=True)
class Prior:
    """0.5 dx' H dx - g' dx, dx = state minus `at`, of a node and gravity (18,)."""

    at: State
    H: Array  # (18, 18)
    g: Array  # (18,)

    def at_state(self, state: State) -> tuple[Array, Array]:
        """Its normal equations at another state; its Jacobian is taken as the identity, as in the filter."""
        return self.H, self.g - self.H @ state.minus(self.at)


def pose_equations(seen: Normal, state: State) -> tuple[Array, Array]:
    """Normal equations (6, 6), (6,) at a state of what was linearised at another pose."""
    off = np.concatenate([log_so3(seen.R.T @ state.R), state.p - seen.p])
    return seen.H, seen.g - seen.H @ off


def eliminate(prior: Prior, said: list[tuple[Array, Array]], imu: ImuResidual, states: tuple[State, State]) -> Prior:
    """The prior on the second of two nodes, if the first leaves with what was `said` (6, 6), (6,) of its pose.

    `imu` lies between the `states`, at which all is linearised.
    """
    size, first = _GRAVITY.stop, np.r_[:NODE_ERROR, _GRAVITY]
    H, g = np.zeros((size, size)), np.zeros(size)
    own, right = prior.at_state(states[0])
    H[np.ix_(first, first)] += own
    g[first] += right
    for own, right in said:
        H[:6, :6] += own
        g[:6] += right
    between = imu.equations
    H, g = H + between[0], g + between[1]
    gone, kept = slice(0, NODE_ERROR), slice(NODE_ERROR, size)
    gain = np.linalg.solve(H[gone, gone], H[gone, kept]).T
    left = H[kept, kept] - gain @ H[gone, kept]
    return Prior(states[1].copy(), 0.5 * (left + left.T), g[kept] - gain @ g[gone])
