"""A flight's logs as one MCAP file: our topics, and the standard ones that viewers understand.

export(Path("flights/demo"), Path("demo.mcap"))
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from companion.config import load_config
from companion.core import topics
from companion.core.node import Topic
from companion.core.rig import Rig
from companion.runtime.flight_folder import kinds_of, logs_of, read_header, rebuild
from companion.runtime.log_file import Header, Message
from companion.runtime.mcap_file import McapFile, Sample, offered
from companion.runtime.replay import Replay
from companion.runtime.viewer import TF_STATIC, View, sensor_frames, views_of
from companion.runtime.wire import WireType, codec_of, wire_type
from companion.runtime.wire.qos import Qos, qos_of

SHOWN = Qos(depth=10)
STATIC = Qos(transient_local=True, depth=1)  # so that `ros2 bag play` tells late joiners, too
Heard = tuple[int, str, Any]  # time, topic, message


@dataclass(slots=True)
class Exported:
    """What came of an export."""

    messages: int = 0
    unknown: dict[str, int] = field(default_factory=dict)  # topic -> messages that the log does not store


def export(flight: Path, out: Path, *, vehicle: str = "drone1", compute: bool = False, maps: bool = False) -> Exported:
    """Write every stored message of a flight with the viewers' topics into `out`.

    `compute` replays the flight, so that scans and maps that are not stored are there, too; `maps`
    also writes whole local maps (100 MB per flown second), not only their occupied cells.
    Raises InputError if there is no log, LogDamaged if it is damaged.
    """
    logs = [(log, read_header(log)) for log in logs_of(flight)]
    done = Exported()
    with McapFile(out) as file:
        writer = _Writer(file, vehicle, skipped=() if maps else (topics.LOCAL_MAP.name,), rig=_rig_of(logs[0][1]))
        for time_ns, name, message in heapq.merge(*_heard(logs, compute), key=lambda heard: heard[0]):
            if message is None:
                done.unknown[name] = done.unknown.get(name, 0) + 1
            else:
                writer.write(time_ns, topics.BY_NAME[name], message)
        done.messages = file.messages
    return done


def _rig_of(header: Header) -> Rig:
    return load_config(header.config, file="config of the log").rig


class _Writer:
    def __init__(self, file: McapFile, vehicle: str, *, skipped: Sequence[str], rig: Rig) -> None:
        self._file, self._vehicle, self._skipped, self._rig = file, vehicle, skipped, rig

    def write(self, time_ns: int, topic: Topic[Any], message: Any) -> None:
        if not self._file.messages:
            self._view(time_ns, time_ns, sensor_frames(self._rig))
        if topic.name not in self._skipped:
            codec = codec_of(topic)
            name, times = f"{self._vehicle}/{topic.name}", (time_ns, message.stamp_ns)
            self._put(name, codec.type, codec.encode(message), times, qos_of(topic))
        for view in views_of(topic, message):
            self._view(time_ns, message.stamp_ns, view)

    def _view(self, time_ns: int, stamp_ns: int, view: View) -> None:
        kind, qos = wire_type(view.where.type), STATIC if view.where is TF_STATIC else SHOWN
        self._put(
            view.where.full_name(self._vehicle).removeprefix("/"),
            kind,
            kind.encode(view.value),
            (time_ns, stamp_ns),
            qos,
        )

    def _put(self, topic: str, kind: WireType, payload: bytes, times: tuple[int, int], qos: Qos) -> None:
        log_ns, publish_ns = times
        self._file.write(
            Sample(
                topic=topic,
                type=kind.name,
                schema=kind.schema,
                payload=payload,
                log_ns=log_ns,
                publish_ns=publish_ns,
                qos=offered(qos),
            )
        )


def _heard(logs: Sequence[tuple[Path, Header]], compute: bool) -> list[Iterator[Heard]]:
    """Per log its messages, each topic's from its own process or else from the first that heard it."""
    own = {node for _, header in logs for node in header.nodes}
    taken: set[str] = {t for _, header in logs for t in _published(header)}
    streams: list[Iterator[Heard]] = []
    for log, header in logs:
        foreign = {t for kind in kinds_of(header) for t in kind.handlers} - taken if len(logs) > 1 else None
        taken |= foreign or set()
        streams.append(_log(log, header, own, foreign, compute))
    return streams


def _published(header: Header) -> set[str]:
    return {t.name for kind in kinds_of(header) for t in kind.publishes}


def _log(log: Path, header: Header, own: set[str], foreign: set[str] | None, compute: bool) -> Iterator[Heard]:
    ears = _Ears(own, foreign)
    # Without computing no node is replayed: the listener hears what is stored.
    replay = Replay(log, rebuild(header) if compute else [], listener=ears)
    for _ in replay.run():
        yield from ears.take()


class _Ears:
    def __init__(self, own: set[str], foreign: set[str] | None) -> None:
        self._own, self._foreign = own, foreign
        self._heard: list[Heard] = []

    def heard(self, entry: Message, message: Any) -> None:
        if entry.source in self._own or self._foreign is None or entry.topic in self._foreign:
            self._heard.append((entry.time_ns, entry.topic, message))

    def take(self) -> list[Heard]:
        heard, self._heard = self._heard, []
        return heard
