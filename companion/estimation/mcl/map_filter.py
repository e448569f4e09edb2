"""An extended Kalman filter on the same likelihood field: one pose, one Gaussian, a hundredth of the effort.

A seen point should lie at distance 0 from what the map knows, so its distance is the residual and
the field's gradient the Jacobian (A. Fitzgibbon, "Robust registration of 2D and 3D point sets",
2003, in an iterated Kalman update). It follows a vehicle; it cannot find one.
"""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array
from companion.estimation.mcl.particles import MclConfig
from companion.estimation.mcl.prior_map import PriorMap

_GATE_M = 0.8  # a point farther from all that is known says nothing
_FEWEST = 10
_HELD = 1e-12  # variance of a height that is not estimated


class MapFilter:
    """Pose x, y, z, yaw (4,) with covariance (4, 4), moved and corrected as `MonteCarlo` is."""

    def __init__(self, pose: Array, covariance: Array, prior: PriorMap, config: MclConfig) -> None:
        self.pose, self.P = np.array(pose, np.float64), np.array(covariance, np.float64)
        self._prior, self.config = prior, config

    def move(self, step_body: Array, turn_rad: float) -> None:
        """Take the step (3,), m, in the level frame, then the turn, rad."""
        c = self.config
        cos, sin = np.cos(self.pose[3]), np.sin(self.pose[3])
        turn = np.array([[cos, -sin], [sin, cos]])
        world = turn @ step_body[:2]
        F = np.eye(4)
        F[0, 3], F[1, 3] = -world[1], world[0]
        sigma = c.move_sigma_m + c.move_share * float(np.linalg.norm(step_body))
        noise = np.array([sigma**2, sigma**2, c.climb_sigma_m**2 + _HELD, c.turn_sigma_rad**2])
        self.pose[:2] += world
        self.pose[2] += step_body[2]
        self.pose[3] += turn_rad
        self.P = F @ self.P @ F.T + np.diag(noise)

    def see(self, points_level: Array, *, iterations: int = 4) -> int:
        """Take a scan (M, 3) in the level frame; returns how many points the map explained."""
        prior, information = self.pose.copy(), np.linalg.inv(self.P)
        used = 0
        for _ in range(iterations):
            H, g, used = self._normal(points_level)
            if used < _FEWEST:
                self.pose = prior
                return used
            posterior = information + H
            step = np.linalg.solve(posterior, g - information @ (self.pose - prior))
            self.pose = self.pose + step
            if np.abs(step).max() < 1e-4:
                break
        P = np.linalg.inv(posterior)
        self.P = 0.5 * (P + P.T)
        return used

    def _normal(self, points_level: Array) -> tuple[Array, Array, int]:
        cos, sin = np.cos(self.pose[3]), np.sin(self.pose[3])
        x, y, z = points_level.T
        world = np.column_stack([cos * x - sin * y, sin * x + cos * y, z])
        distance, gradient = self._prior.distance_and_gradient(world + self.pose[:3])
        near = distance < min(_GATE_M, 0.99 * self._prior.reach_m)
        J = np.empty((int(near.sum()), 4))
        J[:, :3] = gradient[near]
        J[:, 3] = gradient[near, 1] * world[near, 0] - gradient[near, 0] * world[near, 1]
        model = self.config.model
        sigma2 = model.sigma_m**2 + 2.0 * float(self.P[0, 0] + self.P[1, 1])
        weight = 1.0 / (model.sigma_m**2 * (1.0 + distance[near] ** 2 / sigma2) ** 2)
        weight *= min(1.0, model.independent / max(len(points_level), 1))
        return (J * weight[:, None]).T @ J, -(J * weight[:, None]).T @ distance[near], len(J)
