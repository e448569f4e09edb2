"""One process of the live stack: `python -m companion.runtime.group`, started by the supervisor.

It ends in order when it is told to, when a node raises, and when its supervisor is gone.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import msgspec

from companion.config import Config, dump_config, load_config
from companion.core import topics
from companion.core.errors import CompanionError
from companion.core.messages import VehicleCommand
from companion.core.node import Node
from companion.mission.model import parse_mission
from companion.runtime.bus.attach import BusOutlet, Hearing
from companion.runtime.bus.graph import Graph
from companion.runtime.bus.scene import SceneOutlet
from companion.runtime.bus.session import open_session
from companion.runtime.clock import Clock
from companion.runtime.file_shelf import FileShelf
from companion.runtime.inbox import InboxLog, inbox_path
from companion.runtime.latency import HearingLog, Latency
from companion.runtime.live import InboxLog as Log
from companion.runtime.live import LiveGroup, LiveNode, Outlet
from companion.runtime.lockstep import name
from companion.runtime.log_file import Header
from companion.runtime.map_file import MAP_FILE, save_map
from companion.runtime.monitor import Monitor
from companion.runtime.no_log import NoLog
from companion.runtime.pipes import Assignment, Beat, NodeBeat, Word
from companion.runtime.ports.key_file import load_key
from companion.runtime.priority import run_first
from companion.runtime.pulse import Pulse
from companion.runtime.vehicle_link import VehicleLink
from companion.stack import GROUPS, build, warm

BEAT_S = 0.05
FIGURES_EVERY = 20  # beats
ALONE_S = 180.0  # at most so long does a group outlive its supervisor
SILENCE_NS = 5_000_000_000


def main() -> int:
    """Run the group that the first line of standard input assigns; exit code 0 if it ended in order."""
    up = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)  # whatever libraries print must not come between the beats
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole terminal: the supervisor decides
    words = lines_of(0)
    assignment = msgspec.json.decode(next(words), type=Assignment)
    if assignment.link:
        run_first()  # before any thread is there: they inherit it
    try:
        with ExitStack() as stack:
            return Process(assignment, words, up, stack).run()
    except CompanionError as error:
        print(f"{assignment.group}: {error}", file=sys.stderr)
        return error.exit_code


class Process:
    """The group with its session, its link and its beats."""

    def __init__(self, assignment: Assignment, words: Iterator[bytes], up: BinaryIO, stack: ExitStack) -> None:
        self._assignment, self._words, self._up = assignment, words, up
        a = assignment
        self._clock = Clock(a.clock_offset_ns, a.clock_speed, a.clock_since_ns)
        self._go, self._stop = threading.Event(), threading.Event()
        self._group: LiveGroup | None = None
        self._latency, self._watch = Latency(), Monitor()
        self._link: VehicleLink | None = None
        self._state = "warming"
        self._figures: list[Callable[[], dict[str, float]]] = []
        self._beats = 0
        threading.Thread(target=self._hear, name="hear", daemon=True).start()
        threading.Thread(target=self._beat, name="beat", daemon=True).start()
        signal.signal(signal.SIGTERM, lambda *_: self._end())
        self._nodes = self._build()
        self._open(stack)

    def run(self) -> int:
        """Wait for the word, run until told to stop or a node fails."""
        assert self._group is not None
        self._state = "ready"
        self._go.wait()
        self._state = "running"
        if not self._stop.is_set():
            self._group.start()
        while not self._stop.is_set() and not self._group.failed.is_set():
            self._stop.wait(BEAT_S)
            self._watch.look()
        self._state = "stopping"
        return self._finish(self._group)

    def _build(self) -> list[Node]:
        a = self._assignment
        config = load_config(a.config, file="config.yaml")
        if a.resumed:
            config = in_the_air(config)
        self._config = config
        key = load_key(Path(a.key_file)) if a.key_file else None
        mission = parse_mission(a.mission, file="mission.yaml")
        nodes = build(config, mission, seed=a.seed, only=GROUPS[a.group], signing_key=key, shelf=FileShelf())
        warm(config, nodes)
        return nodes

    def _open(self, stack: ExitStack) -> None:
        a = self._assignment
        session = stack.enter_context(open_session("peer", endpoint=a.bus))
        graph = stack.enter_context(Graph(session))
        bus = BusOutlet(graph, {name(node): node.publishes for node in self._nodes}, vehicle=a.vehicle)
        published = list({t.name: t for node in self._nodes for t in node.publishes}.values())
        scene = SceneOutlet(graph, published, name=f"{a.group}_scene", vehicle=a.vehicle)
        if a.link:
            scene.show_sensors(self._config.rig, self._clock.now_ns())
        pulse = Pulse()
        outlets: list[Outlet] = [bus, self._latency, pulse, scene]
        self._figures += [bus.figures, self._latency.figures, lambda: pulse.figures("published")]
        if a.link:
            self._link = stack.enter_context(VehicleLink(a.link, clock=self._clock))
            outlets.append(self._link)
            self._figures.append(self._link.figures)
        log = HearingLog(self._log(stack), self._latency)
        self._group = LiveGroup(self._nodes, clock=self._clock, log=log, outlets=outlets, shared=bool(a.link))
        hearing = Hearing(graph, self._group.wanted, self._group, listener=f"{a.group}_inbox", vehicle=a.vehicle)
        self._figures.append(hearing.figures)
        Hearing(graph, [topics.VEHICLE], self._watch, listener=f"{a.group}_watch", vehicle=a.vehicle)
        if self._link is not None:
            self._link.deliver_to(self._group)

    def _log(self, stack: ExitStack) -> Log:
        a = self._assignment
        if not a.log:
            return NoLog()
        header = Header(
            group=a.group,
            nodes=tuple(name(node) for node in self._nodes),
            seed=a.seed,
            mission=a.mission,
            config=dump_config(self._config),
            signed=bool(a.key_file),
            epoch_ns=a.clock_offset_ns,
        )
        return stack.enter_context(closing(InboxLog(inbox_path(Path(a.out), a.group), header)))

    def _finish(self, group: LiveGroup) -> int:
        hanging = group.stop()
        if group.failure is not None:
            node, error = group.failure
            print(f"{node} raised:", file=sys.stderr)
            traceback.print_exception(error, file=sys.stderr)
            return 1
        if hanging:
            print(f"still busy at the end: {', '.join(hanging)}", file=sys.stderr)
        else:
            save_map(Path(self._assignment.out) / MAP_FILE, self._nodes)
        return 0

    def _hear(self) -> None:
        for line in self._words:
            word = msgspec.json.decode(line, type=Word)
            if word == "go":
                self._go.set()
            elif word == "land":
                self._land()
            else:
                break
        else:
            self._land_alone()
        self._end()

    def _land(self) -> None:
        if self._group is not None:
            command = VehicleCommand(stamp_ns=self._clock.now_ns(), kind="land")
            self._group.receive(topics.VEHICLE_COMMAND, command)

    def _land_alone(self) -> None:
        """The supervisor is gone: down with the vehicle while all nodes still run, then end."""
        until_s = time.monotonic() + ALONE_S
        if self._group is None or self._state != "running":
            return
        if self._link is not None:
            self._land()
        while time.monotonic() < until_s and self._flies():
            time.sleep(BEAT_S)

    def _flies(self) -> bool:
        """By the newest word of the control group; its silence means that nobody flies any more."""
        vehicle = self._watch.vehicle
        heard = vehicle is not None and self._clock.now_ns() - vehicle.stamp_ns < SILENCE_NS
        return heard and self._watch.airborne

    def _end(self) -> None:
        self._stop.set()
        self._go.set()

    def _beat(self) -> None:
        pause = threading.Event()
        while True:
            try:
                self._up.write(msgspec.json.encode(self._sign_of_life()) + b"\n")
            except OSError:
                return  # the supervisor is gone: its end of the other pipe says so, too
            pause.wait(BEAT_S)

    def _sign_of_life(self) -> Beat:
        usage, now_ns = resource.getrusage(resource.RUSAGE_SELF), self._clock.now_ns()
        group = self._group
        self._beats += 1
        figures: dict[str, float] = {}
        if self._state == "running" and self._beats % FIGURES_EVERY == 0:
            for more in self._figures:
                figures |= more()
        return Beat(
            group=self._assignment.group,
            state=self._state,  # type: ignore[arg-type]
            stamp_ns=now_ns,
            cpu_s=usage.ru_utime + usage.ru_stime,
            memory_mb=usage.ru_maxrss / 1024,
            nodes=tuple(_beat_of(seat, now_ns) for seat in group.seats) if group else (),
            figures=figures,
        )


def lines_of(descriptor: int) -> Iterator[bytes]:
    """Lines of a pipe, read without a buffer object: its lock would outlive a thread that is still reading."""
    rest = b""
    while data := os.read(descriptor, 65536):
        *lines, rest = (rest + data).split(b"\n")
        yield from lines


def in_the_air(config: Config) -> Config:
    """The map begins in flight: the vehicle came here through known-free space, but of what is above nobody knows."""
    mapping = msgspec.structs.replace(config.mapping, start_free_height_m=0.0)
    return msgspec.structs.replace(config, mapping=mapping)


def _beat_of(seat: LiveNode, now_ns: int) -> NodeBeat:
    s = replace(seat.statistics)
    return NodeBeat(
        name=seat.name,
        handled=s.handled,
        ticks=s.ticks,
        late_ticks=s.late_ticks,
        dropped=seat.mailbox.dropped,
        refused=s.refused,
        waiting=len(seat.mailbox),
        cpu_s=s.cpu_s,
        busy_s=(now_ns - s.busy_since_ns) * 1e-9 if s.busy_since_ns else 0.0,
        worst_late_s=s.worst_late_ns * 1e-9,
    )


if __name__ == "__main__":
    sys.exit(main())
