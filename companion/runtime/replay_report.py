"""What a replay found: differences, and the figures of each node."""

from __future__ import annotations

from dataclasses import dataclass, field

from companion.runtime.message_diff import TopicDifferences


@dataclass(frozen=True, slots=True)
class Difference:
    """One output that is not the logged one."""

    node: str
    topic: str
    time_ns: int  # of the entry in the log
    stamp_ns: int  # of the message; -1 if nobody knows it
    what: tuple[str, ...]

    @property
    def place(self) -> str:
        """Node, topic, stamp, and the time in the log."""
        stamp = f"stamp {self.stamp_ns}" if self.stamp_ns >= 0 else "stamp unknown"
        return f"{self.node}, {self.topic}, {stamp}, at {self.time_ns * 1e-9:.6f} s"

    def __str__(self) -> str:
        return f"{self.place}: {'; '.join(self.what)}"


@dataclass(slots=True)
class NodeReport:
    """What the replay of one node came to."""

    deliveries: int = 0
    outputs: int = 0  # compared with the log
    differing: int = 0
    first: Difference | None = None
    changed: dict[str, TopicDifferences] = field(default_factory=dict)  # of the twin, per topic
    first_changed: Difference | None = None

    def differs(self, difference: Difference) -> None:
        """Count one; keep the first."""
        self.differing += 1
        self.first = self.first or difference
