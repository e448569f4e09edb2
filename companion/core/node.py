"""A node is a state machine without I/O: messages and ticks go in, messages come out.

A node never sees a socket, a thread, a file or a clock. Whoever runs it
(`companion.runtime`) brings the messages, tells the time and takes the outputs away, so
one node flies over a bus, steps in lockstep with the simulator and replays a recorded
flight unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, ClassVar, Generic, Literal, Protocol, TypeVar

M = TypeVar("M")
M_co = TypeVar("M_co", covariant=True)
N = TypeVar("N", bound="Node")

Keep = Literal["all", "latest"]
Service = Literal["control", "state", "bulk", "latched", "history"]


class Pending(Protocol[M_co]):
    """A message that is still being computed elsewhere; `result` waits for it."""

    def result(self) -> M_co:
        """The message, waiting for it if it must."""
        ...

    def ready(self) -> bool:
        """Whether `result` would not wait."""
        ...


@dataclass(frozen=True, slots=True)
class Output:
    """One message, or a promise of one, on its way out of a node."""

    topic: Topic[Any]
    message: Any
    delay_ns: int = 0  # a sensor's own latency: when it becomes visible, after now


@dataclass(frozen=True, slots=True)
class Topic(Generic[M]):
    """A named, typed channel; calling it wraps a message for publication.

    `rate_hz` is the expected rate (0: on change); a periodic topic is stale when it was
    silent for `deadline_s`. `keep` says whether a busy subscriber gets every message or
    only the newest; `recorded` whether the flight log stores it. `service` is how a bus treats
    it: `control` before all else, `state`, `bulk` behind the others, `latched` for late joiners,
    `history` for late joiners, too, but behind the others and, where `keep` is "all", more than the newest.
    `ros_type` is the standard ROS 2 type that carries it; if none fits without loss, our own.
    """

    name: str
    type: type[M]
    rate_hz: float
    keep: Keep = "latest"
    recorded: bool = True
    deadline_s: float | None = None
    service: Service = field(default="state", kw_only=True)
    ros_type: str = field(default="", kw_only=True)

    def __post_init__(self) -> None:
        if not self.ros_type:
            object.__setattr__(self, "ros_type", f"understory_msgs/msg/{self.type.__name__}")

    def __call__(self, message: M | Pending[M], *, delay_ns: int = 0) -> Output:
        """Wrap a message for publication."""
        return Output(self, message, delay_ns)


Outputs = Iterator[Output]  # what a handler yields; one that has nothing to say returns None
Handler = Callable[[N, M], Outputs | None]
Step = Callable[[N, int], Outputs | None]


def on(topic: Topic[M]) -> Callable[[Handler[N, M]], Handler[N, M]]:
    """Mark a method as the handler of `topic`."""

    def mark(handler: Handler[N, M]) -> Handler[N, M]:
        handler.topic = topic  # type: ignore[attr-defined]
        return handler

    return mark


def every(*, hz: float) -> Callable[[Step[N]], Step[N]]:
    """Mark a method as a periodic step; it receives the time in nanoseconds."""

    def mark(step: Step[N]) -> Step[N]:
        step.period_ns = round(1e9 / hz)  # type: ignore[attr-defined]
        return step

    return mark


class Node:
    """Base of all nodes; collects the marked methods of a subclass in definition order."""

    publishes: ClassVar[tuple[Topic[Any], ...]] = ()
    handlers: ClassVar[dict[str, str]]  # topic name -> method name
    subscribes: ClassVar[tuple[Topic[Any], ...]]
    timers: ClassVar[dict[str, int]]  # method name -> period, ns

    def __init_subclass__(cls) -> None:
        members = vars(cls).items()
        cls.subscribes = tuple(m.topic for _, m in members if hasattr(m, "topic"))
        cls.handlers = {m.topic.name: name for name, m in members if hasattr(m, "topic")}
        cls.timers = {name: m.period_ns for name, m in members if hasattr(m, "period_ns")}

    def handle(self, topic: Topic[Any], message: Any) -> Iterator[Output]:
        """Feed one message; yields what the node publishes because of it."""
        yield from getattr(self, self.handlers[topic.name])(message) or ()

    def tick(self, timer: str, now_ns: int) -> Iterator[Output]:
        """Run one periodic step; yields what the node publishes because of it."""
        yield from getattr(self, timer)(now_ns) or ()
