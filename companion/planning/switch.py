"""When a new way replaces the one being flown: nearly at once if it bends the same way around everything, late if not.

Two ways are taken to be of one homotopy class if all straight lines between points at the same shares of their lengths
are free: the one can then be drawn into the other (sufficient, not necessary). Lengths are compared as flown: smoothing
makes ways longer, so a raw way around the same trunks seems shorter than the smooth old one at every replan.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np

from companion.core.messages import Array
from companion.planning.polyline import at, length, without_repeats
from companion.planning.smooth import SmoothConfig, smooth
from companion.planning.space import FieldSpace

Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Metres = Annotated[float, msgspec.Meta(ge=0)]
_RUNGS_M = 0.5  # between two of these lines


class SwitchConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How much shorter a new way must be."""

    same_share: Share = 0.9
    """A new way of the same class replaces a good old one if it is shorter than this share of it ..."""
    same_m: Metres = 0.3
    """... less this."""
    other_share: Share = 0.9
    """A way of another class must be shorter than this share ..."""
    other_m: Metres = 0.3
    """... less this."""


def same_class(a: Array, b: Array, space: FieldSpace) -> bool:
    """Can way `a` (N, 3) be drawn into way `b` (M, 3) without meeting what is blocked?"""
    rungs = max(int(max(length(a), length(b)) / _RUNGS_M), 1)
    shares = np.linspace(0.0, 1.0, rungs + 1)
    pairs = zip(at(a, shares * length(a)), at(b, shares * length(b)), strict=True)
    return all(space.segment_free(p, q) for p, q in pairs)


def as_flown(escape: Array, path: Array, space: FieldSpace, config: SmoothConfig) -> Array:
    """A raw way, `path` (N, 3) free in `space` behind its `escape` (M, 3), with the length that it has smoothed."""
    return without_repeats(np.vstack([escape, smooth(without_repeats(path), space, config)]))


def better(new: Array, old: Array, space: FieldSpace, config: SwitchConfig) -> tuple[bool, bool]:
    """(does `new` replace a good `old` way, are they of one class); (N, 3) and (M, 3), with the same end."""
    new_m, old_m = length(new), length(old)
    if new_m > config.same_share * old_m - config.same_m and new_m > config.other_share * old_m - config.other_m:
        return False, True
    same = same_class(new, old, space)
    share, less_m = (config.same_share, config.same_m) if same else (config.other_share, config.other_m)
    return bool(new_m <= share * old_m - less_m), same
