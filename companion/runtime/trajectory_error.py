"""How far an estimated track is from a reference: positions only, after one rigid alignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array


@dataclass(frozen=True, slots=True)
class TrackError:
    """Metres; `flat` errors leave the height out."""

    compared: int  # poses within the reference's time
    length_m: float  # of the reference between them
    ate_m: float  # root mean square after alignment
    ate_flat_m: float
    rpe_m: float  # root mean square error of the displacement over 1 s
    end_m: float  # at the last pose, after alignment
    aligned: Array  # the estimate in the reference's frame, (N, 3)


def track_error(
    stamps_ns: Array, p: Array, reference_ns: Array, reference_p: Array, *, flat: bool
) -> TrackError | None:
    """Compare p (N, 3) with the reference, interpolated at the same stamps.

    None if fewer than three poses overlap. `flat`: the reference's heights are not to be
    trusted, so x and y alone are aligned and compared.
    """
    inside = (stamps_ns >= reference_ns[0]) & (stamps_ns <= reference_ns[-1])
    if inside.sum() < 3:
        return None
    t, estimate = stamps_ns[inside], p[inside]
    # Relative times: interpolation in float64 would round stamps of this epoch to 256 ns.
    at, known = t - reference_ns[0], reference_ns - reference_ns[0]
    truth = np.column_stack([np.interp(at, known, reference_p[:, k]) for k in range(3)])
    used = 2 if flat else 3
    aligned = estimate.copy()
    aligned[:, :used] = align(estimate[:, :used], truth[:, :used])
    off = (aligned - truth)[:, :used]
    step = max(1, round(1e9 / float(np.median(np.diff(t)))))
    moved = (off[step:] - off[:-step]) if len(off) > step else off[-1:] - off[:1]
    return TrackError(
        compared=len(t),
        length_m=path_length(truth[:, :used]),
        ate_m=_rms(off),
        ate_flat_m=_rms(off[:, :2]),
        rpe_m=_rms(moved),
        end_m=float(np.linalg.norm(off[-1])),
        aligned=aligned,
    )


SEGMENT_M = 50.0


def drift_percent(p: Array, p_true: Array, R: Array, R_true: Array) -> float:
    """Mean relative translation error over 50 m segments of the true path, in percent.

    Positions (N, 3) and attitudes (N, 3, 3) of the same times. Displacements are compared in the body frame of
    the segment's start (A. Geiger et al., KITTI, CVPR 2012). A way under 50 m gets its end error over its length.
    """
    along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(p_true, axis=0), axis=1))]
    ends = np.searchsorted(along, along + SEGMENT_M)
    begins = np.flatnonzero(ends < len(along))
    if not len(begins):
        return 100.0 * float(np.linalg.norm(p[-1] - p_true[-1])) / max(float(along[-1]), 1.0)
    ends = ends[begins]
    seen = np.einsum("nji,nj->ni", R[begins], p[ends] - p[begins])
    true = np.einsum("nji,nj->ni", R_true[begins], p_true[ends] - p_true[begins])
    return 100.0 * float(np.linalg.norm(seen - true, axis=1).mean()) / SEGMENT_M


def align(source: Array, target: Array) -> Array:
    """`source` (N, D) after the rotation and shift that bring it nearest to `target` (N, D).

    Source: S. Umeyama, PAMI 1991, without scale.
    """
    a, b = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((source - a).T @ (target - b))
    keep = np.ones(source.shape[1])
    keep[-1] = np.sign(np.linalg.det(U @ Vt))
    aligned: Array = (source - a) @ (U * keep) @ Vt + b
    return aligned


def path_length(p: Array) -> float:
    """Sum of the distances between successive positions (N, D), m."""
    return float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum())


def _rms(off: Array) -> float:
    return float(np.sqrt((off**2).sum(axis=1).mean()))
