"""Accuracy and honesty of a replayed estimate, against the truth of the simulator.

Errors are taken in `odom` as the truth has it: the frame in which the first state is right. There the
filter's attitude begins exact by definition, and gravity is what it does not know.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import spearmanr

from companion.core.messages import Array, GroundTruth, LioState
from companion.runtime.trajectory_error import align, drift_percent, path_length

GRAVITY = np.array([0.0, 0.0, -9.80665])


class Accuracy(msgspec.Struct, frozen=True, kw_only=True):
    """Of the poses after each sweep."""

    ate_m: float  # rms after one rigid alignment
    worst_m: float
    drift_percent: float  # mean relative translation error over 50 m
    length_m: float


class Nees(msgspec.Struct, frozen=True, kw_only=True):
    """Mean normalised squared error per degree of freedom: 1 is honest, above is overconfident."""

    tilt: float
    yaw: float
    velocity: float
    gyro_bias: float | None
    accel_bias: float | None
    position: float


@dataclass(frozen=True, slots=True)
class Truth:
    """True states at the stamps of an estimate, in its `odom`."""

    R: Array  # (N, 3, 3)
    p: Array  # (N, 3)
    v: Array  # (N, 3)
    gravity: Array  # (3,)


@dataclass(frozen=True, slots=True)
class Estimates:
    """Columns of the states after sweeps."""

    stamps_ns: Array  # (N,), int64
    R: Array  # (N, 3, 3)
    p: Array  # (N, 3)
    v: Array
    gyro_bias: Array
    accel_bias: Array
    gravity: Array
    covariance: Array  # (N, 18, 18)


def estimates_of(said: list[LioState]) -> Estimates:
    """The states after sweeps, and the one of the start."""
    states = [s for s in said if s.source != "camera"]
    return Estimates(
        stamps_ns=np.array([s.stamp_ns for s in states]),
        R=_rotations([s.q_odom_body for s in states]).as_matrix(),
        p=np.array([s.p_odom for s in states]),
        v=np.array([s.v_odom for s in states]),
        gyro_bias=np.array([s.gyro_bias_body for s in states]),
        accel_bias=np.array([s.accel_bias_body for s in states]),
        gravity=np.array([s.gravity_odom for s in states]),
        covariance=np.array([s.covariance for s in states]),
    )


def truth_at(truth: list[GroundTruth], stamps_ns: Array, *, R_first: Array, p_first: Array) -> Truth:
    """The truth at stamps within its time, in the frame where the first pose is the given one."""
    known_ns = np.array([t.stamp_ns for t in truth])
    at, known = (stamps_ns - known_ns[0]) * 1e-9, (known_ns - known_ns[0]) * 1e-9
    R = Slerp(known, _rotations([t.q_world_body for t in truth]))(np.clip(at, 0.0, known[-1])).as_matrix()
    p, v = (_between(at, known, np.array(rows)) for rows in zip(*((t.p_world, t.v_world) for t in truth), strict=True))
    turn = R_first @ R[0].T
    return Truth(R=turn @ R, p=(p - p[0]) @ turn.T + p_first, v=v @ turn.T, gravity=turn @ GRAVITY)


def accuracy(stamps_ns: Array, R: Array, p: Array, truth: list[GroundTruth]) -> Accuracy:
    """Of any odometry, ours or a peer's: attitudes (N, 3, 3) and positions (N, 3) of the body."""
    true = truth_at(truth, stamps_ns, R_first=R[0], p_first=p[0])
    off = np.linalg.norm(align(p, true.p) - true.p, axis=1)
    return Accuracy(
        ate_m=float(np.sqrt(np.mean(off**2))),
        worst_m=float(off.max()),
        drift_percent=drift_percent(p, true.p, R, true.R),
        length_m=path_length(true.p),
    )


def relative_m(stamps_ns: Array, R: Array, p: Array, true: Truth, *, over_s: float = 1.0) -> float:
    """Rms error of the motion over `over_s`, in the body frame of its begin: what alignment and drift say nothing of.

    Source: J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012, sec. IV.B.
    """
    later = np.searchsorted(stamps_ns, stamps_ns + round(over_s * 1e9))
    first = np.flatnonzero(later < len(stamps_ns))
    last = later[first]
    moved = np.einsum("nji,nj->ni", R[first], p[last] - p[first])
    truly = np.einsum("nji,nj->ni", true.R[first], true.p[last] - true.p[first])
    return float(np.sqrt(((moved - truly) ** 2).sum(axis=1).mean()))


def nees_of(e: Estimates, true: Truth, biases: tuple[Array, Array] | None, *, from_s: float = 3.0) -> Nees:
    """Over all states later than `from_s` after the first."""
    late = e.stamps_ns > e.stamps_ns[0] + from_s * 1e9
    theta = Rotation.from_matrix(e.R.transpose(0, 2, 1) @ true.R).as_rotvec()
    tilt, yaw = _tilt_and_yaw(e, true, theta)
    off = {"position": (true.p - e.p, 3), "velocity": (true.v - e.v, 6)}
    if biases is not None:
        off["gyro_bias"] = (_between(e.stamps_ns, biases[0], biases[1][:, :3]) - e.gyro_bias, 9)
        off["accel_bias"] = (_between(e.stamps_ns, biases[0], biases[1][:, 3:]) - e.accel_bias, 12)
    parts = {k: normalised(error, e.covariance[:, i : i + 3, i : i + 3]) for k, (error, i) in off.items()}
    means = {k: float(np.mean(x[late])) for k, x in {**parts, "tilt": tilt, "yaw": yaw}.items()}
    return Nees(
        tilt=means["tilt"],
        yaw=means["yaw"],
        velocity=means["velocity"],
        gyro_bias=means.get("gyro_bias"),
        accel_bias=means.get("accel_bias"),
        position=means["position"],
    )


def normalised(error: Array, covariance: Array) -> Array:
    """e' P^-1 e / d of errors (N, d) with covariances (N, d, d)."""
    solved = np.linalg.solve(covariance, error[:, :, None])[:, :, 0]
    return np.asarray((error * solved).sum(axis=1) / error.shape[1])


def rank_correlation(quality: Array, error: Array) -> float:
    """Spearman's, of quality with the negative error: 1 if the better always says so."""
    return float(spearmanr(quality, -error).statistic)


def _tilt_and_yaw(e: Estimates, true: Truth, theta: Array) -> tuple[Array, Array]:
    """Gravity's direction in the body depends on attitude and gravity; its own axis is yaw."""
    size = np.linalg.norm(e.gravity, axis=1)
    RT = e.R.transpose(0, 2, 1)
    down = np.einsum("nij,nj->ni", RT, e.gravity) / size[:, None]
    true_down = np.einsum("nji,j->ni", true.R, true.gravity) / np.linalg.norm(true.gravity)
    J = np.zeros((len(down), 3, 18))
    J[:, :, :3] = _skews(down)
    J[:, :, 15:] = RT / size[:, None, None]
    across = np.linalg.svd(down[:, None, :])[2][:, 1:, :]  # two unit vectors at right angles to down
    error = np.einsum("nij,nj->ni", across, true_down - down)
    A = across @ J
    tilt = normalised(error, A @ e.covariance @ A.transpose(0, 2, 1))
    variance = np.einsum("ni,nij,nj->n", down, e.covariance[:, :3, :3], down)
    return tilt, (theta * down).sum(axis=1) ** 2 / variance


def _skews(v: Array) -> Array:
    out = np.zeros((len(v), 3, 3))
    out[:, 2, 1], out[:, 0, 2], out[:, 1, 0] = v.T
    return out - out.transpose(0, 2, 1)


def _rotations(quaternions: list[Array]) -> Rotation:
    return Rotation.from_quat(np.array(quaternions), scalar_first=True)


def _between(at: Array, known: Array, rows: Array) -> Array:
    return np.column_stack([np.interp(at, known, rows[:, k]) for k in range(rows.shape[1])])
