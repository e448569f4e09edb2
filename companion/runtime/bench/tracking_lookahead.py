"""Sweep of the lookahead: the same course again and again, each time looking farther ahead.

rows = list(sweep(course, "preview", values, config, new_sim=..., mission=...))
best_of(rows).lookahead_s
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Literal, get_args

import msgspec
import numpy as np

from companion.config import Config, apply_overrides
from companion.core import topics
from companion.core.errors import InputError
from companion.core.messages import Array, Odometry
from companion.core.node import Node
from companion.mission.model import Mission
from companion.planning.polyline import arc_length, resample, without_repeats
from companion.runtime.bench.tracking import fly, with_method
from companion.runtime.bench.tracking_courses import HEIGHT_M, paced
from companion.runtime.bench.tracking_pilot import Course
from companion.runtime.bench.tracking_score import Score, score
from companion.runtime.codec import decode
from companion.runtime.flight_folder import logs_of
from companion.runtime.log_file import MESSAGE, read_log

Ahead = Literal["preview", "pure_pursuit"]
AHEADS: tuple[Ahead, ...] = get_args(Ahead)
KEYS: dict[Ahead, str] = {
    "preview": "tracking.follow.preview.reaction_s",
    "pure_pursuit": "tracking.follow.pursuit.lookahead_s",
}
VALUES: dict[Ahead, tuple[float, ...]] = {
    "preview": (0.0, 0.05, 0.1, 0.125, 0.15, 0.175, 0.2, 0.25, 0.3, 0.4),
    "pure_pursuit": (0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.25, 1.5),
}
_CALM = 1.5  # times the least jerk still counts as smooth
_MOVING_M_S = 0.3


class LookaheadRow(msgspec.Struct, frozen=True, kw_only=True):
    """One flight of the sweep."""

    course: str
    method: Ahead
    lookahead_s: float
    lookahead_m: float  # at the mean speed
    score: Score


def sweep(
    course: Course,
    method: Ahead,
    values: Sequence[float],
    config: Config,
    *,
    new_sim: Callable[[], Node],
    mission: Mission,
) -> Iterator[LookaheadRow]:
    """One row per lookahead time, s; the truth is the estimate, so that the tracker alone is seen."""
    for value in values:
        changed = apply_overrides(with_method(config, method), [f"{KEYS[method]}={value}"])
        figures = score(fly(course, changed, estimate="true", sim=new_sim(), mission=mission))
        yield LookaheadRow(
            course=course.name,
            method=method,
            lookahead_s=value,
            lookahead_m=round(value * figures.mean_m_s, 3),
            score=figures,
        )


def best_of(rows: Sequence[LookaheadRow]) -> LookaheadRow:
    """Of those that arrive and are about as smooth as the smoothest, the one nearest to the path."""
    arrived = [r for r in rows if r.score.ended and not r.score.contact] or list(rows)
    least = min(r.score.jerk_m_s3 for r in arrived)
    smooth = [r for r in arrived if r.score.jerk_m_s3 <= _CALM * least]
    return min(smooth, key=lambda r: r.score.rmse_m)


def course_of_flight(flight: Path, *, top_m_s: float) -> Course:
    """The way that a recorded flight took while it moved, lifted to the course's height at its start."""
    track = np.array([o.p_odom for log in logs_of(flight) for o in _odometry(log) if _moves(o)]).reshape(-1, 3)
    return course_of(flight.name or "flight", track, top_m_s=top_m_s)


def course_of_file(file: Path, *, top_m_s: float) -> Course:
    """Rows x, y, z in m, separated by commas, after an optional header line."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError("cannot be read as text", file=str(file)) from error
    rows = []
    for number, line in enumerate(lines, start=1):
        try:
            x, y, z = (float(part) for part in line.split(",")[:3])
        except ValueError:
            if number == 1 or not line.strip():
                continue
            raise InputError(f"{line!r}", file=str(file), line=number, valid="x,y,z in m") from None
        rows.append((x, y, z))
    if not np.all(np.isfinite(rows)):
        raise InputError("holds NaN or infinity", file=str(file), valid="x,y,z in m")
    return course_of(file.stem, np.array(rows).reshape(-1, 3), top_m_s=top_m_s)


def course_of(name: str, track: Array, *, top_m_s: float) -> Course:
    """A course from places (N, 3), m: thinned to 0.5 m, moved over the start, rounded, in even steps."""
    if len(track) < 2 or float(arc_length(track)[-1]) < 5.0:
        raise InputError(f"{name}: the way is shorter than 5 m", field="path")
    thin = [track[0]]
    for place in track[1:]:
        if float(np.linalg.norm(place - thin[-1])) >= 0.5:
            thin.append(place)
    points = resample(without_repeats(np.array(thin)), 0.1)
    for _ in range(20):  # binomial, so that no bend is sharper than about half a metre
        points[1:-1] = 0.5 * points[1:-1] + 0.25 * (points[:-2] + points[2:])
    lift = max(HEIGHT_M - float(points[0, 2]), HEIGHT_M - 1.0 - float(points[:, 2].min()))
    shift = np.array([-points[0, 0], -points[0, 1], lift])
    return paced(name, points + shift, top_m_s=top_m_s)


def _odometry(log: Path) -> Iterator[Odometry]:
    for entry in read_log(log):
        if entry[0] == MESSAGE and entry[3] == topics.ODOMETRY.name and entry[4] is not None:
            yield decode(entry[4], Odometry)


def _moves(odometry: Odometry) -> bool:
    return math.hypot(odometry.v_odom[0], odometry.v_odom[1]) > _MOVING_M_S
