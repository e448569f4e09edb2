"""A live flight in figures: what its `summary.json` holds."""

from __future__ import annotations

from typing import Any

import msgspec


class LiveSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Units stand in the names; what a flight gave no figure for is null."""

    completed: bool
    contact: bool  # the simulator's word; false where there is none
    touched: str
    reason: str
    mission: str
    vehicle: str
    link: str
    duration_s: float
    figures: dict[str, float]  # accuracy, length, speed, clearance: against the truth, where there is one
    setpoint_gap_ms: dict[str, float]  # p50, p99, max between setpoints as they left, count
    sweep_to_setpoint_ms: dict[str, float]  # from a sweep's stamp to the first MAVLink setpoint made from it
    lost: dict[str, float]  # samples per topic, of all groups
    dropped: dict[str, int]  # per node: replaced by newer ones while it was busy
    late_ticks: dict[str, int]  # per node: skipped since it was busy
    restarts: dict[str, int]
    events: list[str]  # of the supervisor
    cpu_percent: dict[str, float]  # per group, of one core
    memory_mb: dict[str, float]
    link_figures: dict[str, float]


def percentiles(figures: dict[str, float], name: str) -> dict[str, float]:
    """The entries `<name>_p50_ms` and so on, without the prefix."""
    head = f"{name}_"
    return {k.removeprefix(head).removesuffix("_ms"): v for k, v in figures.items() if k.startswith(head)}


def to_json(summary: LiveSummary) -> bytes:
    """Indented JSON; NaN becomes null."""
    return msgspec.json.format(msgspec.json.encode(_rounded(msgspec.to_builtins(summary))), indent=2)


def _rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _rounded(v) for k, v in value.items()}
    return round(value, 3) if isinstance(value, float) else value
