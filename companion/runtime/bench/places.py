"""How well places are known again: loops along a way, starts in a saved map. Scenes come from outside."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from time import thread_time

import msgspec
import numpy as np
from numpy.typing import NDArray

from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array, Array32, RegisteredScan
from companion.estimation.places.locate import Located, Locator, Search
from companion.estimation.places.loops import Closure, LoopConfig, LoopFinder

NEAR_M = 8.0  # pairs of submaps nearer than this are one place
_SLICE_M = 0.5  # of the clouds about the height of flight, in a picture
RIGHT_M, RIGHT_RAD = 0.2, 0.05  # a closure or an answer this near to the truth is right


class PlaceRow(msgspec.Struct, frozen=True, kw_only=True):
    """One figure of one scene, and what it should be; `met` None: no target."""

    scene: str
    gauge: str
    value: float
    target: str = ""
    met: bool | None = None


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What is seen at a start: points (N, 3) in the body, and the pose seen from the view before."""

    points_body: Array32
    R_step: Array
    p_step: Array
    p_map: Array  # the truth, (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Loops:
    """What a picture needs: keyframes by odometry, corrected and true (K, 3), pairs of closures, clouds of submaps."""

    ways: tuple[Array, Array, Array]
    closures: NDArray[np.int64]  # (C, 2)
    seen: tuple[Array, Array]  # (N, 3), where odometry and where the corrected poses put them


def loop_rows(
    scene: str, scans: Iterable[RegisteredScan], truth: tuple[Sequence[Array], Array], config: LoopConfig
) -> tuple[list[PlaceRow], Loops]:
    """Feed scans with drifting poses; `truth` has R and p of each. Every pair is compared, whatever odometry says."""
    patient = msgspec.structs.replace(config, rest_m=0.0, most_compared=1000, most_closures=1000)
    finder, cpu_s, count = LoopFinder(patient), 0.0, 0
    for scan in scans:
        started = thread_time()
        finder.add(scan.stamp_ns, scan.points_body, rotation_from_quaternion(scan.q_odom_body), scan.p_odom)
        cpu_s, count = cpu_s + thread_time() - started, count + 1
    at = np.array(finder.stamps_ns) // 10**8 - 1
    errors = np.array([_error(c, at, truth) for c in finder.closures]).reshape(-1, 2)
    right = (errors[:, 0] < RIGHT_M) & (errors[:, 1] < RIGHT_RAD)
    pairs = _pairs(finder, truth[1][at], patient)
    found = {(c.earlier, c.later) for c in finder.closures}
    before = _ate(finder.keyframe_p_odom, truth[1][at])
    refused = finder.audit()
    corrected = finder.corrected()
    after = _ate(corrected[:, :3], truth[1][at])
    precision = float(right.mean()) if len(right) else 1.0
    recall = len(pairs & found) / max(len(pairs), 1)
    way_m = float(np.linalg.norm(np.diff(truth[1], axis=0), axis=1).sum())
    rows = [
        PlaceRow(scene=scene, gauge="way_m", value=round(way_m, 1)),
        PlaceRow(scene=scene, gauge="closures", value=len(right)),
        PlaceRow(scene=scene, gauge="precision", value=round(precision, 4), target="1.000", met=precision == 1.0),
        PlaceRow(scene=scene, gauge="pairs_within_8_m", value=len(pairs)),
        PlaceRow(scene=scene, gauge="recall", value=round(recall, 4), target=">= 0.99", met=recall >= 0.99),
        PlaceRow(scene=scene, gauge="refused_by_audit", value=refused),
        PlaceRow(scene=scene, gauge="ate_before_m", value=round(before, 3)),
        PlaceRow(scene=scene, gauge="ate_after_m", value=round(after, 4), target="<= 0.05", met=after <= 0.05),
        PlaceRow(scene=scene, gauge="cpu_ms_per_s", value=round(1e4 * cpu_s / max(count, 1), 2)),
    ]
    return rows, _loops(finder, corrected, truth[1][at])


def _loops(finder: LoopFinder, corrected: Array, p_true: Array) -> Loops:
    """With the corrected way in `map`, where the first keyframe stays."""
    turn = finder.R_map_odom
    way = corrected[:, :3] @ turn.T + finder.p_map_odom
    odometry = finder.keyframe_p_odom
    seen: tuple[list[Array], list[Array]] = ([], [])
    for submap in finder.submaps:
        k = submap.keyframe
        cloud = submap.cloud[np.abs(submap.cloud[:, 2]) < _SLICE_M][::3]
        R = turn @ rotation_from_quaternion(corrected[k, 3:]) @ finder.keyframe_R_odom(k).T
        seen[0].append(cloud + odometry[k])
        seen[1].append(cloud @ R.T + way[k])
    pairs = np.array([(c.earlier, c.later) for c in finder.closures], np.int64).reshape(-1, 2)
    return Loops((odometry, way, p_true), pairs, (np.concatenate(seen[0]), np.concatenate(seen[1])))


def start_rows(
    scene: str, locator: Locator, starts: Iterable[Sequence[View]], *, known: bool, target: float
) -> list[PlaceRow]:
    """Search from each start; `known`: the views are of the map's place, else every answer is wrong."""
    right = wrong = silent = 0
    errors: list[float] = []
    views: list[int] = []
    cpu_ms: list[float] = []
    for start in starts:
        search = Search(locator)
        began = thread_time()
        answer, at = _answer(search, start)
        cpu_ms.append(1e3 * (thread_time() - began) / search.views)
        if answer is None:
            silent += 1
            continue
        error = float(np.linalg.norm(answer.p - at.p_map)) if known else np.inf
        right, wrong = right + (error < RIGHT_M), wrong + (error >= RIGHT_M)
        errors.append(error)
        views.append(search.views)
    count = right + wrong + silent
    share = (right if known else silent) / max(count, 1)
    gauge = "found" if known else "refused"
    rows = [
        PlaceRow(scene=scene, gauge="starts", value=count),
        PlaceRow(scene=scene, gauge=gauge, value=round(share, 3), target=f">= {target:g}", met=share >= target),
        PlaceRow(scene=scene, gauge="wrong", value=wrong, target="0", met=wrong == 0),
        PlaceRow(scene=scene, gauge="cpu_ms_per_view", value=round(float(np.median(cpu_ms)), 1)),
    ]
    if known and errors:
        rows.append(PlaceRow(scene=scene, gauge="median_error_m", value=round(float(np.median(errors)), 3)))
        rows.append(PlaceRow(scene=scene, gauge="mean_views", value=round(float(np.mean(views)), 2)))
    return rows


def _answer(search: Search, start: Sequence[View]) -> tuple[Located | None, View]:
    for view in start:
        answer = search.look(view.points_body, view.R_step, view.p_step)
        if answer is not None:
            return answer, view
    return None, start[-1]


def _error(closure: Closure, at: Array, truth: tuple[Sequence[Array], Array]) -> tuple[float, float]:
    a, b = int(at[closure.earlier]), int(at[closure.later])
    p = truth[0][a].T @ (truth[1][b] - truth[1][a])
    turn = closure.R.T @ truth[0][a].T @ truth[0][b]
    return float(np.linalg.norm(closure.p - p)), float(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1)))


def _pairs(finder: LoopFinder, p_true: Array, config: LoopConfig) -> set[tuple[int, int]]:
    """Pairs of submaps (keyframes earlier, later) that are one place, with way enough between them."""
    way = finder.way_m
    frames = [submap.keyframe for submap in finder.submaps]
    return {
        (a, b)
        for n, b in enumerate(frames)
        for a in frames[:n]
        if way[b] - way[a] >= config.least_way_m and np.linalg.norm(p_true[a] - p_true[b]) <= NEAR_M
    }


def _ate(p: Array, truth: Array) -> float:
    """Root mean square distance (N, 3) after the best rigid motion (S. Umeyama, PAMI 1991)."""
    a, b = p - p.mean(axis=0), truth - truth.mean(axis=0)
    u, _, vt = np.linalg.svd(b.T @ a)
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    return float(np.sqrt(np.mean(np.sum((a @ R.T - b) ** 2, axis=1))))
