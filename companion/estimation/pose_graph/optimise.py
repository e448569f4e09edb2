"""The most likely poses of a pose graph, with gtsam; robust to closures that are wrong.

`l2` trusts every edge. `dcs` (P. Agarwal et al., "Robust Map Optimization using Dynamic
Covariance Scaling", ICRA 2013) and `cauchy` doubt closures by their residual. `gnc` (H. Yang et
al., "Graduated Non-Convexity", RA-L 2020) sorts them into right and wrong. Odometry edges are
never doubted. Figures of each are in docs/estimation.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import gtsam
import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.messages import Array
from companion.estimation.pose_graph.graph import PoseGraph, check

Kernel = Literal["l2", "dcs", "cauchy", "gnc"]
_ANCHOR_SIGMA = 1e-4  # of the first pose, which stays
_ROTATION_FIRST = [3, 4, 5, 0, 1, 2]  # gtsam's order in space


class OptimiseConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How a pose graph is optimised."""

    kernel: Kernel = "l2"
    dcs_width: Annotated[float, msgspec.Meta(gt=0)] = 10.0  # phi of DCS
    cauchy_width: Annotated[float, msgspec.Meta(gt=0)] = 5.0
    gnc_inlier_probability: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.99
    most_iterations: Annotated[int, msgspec.Meta(ge=1)] = 100
    wrong_below: Annotated[float, msgspec.Meta(gt=0, lt=1)] = 0.5  # weight of a closure that counts as refused


@dataclass(frozen=True, slots=True, eq=False)
class Optimised:
    """The graph at its best poses, and how well it fits; errors are half the sum of squared Mahalanobis distances."""

    graph: PoseGraph
    error_before: float
    error: float  # with the weights below
    weights: Array  # (E,), 0 .. 1: how far each edge is believed
    refused: NDArray[np.int64]  # edges of weight under `wrong_below`


def optimise(graph: PoseGraph, config: OptimiseConfig) -> Optimised:
    """Poses of least error from where they are; the first pose stays. InputError as of `check`."""
    check(graph)
    values = _values(graph)
    plain = _factors(graph, None)
    factors = plain if config.kernel in ("l2", "gnc") else _factors(graph, _kernel(config))
    if config.kernel == "gnc":
        result, weights = _graduated(graph, factors, values, config)
    else:
        result = gtsam.LevenbergMarquardtOptimizer(factors, values, _lm(config)).optimize()
        weights = _weights(graph, result, config)
    each = np.array([plain.at(k).error(result) for k in range(len(graph.ends))])
    return Optimised(
        graph=graph.with_poses(_poses(graph, result)),
        error_before=float(plain.error(values)),
        error=float(weights @ each),
        weights=weights,
        refused=np.flatnonzero(weights < config.wrong_below),
    )


def _graduated(graph: PoseGraph, factors: Any, values: Any, config: OptimiseConfig) -> tuple[Any, Array]:
    params = gtsam.GncLMParams(_lm(config))
    params.setLossType(gtsam.GncLossType.TLS)
    params.setKnownInliers([*np.flatnonzero(graph.consecutive).tolist(), len(graph.ends)])
    optimizer = gtsam.GncLMOptimizer(factors, values, params)
    optimizer.setInlierCostThresholdsAtProbability(config.gnc_inlier_probability)
    result = optimizer.optimize()
    return result, np.asarray(optimizer.getWeights())[: len(graph.ends)]


def _lm(config: OptimiseConfig) -> Any:
    params = gtsam.LevenbergMarquardtParams()
    params.setMaxIterations(config.most_iterations)
    return params


def _kernel(config: OptimiseConfig) -> Any:
    estimators = gtsam.noiseModel.mEstimator
    if config.kernel == "dcs":
        return estimators.DCS.Create(config.dcs_width)
    return estimators.Cauchy.Create(config.cauchy_width)


def _weights(graph: PoseGraph, values: Any, config: OptimiseConfig) -> Array:
    """What the kernel makes of each closure at the end."""
    weights = np.ones(len(graph.ends))
    if config.kernel == "l2":
        return weights
    kernel, plain = _kernel(config), _factors(graph, None)
    for k in np.flatnonzero(~graph.consecutive).tolist():
        distance = np.sqrt(2.0 * plain.at(k).error(values))
        weights[k] = kernel.weight(distance)
    return weights


def _factors(graph: PoseGraph, kernel: Any) -> Any:
    """One factor per edge, in order, then the anchor of the first pose."""
    factors, spatial = gtsam.NonlinearFactorGraph(), graph.spatial
    between = gtsam.BetweenFactorPose3 if spatial else gtsam.BetweenFactorPose2
    prior = gtsam.PriorFactorPose3 if spatial else gtsam.PriorFactorPose2
    information = graph.information
    if spatial:
        information = information[:, _ROTATION_FIRST][:, :, _ROTATION_FIRST]
    edges = zip(graph.ends.tolist(), graph.measured, information, graph.consecutive.tolist(), strict=True)
    for (a, b), seen, matrix, sure in edges:
        noise: Any = gtsam.noiseModel.Gaussian.Information(np.ascontiguousarray(matrix))
        if kernel is not None and not sure:
            noise = gtsam.noiseModel.Robust.Create(kernel, noise)
        factors.add(between(a, b, _pose(seen), noise))
    size = 6 if spatial else 3
    factors.add(prior(0, _pose(graph.poses[0]), gtsam.noiseModel.Isotropic.Sigma(size, _ANCHOR_SIGMA)))
    return factors


def _pose(row: Array) -> Any:
    if len(row) == 3:
        return gtsam.Pose2(*row.tolist())
    return gtsam.Pose3(gtsam.Rot3.Quaternion(*row[3:].tolist()), row[:3])


def _values(graph: PoseGraph) -> Any:
    values = gtsam.Values()
    for n, row in enumerate(graph.poses):
        values.insert(n, _pose(row))
    return values


def _poses(graph: PoseGraph, values: Any) -> Array:
    if not graph.spatial:
        found = (values.atPose2(n) for n in range(len(graph.ids)))
        return np.array([[p.x(), p.y(), p.theta()] for p in found])
    rows = np.empty((len(graph.ids), 7))
    for n in range(len(rows)):
        pose = values.atPose3(n)
        q = pose.rotation().toQuaternion()
        rows[n, :3], rows[n, 3:] = pose.translation(), (q.w(), q.x(), q.y(), q.z())
    return rows
