"""Survey lanes over a polygon: clip parallel lines, fly them to and fro.

    path_xy = survey_path(area, spacing_m=6.0, heading_rad=None, start_xy=(0.0, 0.0))

The heading with the fewest lanes is that of an edge: the width of a convex polygon is least
across one of its edges (Huang, "Optimal line-sweep-based decompositions for coverage", ICRA 2001).
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array

Polygon = tuple[tuple[float, float], ...]


def survey_path(
    area: Polygon,
    *,
    spacing_m: float,
    heading_rad: float | None,
    crosshatch: bool = False,
    start_xy: tuple[float, float] = (0.0, 0.0),
) -> Array:
    """Ends of the lanes in flying order, (2 N, 2): lane k runs from row 2 k to row 2 k + 1.

    `heading_rad` from +x; None takes the one with the fewest lanes, then the shortest path.
    A crosshatch adds a second pass across the first. Each pass begins at its end nearest to
    where the vehicle is.
    """
    heading = best_heading(area, spacing_m) if heading_rad is None else heading_rad
    first = _from_nearest_end(serpentine(lanes(area, spacing_m, heading)), np.asarray(start_xy))
    if not crosshatch:
        return first
    second = serpentine(lanes(area, spacing_m, heading + math.pi / 2))
    return np.vstack([first, _from_nearest_end(second, first[-1])])


def lane_count(area: Polygon, spacing_m: float, heading_rad: float) -> int:
    """Parallel lines that cover the polygon, at most `spacing_m` apart."""
    low, high = _across(area, heading_rad)
    return max(1, math.ceil((high - low) / spacing_m - 1e-9))


def lanes(area: Polygon, spacing_m: float, heading_rad: float) -> Array:
    """Segments (N, 2, 2) inside the polygon, line after line, each along the heading.

    The lines are spread evenly: the outermost run half a pitch inside the polygon's edge.
    """
    low, high = _across(area, heading_rad)
    count = lane_count(area, spacing_m, heading_rad)
    along, across = _axes(heading_rad)
    segments = []
    for k in range(count):
        offset = low + (k + 0.5) * (high - low) / count
        cuts = _cuts(np.asarray(area) @ np.column_stack([along, across]), offset)
        segments += [[a * along + offset * across, b * along + offset * across] for a, b in cuts]
    return np.array(segments).reshape(-1, 2, 2)


def best_heading(area: Polygon, spacing_m: float) -> float:
    """Direction of the edge that gives the fewest lane segments, then the shortest path, rad in [0, pi)."""
    corners = np.asarray(area)
    edges = np.roll(corners, -1, axis=0) - corners
    headings = sorted({round(math.atan2(y, x) % math.pi, 9) % math.pi for x, y in edges})
    return min(headings, key=lambda heading: _effort(area, spacing_m, heading))


def serpentine(segments: Array) -> Array:
    """Ends (2 N, 2) of segments (N, 2, 2), flown to and fro: every other line is reversed."""
    rows, line, previous = [], 0, None
    flat = segments.reshape(-1, 2, 2)
    directions = flat[:, 1] - flat[:, 0]
    for k in range(len(flat)):
        if previous is not None and not _same_line(flat[previous], flat[k], directions[k]):
            line += 1
        rows.append((line, k))
        previous = k
    ordered = []
    for number in range(line + 1):
        mine = [k for row, k in rows if row == number]
        ordered += [flat[k] for k in mine] if number % 2 == 0 else [flat[k][::-1] for k in reversed(mine)]
    return np.array(ordered).reshape(-1, 2)


def _same_line(a: Array, b: Array, direction: Array) -> bool:
    offset = b[0] - a[0]
    return abs(float(direction[0] * offset[1] - direction[1] * offset[0])) < 1e-6 * float(np.hypot(*direction))


def _from_nearest_end(path: Array, start: Array) -> Array:
    """The same lanes, begun at whichever of four ways starts nearest: reversed, mirrored, both."""
    mirrored = path.reshape(-1, 2, 2)[:, ::-1].reshape(-1, 2)
    ways = [path, path[::-1], mirrored, mirrored[::-1]]
    return min(ways, key=lambda way: round(float(np.hypot(*(way[0] - start))), 6))


def _axes(heading_rad: float) -> tuple[Array, Array]:
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return np.array([c, s]), np.array([-s, c])


def _across(area: Polygon, heading_rad: float) -> tuple[float, float]:
    offsets = np.asarray(area) @ _axes(heading_rad)[1]
    return float(offsets.min()), float(offsets.max())


def _cuts(corners: Array, offset: float) -> list[tuple[float, float]]:
    """Where the line y = offset is inside the polygon (N, 2): pairs of x, sorted (even-odd rule)."""
    following = np.roll(corners, -1, axis=0)
    spans = (corners[:, 1] > offset) != (following[:, 1] > offset)
    a, b = corners[spans], following[spans]
    x = np.sort(a[:, 0] + (offset - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0]))
    return [(float(p), float(q)) for p, q in zip(x[::2], x[1::2], strict=True) if q - p > 1e-6]


def _effort(area: Polygon, spacing_m: float, heading_rad: float) -> tuple[int, float]:
    if lane_count(area, spacing_m, heading_rad) > 2000:  # not worth generating; the check refuses it
        return lane_count(area, spacing_m, heading_rad), 0.0
    path = serpentine(lanes(area, spacing_m, heading_rad))
    return len(path) // 2, round(float(np.hypot(*np.diff(path, axis=0).T).sum()), 6)
