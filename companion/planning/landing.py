"""Where the vehicle may come down: above ground that was seen, through a column that is known free."""

from __future__ import annotations

from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import convolve, maximum_filter, minimum_filter

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, LocalMap

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
_UNKNOWN, _OCCUPIED = 0, 2
_BIG_M = 1e6


class LandingConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a landing place must be like, and how far it may be away."""

    within_m: NotNegative = 4.0
    """Another place is looked for so far around the one where the vehicle stops."""
    pad_m: NotNegative = 0.2
    """The column is wider than the hull by this much to each side."""
    unknown_share: Share = 0.1
    """Share of unseen cells in the column, and of its ground, that is taken for chance."""
    ground_m: NotNegative = 0.5
    """What is occupied up to this height above the ground seen is ground."""
    aside_m: NotNegative = 1.0
    """So far aside it goes at least when the range finder sees what the map does not hold, up to ..."""
    moves: Annotated[int, msgspec.Meta(ge=0)] = 3
    """... so many times."""
    clear_s: NotNegative = 5.0
    """Nothing that moves may come over the place in this time, or the landing waits."""
    uneven_m: NotNegative = 0.6
    """Largest difference of the ground's heights under the column."""


class Columns:
    """The columns of a local map from a height (odom z, m) down, each as wide as the hull and its pad.

    >>> columns = Columns(local_map, top_z_odom=3.0, radius_m=0.56, config=LandingConfig())
    >>> columns.fault(np.array([1.0, 2.0, 3.0]))    # '': the vehicle may come down here
    """

    def __init__(self, local_map: LocalMap, *, top_z_odom: float, radius_m: float, config: LandingConfig) -> None:
        self._map, self._config = local_map, config
        ground = local_map.ground_z_odom.astype(np.float64)
        z = local_map.origin_odom[2] + local_map.resolution_m * (np.arange(local_map.state.shape[2]) + 0.5)
        within = (z > ground[:, :, None] + config.ground_m) & (z < top_z_odom)
        disc = _disc(radius_m / local_map.resolution_m)
        blocked = np.any(within & (local_map.state == _OCCUPIED), axis=2)
        cells = _summed(within.sum(axis=2), disc)
        unseen = _summed((within & (local_map.state == _UNKNOWN)).sum(axis=2), disc)
        highest = maximum_filter(np.nan_to_num(ground, nan=-_BIG_M), footprint=disc, mode="nearest")
        lowest = minimum_filter(np.nan_to_num(ground, nan=_BIG_M), footprint=disc, mode="nearest")
        self._faults = {
            "its ground was not seen": _summed(np.isnan(ground), disc) > config.unknown_share * disc.sum(),
            "something is in the column": maximum_filter(blocked, footprint=disc, mode="nearest"),
            "parts of the column were not seen": unseen > config.unknown_share * np.maximum(cells, 1.0),
            "its ground is uneven": highest - lowest > config.uneven_m,
        }

    def fault(self, p_odom: Array) -> str:
        """Why the vehicle should not come down at a place (3,); '' if it may."""
        i, j = np.floor((p_odom - self._map.origin_odom)[:2] / self._map.resolution_m).astype(int)
        if not (0 <= i < self._map.state.shape[0] and 0 <= j < self._map.state.shape[1]):
            return "it lies outside the local map"
        return next((words for words, where in self._faults.items() if where[i, j]), "")

    def nearest(self, p_odom: Array, *, beyond_m: float = 0.0) -> Array | None:
        """The place itself, or the nearest one without fault at its height, (3,) m; None: none within reach.

        Places nearer than `beyond_m` do not count.
        """
        if beyond_m <= 0.0 and not self.fault(p_odom):
            return p_odom.copy()
        good = np.argwhere(~np.logical_or.reduce(list(self._faults.values())))
        xy = self._map.origin_odom[:2] + (good + 0.5) * self._map.resolution_m
        away = np.linalg.norm(xy - p_odom[:2], axis=1)
        xy, away = xy[away >= beyond_m], away[away >= beyond_m]
        if not away.size or away.min() > self._config.within_m:
            return None
        return np.append(xy[int(np.argmin(away))], p_odom[2])


def beam_fault(range_m: float, q_odom_body: Array, height_m: float, config: LandingConfig) -> str:
    """What a downward range finder (along body -z) sees above the ground of the map, `height_m` below; '' if nothing.

    NaN (no echo, no ground) says nothing.
    """
    above_m = height_m - range_m * float(rotation_from_quaternion(q_odom_body)[2, 2])
    return f"the range finder sees something {above_m:.1f} m above the ground" if above_m > config.ground_m else ""


def stopping_place(p_odom: Array, v_odom: Array, *, accel: float) -> Array:
    """Where a vehicle that brakes with `accel`, m/s2, comes to rest, (3,) m."""
    place: Array = p_odom + v_odom * float(np.linalg.norm(v_odom)) / (2.0 * accel)
    return place


def _disc(radius: float) -> NDArray[np.bool_]:
    reach = int(np.ceil(radius))
    x, y = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2, indexing="ij")
    inside: NDArray[np.bool_] = np.hypot(x, y) <= max(radius, 0.5)
    return inside


def _summed(values: NDArray[np.generic], disc: NDArray[np.bool_]) -> Array:
    total: Array = convolve(values.astype(np.float64), disc.astype(np.float64), mode="nearest")
    return total
