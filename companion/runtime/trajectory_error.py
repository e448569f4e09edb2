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
