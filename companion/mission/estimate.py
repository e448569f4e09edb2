"""Dry run: length, time and bounding box of each step, from the file alone."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np

from companion.core.messages import Array
from companion.mission.route import Leg, legs_of
from companion.mission.schema import AnyStep, Hover, Land, Mission, ReturnHome

LAND_SPEED_M_S = 0.7  # PX4 MPC_LAND_SPEED default
LAND_EXTRA_S = 3.0  # until the autopilot is sure and disarms


@dataclass(frozen=True, slots=True, kw_only=True)
class StepEstimate:
    """What one step takes if nothing is in the way."""

    id: str
    do: str
    goals: int
    length_m: float
    time_s: float
    speed: float  # m/s
    low: tuple[float, float, float]  # corner of the bounding box, home frame, m
    high: tuple[float, float, float]


def estimate(mission: Mission) -> tuple[StepEstimate, ...]:
    """One row per step, in order; obstacles, wind and slope are not in it."""
    rows, here = [], np.zeros(3)
    for index, step in enumerate(mission.steps):
        legs = legs_of(mission, step, (float(here[0]), float(here[1])))
        row, here = _row(mission, index, legs, here)
        rows.append(row)
    return tuple(rows)


def total_time_s(rows: tuple[StepEstimate, ...]) -> float:
    """Seconds of all steps."""
    return sum(row.time_s for row in rows)


def travel_time_s(length_m: float, speed: float, accel: float) -> float:
    """From rest to rest with a trapezoidal speed, s."""
    if length_m < speed**2 / accel:
        return 2.0 * math.sqrt(length_m / accel)
    return length_m / speed + speed / accel


def _row(mission: Mission, index: int, legs: tuple[Leg, ...], start: Array) -> tuple[StepEstimate, Array]:
    step, limits = mission.steps[index], mission.limits_of(mission.steps[index])
    points = [start, *_points(legs, start)]
    lengths = [float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(points)]
    speed = limits.climb if legs and legs[0].kind == "takeoff" else limits.speed
    time_s, run = 0.0, 0.0
    for leg, length in zip(legs, lengths, strict=True):
        run += length
        if not leg.fly_through or leg is legs[-1]:
            time_s, run = time_s + travel_time_s(run, speed, limits.accel), 0.0
    time_s += _standing_s(step, float(points[-1][2]))
    corners = np.array(points)
    end = points[-1] * (1.0, 1.0, 0.0 if _lands(step) else 1.0)
    row = StepEstimate(
        id=mission.id_of(index),
        do=str(step.__struct_config__.tag),
        goals=len(legs),
        length_m=sum(lengths),
        time_s=time_s,
        speed=speed,
        low=_triple(corners.min(axis=0)),
        high=_triple(corners.max(axis=0)),
    )
    return row, end


def _points(legs: tuple[Leg, ...], start: Array) -> list[Array]:
    """Goals in the home frame; body goals as if the vehicle looked along +x."""
    return [leg.p + start * (1.0, 1.0, math.isnan(leg.agl_m)) if leg.frame == "body" else leg.p for leg in legs]


def _lands(step: AnyStep) -> bool:
    return isinstance(step, Land) or (isinstance(step, ReturnHome) and step.land == "land")


def _standing_s(step: AnyStep, height_m: float) -> float:
    if isinstance(step, Hover):
        return step.seconds
    return max(height_m, 0.0) / LAND_SPEED_M_S + LAND_EXTRA_S if _lands(step) else 0.0


def _triple(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])
