"""What one look tells of a voxel: OctoMap's clamped log-odds, in int8 steps."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec

from companion.core.errors import InputError

UNKNOWN = -128  # int8 mark of a voxel that no ray has met
_Probability = Annotated[float, msgspec.Meta(gt=0.0, lt=1.0)]


class SensorModel(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Inverse sensor model. Source: A. Hornung et al., "OctoMap", Autonomous Robots, 2013.

    Its own 0.4 for a miss and 0.12 for the clamp erase branches: one of 1 cm fills a twentieth of a
    voxel, so that most scans see through it. Here one return outweighs eleven scans without.
    """

    hit: _Probability = 0.8  # of being occupied, after one return
    miss: _Probability = 0.47  # of being occupied, after one ray went through
    lowest: _Probability = 0.3  # clamp: bounds how many hits make a free voxel occupied
    highest: _Probability = 0.97  # clamp: bounds how many misses clear an occupied voxel

    def __post_init__(self) -> None:
        if not self.lowest < self.miss < 0.5 < self.hit < self.highest:
            raise InputError(
                f"out of order: {self.lowest}, {self.miss}, {self.hit}, {self.highest}",
                field="mapping.voxels.sensor",
                valid="lowest < miss < 0.5 < hit < highest",
            )


@dataclass(frozen=True, slots=True)
class Steps:
    """A sensor model in int8 steps; `per_unit` steps are one unit of log-odds."""

    hit: int
    miss: int
    lowest: int
    highest: int
    per_unit: float


def quantise(model: SensorModel) -> Steps:
    """Choose the steps whose hit : miss ratio is nearest to the model's.

    The ratio decides how many misses outweigh a hit, so it is what must survive rounding.
    """
    hit, miss = log_odds(model.hit), -log_odds(model.miss)
    reach = max(log_odds(model.highest), -log_odds(model.lowest))
    candidates = (
        (abs(h / m - hit / miss), h, m)
        for m in range(1, 127)
        for h in (math.floor(m * hit / miss), math.ceil(m * hit / miss))
        if h >= 1 and round(reach * h / hit) <= 127
    )
    _, h, m = min(candidates, default=(0.0, 0, 0))
    if h == 0:
        raise InputError("one hit or miss is too weak beside the clamps for int8 steps", field="mapping.voxels.sensor")
    per_unit = h / hit
    lowest, highest = log_odds(model.lowest) * per_unit, log_odds(model.highest) * per_unit
    return Steps(h, -m, round(lowest), round(highest), per_unit)


def log_odds(probability: float) -> float:
    """Natural log-odds of a probability."""
    return math.log(probability / (1.0 - probability))
