"""Where in a saved map is what is seen: any map of occupied places, with trunks or without.

Windows of about a second are looked up one by one. Where trunks stand their constellation
proposes a place, elsewhere every place of the map is tried; registration in space confirms it or refuses. A
window alone may be unsure: the search answers when one is sure, and says nothing otherwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array, Array32
from companion.estimation.downsample import Thinner
from companion.estimation.places.constellation import Place, accepted, constellation, match
from companion.estimation.places.correlate import HitMap
from companion.estimation.places.likeliest import CoarseMap, LikeliestConfig
from companion.estimation.places.submap import CompareConfig, best_fit, turn_z
from companion.estimation.places.trunks import TrunkConfig, detect_trunks
from companion.estimation.places.verify import Alignment, VerifyConfig, align

Positive = Annotated[float, msgspec.Meta(gt=0)]


class LocateConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How views are compared with a map of voxels, whose points are not exact."""

    compare: CompareConfig = CompareConfig(
        verify=VerifyConfig(near_m=0.25, least_near=0.6, settled_m=5e-3, iterations=20),
        view_verify=VerifyConfig(near_m=0.2, least_near=0.85, settled_m=5e-3, iterations=20, slides=4),
        view_lead=0.97,
        view_misfits=3.0,
    )
    likeliest: LikeliestConfig = LikeliestConfig()
    map_trunks: TrunkConfig = TrunkConfig(cell_m=0.2, least_points=6, roundness_m=0.12)
    """Of the map, whose voxels are coarse."""
    reach_m: Positive = 20.0  # of the map about a guess that takes part in registration ...
    beyond_m: Positive = 2.0  # ... which reaches so much farther than the points of a view that do
    thin_m: Positive = 0.12  # of the views
    agree_m: Positive = 0.5  # two views that name places nearer than this say the same


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Where the newest view's frame is in the map: x_map = R x_view + p."""

    R: Array  # (3, 3)
    p: Array  # (3,), m
    near: float  # share of the view's points that have one of the map near
    by: str  # "trunks" or "view"


class Locator:
    """One map, many questions.

    >>> locator = Locator(points_map, ground_z, eyes_map, LocateConfig())
    >>> located = locator.look(points_view)
    """

    def __init__(self, points_map: Array32, eyes_map: Array, config: LocateConfig) -> None:
        """Occupied points (N, 3) and where the vehicle may be (M, 3), at its height, m, z up."""
        if not len(points_map):
            raise InputError("nothing is occupied", field="map", valid="a map of a flight")
        self.config = config
        self._points, self._eyes = points_map, eyes_map
        trunks = detect_trunks(points_map.astype(np.float64), config.map_trunks)
        self.sky = constellation(trunks.centers, config.compare.constellation)
        self._grids: tuple[CoarseMap, HitMap] | None = None  # only asked for where no trunks stand

    def look(self, points_view: Array32) -> Located | None:
        """Find the levelled frame of points (N, 3), m, its origin at the vehicle; None: not sure."""
        seen = detect_trunks(points_view.astype(np.float64), self.config.compare.trunks)
        sky = constellation(seen.centers, self.config.compare.constellation)
        place = accepted(match(self.sky, sky, self.config.compare.constellation), self.config.compare.constellation)
        far2 = (self.config.reach_m - self.config.beyond_m) ** 2
        near = points_view[np.einsum("ij,ij->i", points_view[:, :2], points_view[:, :2]) < far2]
        if place is not None:
            return _located(self._by_trunks(place, near), "trunks")
        return _located(self._by_view(near), "view")

    def _by_trunks(self, place: Place, points_view: Array32) -> Alignment | None:
        near = self._about(place.p_map)
        if not len(near):
            return None
        eye = self._eyes[np.argmin(np.linalg.norm(self._eyes[:, :2] - place.p_map, axis=1))]
        guess = turn_z(place.yaw), np.array([*place.p_map, eye[2]])
        return align(near, points_view, guess, self.config.compare.verify)

    def _by_view(self, points_view: Array32) -> Alignment | None:
        if self._grids is None:
            self._grids = (
                CoarseMap(self._points, self.config.likeliest),
                HitMap(self._points, self.config.compare.correlate),
            )
        places = self._grids[0].likeliest(self._eyes, points_view)
        return best_fit(self._about, self._grids[1], points_view, places, self.config.compare)

    def _about(self, p_map: Array) -> Array32:
        gap = self._points[:, :2] - p_map[:2].astype(np.float32)
        near: Array32 = self._points[np.einsum("ij,ij->i", gap, gap) < self.config.reach_m**2]
        return near


class Search:
    """One search: feed it views about a second apart until it answers.

    Each is looked up together with those before it. What trunks say is sure at once; what was tried all over
    the map counts when the next view says it again, since halls and tunnels repeat themselves.
    """

    def __init__(self, locator: Locator) -> None:
        self._locator = locator
        self._seen: Array32 = np.empty((0, 3), np.float32)
        self._guess: Located | None = None
        self._thinner = Thinner()
        self.views = 0

    def look(self, points_view: Array32, R_step: Array, p_step: Array) -> Located | None:
        """Take in a view (N, 3) and its pose, seen from the frame of the view before; None: not sure yet."""
        moved = (self._seen - p_step.astype(np.float32)) @ R_step.astype(np.float32)
        config = self._locator.config
        self._seen = self._thinner.firsts(np.concatenate([moved, points_view]).astype(np.float32), config.thin_m)
        self.views += 1
        found, last = self._locator.look(self._seen), self._guess
        self._guess = found
        if found is None or found.by == "trunks":
            return found
        if last is None:
            return None
        gap_m = float(np.linalg.norm(last.R @ p_step + last.p - found.p))
        return found if gap_m <= config.agree_m else None


def _located(found: Alignment | None, by: str) -> Located | None:
    return None if found is None else Located(found.R, found.p, found.near, by)
