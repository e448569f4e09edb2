"""Floor 2: the stages' settings composed into one `Config`; YAML files hold only differences.

config = apply_overrides(load_config(text, file="my.yaml"), ["mapping.voxels.resolution_m=0.25"])
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import msgspec

from companion.autopilot.node import AutopilotConfig
from companion.config.dump import dump_struct
from companion.config.overrides import apply_overrides_to
from companion.core.rig import Rig
from companion.core.strict_yaml import load_strict
from companion.estimation.config import EstimationConfig
from companion.mapping.node import MappingConfig
from companion.mission.config import MissionConfig
from companion.planning.config import PlanningConfig
from companion.safety.assess import SafetyConfig
from companion.sensors.guard import SensorsConfig
from companion.tracking.node import TrackingConfig

DELAY_MS: dict[str, dict[str, float]] = {
    # Above 1.4 times the p95 that docs/reference/performance.md shows: machines differ.
    # A camera message often completes the sweep that waited for it: it costs what a sweep does.
    "LioNode": {"sensors/lidar": 15.0, "sensors/camera": 15.0},
    "GraphNode": {"estimation/likelihood": 8.0},
    "LoopNode": {"estimation/registered_scan": 250.0},
    "MappingNode": {"estimation/registered_scan": 42.0},
    "ObstacleTracksNode": {"estimation/registered_scan": 5.0},
    "LandmarkNode": {"sensors/camera": 20.0},
    "PlanningNode": {"mapping/local_map": 40.0, "mission/goal": 40.0},
}


class LockstepConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How simulated time is run."""

    delay_ms: dict[str, dict[str, float]] = msgspec.field(default_factory=lambda: dict(DELAY_MS))
    """Modelled compute time: node -> topic or timer -> ms until its outputs are visible."""


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that can be set, in the order of the data flow."""

    rig: Rig = Rig()
    hull_radius_m: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.36
    """Sphere around the body's origin that holds the whole vehicle with its rotors."""
    sensors: SensorsConfig = SensorsConfig()
    estimation: EstimationConfig = EstimationConfig()
    mapping: MappingConfig = MappingConfig()
    planning: PlanningConfig = PlanningConfig()
    tracking: TrackingConfig = TrackingConfig()
    mission: MissionConfig = MissionConfig()
    safety: SafetyConfig = SafetyConfig()
    autopilot: AutopilotConfig = AutopilotConfig()
    lockstep: LockstepConfig = LockstepConfig()


def load_config(text: str, file: str) -> Config:
    """Read a YAML file of differences from the defaults; raises InputError with file and line."""
    return load_strict(text, Config, file=file)


def apply_overrides(config: Config, overrides: Sequence[str]) -> Config:
    """A copy with each `path.to.key=value` applied; raises InputError that names the path."""
    return apply_overrides_to(config, overrides)


def dump_config(config: Config) -> str:
    """The full YAML with comments; `load_config` of it gives an equal configuration."""
    return dump_struct(config)


__all__ = [
    "Config",
    "LockstepConfig",
    "apply_overrides",
    "apply_overrides_to",
    "dump_config",
    "dump_struct",
    "load_config",
]
