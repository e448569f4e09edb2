"""What a supervisor and its process groups say to each other: one JSON object per line.

Down a group's standard input goes first its `Assignment`, then words; its end means that the
supervisor is gone. Up its standard output come `Beat`s; its end means that the group is gone.
"""

from __future__ import annotations

from typing import Literal

import msgspec

Word = Literal["go", "land", "stop"]


class Assignment(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Everything that a process group must know to run."""

    group: str
    mission: str  # YAML text
    config: str  # YAML text, complete
    seed: int
    vehicle: str  # name on the bus
    bus: str  # endpoint of the router
    clock_offset_ns: int
    clock_speed: float = 1.0
    clock_since_ns: int = 0
    out: str  # folder of the flight
    link: str = ""  # MAVLink URL; for the group that flies
    key_file: str = ""  # signs the link
    resumed: bool = False  # started again in the air
    log: bool = True  # write what a replay needs


class NodeBeat(msgspec.Struct, frozen=True, kw_only=True):
    """How a node does; counts since its start."""

    name: str
    handled: int
    ticks: int
    late_ticks: int
    dropped: int
    refused: int
    waiting: int
    cpu_s: float
    busy_s: float  # with the event in hand; 0 if idle
    worst_late_s: float


class Beat(msgspec.Struct, frozen=True, kw_only=True):
    """A sign of life."""

    group: str
    state: Literal["warming", "ready", "running", "stopping"]
    stamp_ns: int
    cpu_s: float  # of the process
    memory_mb: float
    nodes: tuple[NodeBeat, ...] = ()
    figures: dict[str, float] = {}  # of the link and the bus
