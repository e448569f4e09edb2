"""Nominal, degraded or lost, and why: one word on the odometry for whoever must act on it."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

Positive = Annotated[float, msgspec.Meta(gt=0)]
State = Literal["nominal", "degraded", "lost"]


class HealthConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """From when on an estimate is not what it should be."""

    lidar_late_s: Positive = 0.35  # three sweeps missing: degraded
    degraded_sigma_m: Positive = 0.3  # standard deviation of the position, largest axis
    lost_sigma_m: Positive = 1.0
    quality_sigma_m: Positive = 0.35  # at this sigma the quality is exp(-1)


def judge(*, sigma_m: float, lidar_age_s: float, doubts: str, config: HealthConfig) -> tuple[State, str]:
    """State and reason; `doubts` is what the front end cannot vouch for ("" : nothing)."""
    if not sigma_m <= config.lost_sigma_m:
        return "lost", _joined(f"position sigma {sigma_m:.2f} m", _late(lidar_age_s, config), doubts)
    wide = f"position sigma {sigma_m:.2f} m" if sigma_m > config.degraded_sigma_m else ""
    reason = _joined(wide, _late(lidar_age_s, config), doubts)
    return ("degraded" if reason else "nominal"), reason


def _late(lidar_age_s: float, config: HealthConfig) -> str:
    return f"no LiDAR for {lidar_age_s:.1f} s" if lidar_age_s > config.lidar_late_s else ""


def _joined(*reasons: str) -> str:
    return "; ".join(r for r in reasons if r)
