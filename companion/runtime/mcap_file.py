"""MCAP files that ROS 2, Foxglove, PlotJuggler and Rerun open: CDR messages with ros2msg schemas, lz4 chunks.

    with McapFile(path) as file:
        file.write("drone1/odom", "nav_msgs/msg/Odometry", schema, payload, log_ns=now_ns, publish_ns=stamp_ns)

The format: mcap.dev/spec, profile `ros2`.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import TracebackType

from mcap.exceptions import McapError
from mcap.records import Channel, Message, Schema
from mcap.stream_reader import CRCValidationError, StreamReader
from mcap.writer import CompressionType, Writer

import companion
from companion.core.errors import InputError
from companion.runtime.wire.qos import Qos

CHUNK_BYTES = 1 << 20
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


@dataclass(frozen=True, slots=True, kw_only=True)
class Sample:
    """One serialized message with all that a file must know of it."""

    topic: str  # bus name without leading slash, such as drone1/sensors/imu
    type: str  # ROS 2 name, such as sensor_msgs/msg/Imu
    schema: str  # ros2msg text: the definition and all that it needs
    payload: bytes  # CDR with its 4-byte head
    log_ns: int  # when it was heard
    publish_ns: int  # when it was sent
    qos: str = ""  # offered_qos_profiles as rosbag2 writes it; "": nothing said


class McapFile:
    """Writes one file; not thread-safe."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.messages = 0
        self._file = path.open("wb")
        self._writer = Writer(self._file, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)
        self._writer.start(profile="ros2", library=f"understory {companion.__version__}")
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, tuple[int, str]] = {}  # topic -> (channel, type)
        self._sequence: dict[int, int] = {}

    @property
    def bytes(self) -> int:
        """Size of the file so far, without the open chunk."""
        return self._file.tell()

    def write(self, sample: Sample) -> None:
        """Add one message; raises InputError if its topic carried another type before."""
        channel = self._channel(sample)
        self._sequence[channel] = sequence = self._sequence.get(channel, 0) + 1
        self._writer.add_message(channel, sample.log_ns, sample.payload, sample.publish_ns, sequence)
        self.messages += 1

    def flush(self) -> None:
        """End the open chunk and hand it to the system: it survives a kill of this process."""
        self._writer.flush()  # type: ignore[no-untyped-call]

    def close(self) -> None:
        """Write the summary, by which readers find their way, and close."""
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.close()

    def __enter__(self) -> McapFile:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def _channel(self, sample: Sample) -> int:
        if sample.topic not in self._channels:
            if sample.type not in self._schemas:
                schema = self._writer.register_schema(sample.type, "ros2msg", sample.schema.encode())
                self._schemas[sample.type] = schema
            metadata = {"offered_qos_profiles": sample.qos} if sample.qos else {}
            name = "/" + sample.topic
            channel = self._writer.register_channel(name, "cdr", self._schemas[sample.type], metadata)
            self._channels[sample.topic] = (channel, sample.type)
        channel, kind = self._channels[sample.topic]
        if kind != sample.type:
            raise InputError(f"carries {sample.type}", field=sample.topic, valid=f"{kind}, as before")
        return channel


def samples(path: Path) -> Iterator[Sample]:
    """Every message of a file in the order of the file, also of one whose writer was killed.

    Raises InputError if it is no MCAP file at all.
    """
    schemas: dict[int, Schema] = {}
    channels: dict[int, Channel] = {}
    with path.open("rb") as file:
        if file.read(8) != b"\x89MCAP0\r\n":
            raise InputError("is no MCAP file", file=str(path), valid="a file of `companion record`, or any other MCAP")
        file.seek(0)
        records = StreamReader(file, validate_crcs=True).records
        try:
            for record in records:
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, Message):
                    yield _sample(record, channels[record.channel_id], schemas)
        except (McapError, CRCValidationError, ValueError, RuntimeError, struct.error):
            return  # here the writer was killed, or the file was cut


def recover(path: Path, out: Path) -> int:
    """Copy what is whole of a file whose writer was killed, with a summary; returns the messages saved."""
    with McapFile(out) as file:
        for sample in samples(path):
            file.write(sample)
        return file.messages


@cache
def offered(qos: Qos) -> str:
    """`offered_qos_profiles` of a channel as rosbag2 reads it: YAML, of which JSON is a part."""
    profile = {
        "history": 2 if qos.keep_all else 1,
        "depth": qos.depth,
        "reliability": 1 if qos.reliable else 2,
        "durability": 1 if qos.transient_local else 2,
        "deadline": _FOREVER,
        "lifespan": _FOREVER,
        "liveliness": 1,
        "liveliness_lease_duration": _FOREVER,
        "avoid_ros_namespace_conventions": False,
    }
    return json.dumps([profile])


def _sample(message: Message, channel: Channel, schemas: dict[int, Schema]) -> Sample:
    schema = schemas[channel.schema_id]
    return Sample(
        topic=channel.topic.removeprefix("/"),
        type=schema.name,
        schema=schema.data.decode(),
        payload=message.data,
        log_ns=message.log_time,
        publish_ns=message.publish_time,
        qos=channel.metadata.get("offered_qos_profiles", ""),
    )
