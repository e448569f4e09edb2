"""The guards' verdict on one set of inputs: `assess(Health(...), SafetyConfig()) -> Verdict`.

Every rule gives an action; the strongest wins (ok < slow < hold < land), the first of equals
gives the reason.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated, Literal

import msgspec

Action = Literal["ok", "slow", "hold", "land"]
RANK: dict[Action, int] = {"ok": 0, "slow": 1, "hold": 2, "land": 3}
NEEDED = ("LioNode", "MappingNode", "PlanningNode")  # nothing is flown without them
Seconds = Annotated[float, msgspec.Meta(gt=0)]
Metres = Annotated[float, msgspec.Meta(gt=0)]
Share = Annotated[float, msgspec.Meta(ge=0, le=1)]


class SafetyConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """When to slow down, to stop, to land."""

    odometry_hold_s: Seconds = 0.25
    """Odometry older than this: brake."""
    odometry_land_s: Seconds = 1.5
    """Odometry older than this: land."""
    measured_hold_s: Seconds = 0.8
    """No LiDAR or camera measurement inside the odometry for this long: brake."""
    measured_land_s: Seconds = 4.0
    """No measurement for this long: land."""
    lidar_slow_s: Seconds = 0.35
    """Last LiDAR update older than this: slow (three sweeps)."""
    lidar_hold_s: Seconds = 1.0
    """Last LiDAR update older than this: brake, for obstacles are no longer seen."""
    lidar_land_s: Seconds = 8.0
    """Last LiDAR update older than this: land."""
    map_slow_s: Seconds = 0.8
    """Local map older than this, in the air: slow."""
    map_hold_s: Seconds = 2.0
    """Local map older than this, in the air: brake."""
    map_land_s: Seconds = 10.0
    """Local map older than this, in the air: land."""
    position_std_slow_m: Metres = 0.5
    """Standard deviation of the position (largest axis): slow."""
    position_std_hold_m: Metres = 1.0
    """Standard deviation of the position: brake."""
    position_std_land_m: Metres = 3.0
    """Standard deviation of the position: land."""
    quality_slow: Share = 0.25
    """Quality of the odometry below this, in the air: slow."""
    lost_land_s: Seconds = 5.0
    """Odometry says that it is lost: brake; for longer than this: land."""
    battery_land_fraction: Share = 0.08
    """Battery below this: land."""
    fence_slow_m: Annotated[float, msgspec.Meta(ge=0)] = 1.0
    """Nearer than this to the fence from inside: slow."""
    fence_land_s: Seconds = 5.0
    """Outside the fence: brake; for longer than this: land."""
    slow_scale: Annotated[float, msgspec.Meta(gt=0, le=1)] = 0.4
    """Share of the planned speed when slow."""
    calm_s: Annotated[float, msgspec.Meta(ge=0)] = 0.5
    """A milder verdict counts only when it has lasted this long."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Health:
    """What the guards look at; infinite ages: never heard."""

    airborne: bool
    odometry_age_s: float
    measured_age_s: float  # of the newest LiDAR or camera update inside the odometry
    lidar_age_s: float  # of the newest LiDAR update
    map_age_s: float
    position_std_m: float  # largest axis
    quality: float  # of the odometry, 0..1
    battery_fraction: float  # < 0 or NaN: not known
    fence_depth_m: float  # inside > 0, outside < 0; infinite: no fence
    outside_s: float  # how long outside the fence
    down: tuple[tuple[str, str], ...] = ()  # (node, reason) of what does not run
    lost_s: float = 0.0  # how long the odometry has said that it is lost
    lost_because: str = ""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What to do, and why."""

    action: Action
    reason: str


def assess(health: Health, config: SafetyConfig) -> Verdict:
    """The strongest of all rules; on the ground only odometry counts."""
    verdicts = list(_always(health, config))
    if health.airborne:
        verdicts += [*_estimate(health, config), *_sensing(health, config), *_fence(health, config)]
        if 0 <= health.battery_fraction < config.battery_land_fraction:
            verdicts.append(Verdict("land", f"battery {health.battery_fraction:.0%} is critical"))
    else:
        verdicts = [Verdict(_at_most(v.action, "hold"), v.reason) for v in verdicts]
    return max(verdicts, key=lambda v: RANK[v.action], default=Verdict("ok", ""))


def _at_most(action: Action, limit: Action) -> Action:
    return action if RANK[action] <= RANK[limit] else limit


def _graded(
    value: float, unit: str, what: str, *, slow: float = math.inf, hold: float, land: float
) -> Iterator[Verdict]:
    """One verdict if `value` exceeds a bound; NaN counts as beyond all."""
    shown = "never heard" if math.isinf(value) else f"{value:.2f} {unit}"
    for action, bound in (("land", land), ("hold", hold), ("slow", slow)):
        if not value <= bound:
            yield Verdict(action, f"{what} {shown}")  # type: ignore[arg-type]
            return


def _always(h: Health, c: SafetyConfig) -> Iterator[Verdict]:
    yield from _graded(h.odometry_age_s, "s", "odometry age", hold=c.odometry_hold_s, land=c.odometry_land_s)


def _estimate(h: Health, c: SafetyConfig) -> Iterator[Verdict]:
    yield from _graded(h.measured_age_s, "s", "dead reckoning for", hold=c.measured_hold_s, land=c.measured_land_s)
    yield from _graded(
        h.position_std_m,
        "m",
        "position std",
        slow=c.position_std_slow_m,
        hold=c.position_std_hold_m,
        land=c.position_std_land_m,
    )
    if not h.quality >= c.quality_slow:
        yield Verdict("slow", f"quality of the odometry {h.quality:.0%}")
    if h.lost_because:
        yield Verdict("land" if h.lost_s > c.lost_land_s else "hold", f"lost: {h.lost_because}")


def _sensing(h: Health, c: SafetyConfig) -> Iterator[Verdict]:
    yield from _graded(
        h.lidar_age_s, "s", "LiDAR update age", slow=c.lidar_slow_s, hold=c.lidar_hold_s, land=c.lidar_land_s
    )
    yield from (Verdict("hold", f"{node} is down: {reason}") for node, reason in h.down if node in NEEDED)
    yield from _graded(h.map_age_s, "s", "local map age", slow=c.map_slow_s, hold=c.map_hold_s, land=c.map_land_s)


def _fence(h: Health, c: SafetyConfig) -> Iterator[Verdict]:
    if h.fence_depth_m < 0:
        action: Action = "land" if h.outside_s > c.fence_land_s else "hold"
        yield Verdict(action, f"{-h.fence_depth_m:.1f} m outside the fence")
    elif h.fence_depth_m < c.fence_slow_m:
        yield Verdict("slow", f"{h.fence_depth_m:.1f} m from the fence")
