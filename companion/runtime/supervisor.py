"""Starts the process groups of a flight, watches them, restarts what may be restarted, ends them in order.

supervisor = Supervisor(assignments, health=publish)
supervisor.start(on_wait=print)     # all groups are warm, then all go
while flying: supervisor.watch()    # at 20 Hz or more
supervisor.stop()
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import msgspec

from companion.core.errors import CompanionError
from companion.core.messages import NodeHealth
from companion.core.node import Node
from companion.runtime.child import Child
from companion.runtime.clock import Clock
from companion.runtime.diagnostics import GroupReport
from companion.runtime.pipes import Assignment
from companion.stack import GROUPS

SILENT_S: Final = 0.5  # without a beat: its nodes count as down
KILL_S: Final = 5.0  # without a beat: it is ended, and started again if it may
READY_S: Final = 180.0  # a first start compiles kernels
STOP_S: Final = 4.0
BACK_OFF_S: Final = (0.0, 0.5, 1.0, 2.0, 4.0)  # before the next start; no more starts after the last
STOP_ORDER: Final = ("control", "world", "graph", "perception", "recorder")


class GroupError(CompanionError):
    """A group cannot run; its log says why. A wrong input or a taken link there is one here."""

    def __init__(self, what: str, group_code: int | None = None) -> None:
        super().__init__(what)
        self.exit_code = group_code if group_code in (2, 3) else 1


@dataclass(slots=True)
class _Seat:
    child: Child
    restarts: int = 0
    down: str = ""  # why its nodes count as down
    due_s: float | None = None  # of the next start
    killed: bool = False


class Supervisor:
    """`health` takes every change of a node's health; `airborne` tells whether the vehicle flies."""

    def __init__(
        self,
        assignments: Sequence[Assignment],
        *,
        clock: Clock,
        health: Callable[[NodeHealth], None],
        airborne: Callable[[], bool],
    ) -> None:
        self._assignments, self._clock = assignments, clock
        self._health, self._airborne = health, airborne
        self._seats: dict[str, _Seat] = {}
        self.events: list[str] = []

    @property
    def children(self) -> list[Child]:
        """Every group's present process."""
        return [seat.child for seat in self._seats.values()]

    @property
    def restarts(self) -> dict[str, int]:
        """Starts beyond the first, per group."""
        return {name: seat.restarts for name, seat in self._seats.items()}

    def reports(self) -> list[GroupReport]:
        """How every group does now."""
        return [
            GroupReport(
                group=name,
                pid=seat.child.pid,
                restarts=seat.restarts,
                down=seat.down,
                beat=seat.child.beat,
                figures=seat.child.figures,
                figures_ns=seat.child.figures_ns,
            )
            for name, seat in self._seats.items()
        ]

    def start(self) -> None:
        """Spawn every group; let all go when all are warm. Raises GroupError if one ends or does not get ready."""
        for assignment in self._assignments:
            self._seats[assignment.group] = _Seat(Child(assignment))
        self._await_ready()
        for child in self.children:
            child.say("go")

    def watch(self) -> str:
        """Look at every group once; returns why the flight is lost, or ''."""
        for name, seat in self._seats.items():
            if seat.child.exit_code is not None:
                lost = self._dead(name, seat)
                if lost:
                    return lost
            else:
                self._alive(seat)
        return ""

    def land(self) -> None:
        """Have the vehicle land where it is."""
        self._seats["control"].child.say("land")

    def stop(self) -> list[str]:
        """End every group in the order of the flow against the current; returns those that had to be killed."""
        order = sorted(self._seats, key=STOP_ORDER.index)
        return [name for name in order if not self._end(self._seats[name].child)]

    def _await_ready(self) -> None:
        until_s = time.monotonic() + READY_S
        while any(child.state != "ready" for child in self.children):
            for child in self.children:
                if child.state == "dead":
                    raise GroupError(f"{child.name} could not start: {child.last_words()}", child.exit_code)
            if time.monotonic() > until_s:
                names = ", ".join(c.name for c in self.children if c.state != "ready")
                raise GroupError(f"not ready after {READY_S:g} s: {names}")
            time.sleep(0.02)

    def _alive(self, seat: _Seat) -> None:
        child = seat.child
        if child.state == "ready" and seat.restarts:
            child.say("go")
        silent_s = child.silent_s
        if child.state in ("starting", "warming", "ready"):
            return
        if silent_s > KILL_S and not seat.killed:
            seat.killed = True
            self._note(f"{child.name} was silent for {silent_s:.1f} s: killed")
            child.kill()
        elif silent_s > SILENT_S:
            self._set_down(seat, f"silent for {silent_s:.1f} s")
        else:
            self._set_down(seat, "")

    def _dead(self, name: str, seat: _Seat) -> str:
        if seat.due_s is None:
            seat.child.wait(1.0)
            reason = f"ended with code {seat.child.exit_code}"
            self._note(f"{name} {reason}: {seat.child.last_words()}")
            self._set_down(seat, reason)
            lost = self._why_not_again(name, seat)
            if lost:
                return lost
            seat.due_s = time.monotonic() + self._pause_s(name, seat)
        if time.monotonic() >= seat.due_s:
            seat.restarts, seat.due_s, seat.killed = seat.restarts + 1, None, False
            assignment = seat.child.assignment
            seat.child = Child(_again(assignment, airborne=self._airborne()))
            self._note(f"{name} starts again")
        return ""

    def _why_not_again(self, name: str, seat: _Seat) -> str:
        """Why the flight cannot go on without the group, or ''."""
        if name == "control":
            return "the control group died: the autopilot's own failsafe has the vehicle"
        if seat.restarts >= len(BACK_OFF_S):
            return f"{name} died {seat.restarts + 1} times"
        return ""

    def _pause_s(self, name: str, seat: _Seat) -> float:
        if name == "perception" and self._airborne():
            self._note("perception is not started in the air: its odometry would begin anew")
            return math.inf
        return BACK_OFF_S[seat.restarts]

    def _set_down(self, seat: _Seat, reason: str) -> None:
        if bool(reason) == bool(seat.down):
            return
        seat.down = reason
        if reason:
            self._note(f"{seat.child.name} is down: {reason}")
        for kind in nodes_of(seat.child.name):
            stamp_ns = self._clock.now_ns()
            self._health(NodeHealth(stamp_ns=stamp_ns, node=kind.__name__, alive=not reason, reason=reason))

    def _end(self, child: Child) -> bool:
        child.say("stop")
        if child.wait(STOP_S):
            return True
        child.kill()
        child.wait(STOP_S)
        return False

    def _note(self, event: str) -> None:
        self.events.append(event)


def nodes_of(group: str) -> tuple[type[Node], ...]:
    """The classes of a group's nodes; none for the recorder."""
    return GROUPS.get(group, ())


def _again(assignment: Assignment, *, airborne: bool) -> Assignment:
    return msgspec.structs.replace(assignment, resumed=airborne)
