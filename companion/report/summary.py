"""A flight in figures: what `summary.json` holds."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
from scipy.spatial.transform import Rotation

from companion.core.geometry import (
    quaternion_from_yaw,
    quaternion_multiply,
    rotate,
    yaw_of,
)
from companion.core.messages import Array
from companion.report.tracks import Track, Tracks
from companion.runtime import trajectory_error

MOVING_M_S = 0.3


class Summary(msgspec.Struct, frozen=True, kw_only=True):
    """Units stand in the names; NaN means that the flight gave no such figure."""

    completed: bool
    contact: str  # "" or what was touched
    reason: str
    seed: int
    world: str
    mission: str
    min_clearance_m: float  # of the hull to trunks and branches, true
    position_rmse_m: float  # of the estimate in map against the truth; position and yaw of the start are aligned
    end_error_m: float
    drift_percent: float  # of odometry: mean relative translation error over 50 m segments, or end error / length
    path_length_m: float
    mean_speed_m_s: float  # while moving
    max_speed_m_s: float
    duration_s: float  # simulated
    wall_s: float
    real_time_factor: float
    cpu_s: dict[str, float]
    compute_p95_ms: dict[str, dict[str, float]]  # CPU per node and event, where a delay is modelled
    dropped: dict[str, int]
    messages: int
    flight_hash: str


def trajectory_figures(tracks: Tracks) -> dict[str, float]:
    """Accuracy, length, speed and clearance of a flight."""
    truth = tracks.true_track()
    if len(truth.t_s) < 2:
        return dict.fromkeys(_FIGURES, float("nan"))
    estimate, truth_then = aligned(tracks.map_track(), truth)
    error = np.linalg.norm(estimate.p - truth_then.p, axis=1)
    speed = np.linalg.norm([m.v_world for m in tracks.truth], axis=1)
    moving = speed[speed > MOVING_M_S]
    return {
        "min_clearance_m": min(m.clearance_m for m in tracks.truth),
        "position_rmse_m": float(np.sqrt((error**2).mean())) if len(error) else float("nan"),
        "end_error_m": float(error[-1]) if len(error) else float("nan"),
        "drift_percent": drift_percent(*aligned(tracks.estimated_track(), truth)),
        "path_length_m": path_length(truth.p),
        "mean_speed_m_s": float(moving.mean()) if len(moving) else 0.0,
        "max_speed_m_s": float(speed.max()),
        "duration_s": float(truth.t_s[-1]),
    }


def estimated_figures(tracks: Tracks) -> dict[str, float]:
    """Length and speed as the stack itself saw them: where no simulator tells the truth."""
    if len(tracks.odometry) < 2:
        return dict.fromkeys(_FIGURES, float("nan"))
    estimate = tracks.estimated_track()
    speed = np.linalg.norm([m.v_odom for m in tracks.odometry], axis=1)
    moving = speed[speed > MOVING_M_S]
    return dict.fromkeys(_FIGURES, float("nan")) | {
        "path_length_m": path_length(estimate.p),
        "mean_speed_m_s": float(moving.mean()) if len(moving) else 0.0,
        "max_speed_m_s": float(speed.max()),
        "duration_s": float(estimate.t_s[-1]),
    }


def path_length(p: Array) -> float:
    """Length of a polyline (N, 3) without standing noise: steps shorter than 5 cm are joined."""
    total, anchor = 0.0, p[0]
    for q in p[1:]:
        step = float(np.linalg.norm(q - anchor))
        if step >= 0.05:
            total, anchor = total + step, q
    return total


def aligned(estimate: Track, truth: Track) -> tuple[Track, Track]:
    """(estimate in the world, truth at the same times), aligned by yaw and position of the start alone."""
    if not len(estimate.t_s):
        return estimate, estimate
    keep = estimate.t_s <= truth.t_s[-1]
    estimate = Track(estimate.t_s[keep], estimate.p[keep], estimate.q[keep])
    then = truth.at(estimate.t_s)
    q_turn = quaternion_from_yaw(yaw_of(then.q[0]) - yaw_of(estimate.q[0]))
    p = rotate(q_turn, estimate.p - estimate.p[0]) + then.p[0]
    q = np.array([quaternion_multiply(q_turn, q) for q in estimate.q])
    return Track(estimate.t_s, p, q), then


def drift_percent(estimate: Track, truth: Track) -> float:
    """Mean relative translation error over 50 m segments of true path, in percent.

    Relative displacements are compared in the body frame of the segment's start (Geiger et al.,
    KITTI, CVPR 2012). A flight under 50 m gets its end error over its length.
    """
    if len(truth.t_s) < 2:
        return float("nan")
    R_est, R_true = (Rotation.from_quat(t.q[::10], scalar_first=True).as_matrix() for t in (estimate, truth))
    return trajectory_error.drift_percent(estimate.p[::10], truth.p[::10], R_est, R_true)


_FIGURES: tuple[str, ...] = (
    "min_clearance_m", "position_rmse_m", "end_error_m", "drift_percent",
    "path_length_m", "mean_speed_m_s", "max_speed_m_s", "duration_s",
)  # fmt: skip


def to_json(summary: Summary) -> bytes:
    """Indented JSON; NaN becomes null."""
    return msgspec.json.format(msgspec.json.encode(_rounded(msgspec.to_builtins(summary))), indent=2)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return round(value, 6) if isinstance(value, float) else value
