"""The logs in the folder of a flight, and the nodes that wrote them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice
from pathlib import Path

from companion.autopilot.node import AutopilotNode
from companion.config import Config, apply_overrides, load_config
from companion.core.errors import InputError
from companion.core.node import Node
from companion.mission.model import parse_mission
from companion.runtime.file_shelf import FileShelf
from companion.runtime.log_file import VERSION, Header, entries
from companion.stack import NODES, build


def logs_of(flight: Path) -> list[Path]:
    """`flight.log` of a flight in lockstep, or every `inbox-<group>.log` of a live one; or the file itself.

    Raises InputError if there is none.
    """
    if flight.is_file():
        return [flight]
    found = [flight / "flight.log"] if (flight / "flight.log").is_file() else sorted(flight.glob("inbox-*.log"))
    if not found:
        raise InputError("holds no log", file=str(flight), valid="a folder with flight.log or inbox-<group>.log")
    return found


def read_header(log: Path) -> Header:
    """What the nodes of a log are rebuilt from; raises InputError if it does not say."""
    first = next(islice(entries(log), 1), None)
    if not isinstance(first, Header):
        raise InputError("does not say which nodes wrote it", file=str(log), valid="a log of version 0.1.0 or newer")
    if first.version != VERSION:
        raise InputError(f"has format {first.version}", file=str(log), valid=f"format {VERSION}")
    return first


def rebuild(header: Header, overrides: Sequence[str] = (), *, signing_key: bytes | None = None) -> list[Node]:
    """Fresh nodes as at the beginning of the log; raises InputError for a wrong override.

    Of a flight whose link was signed, AutopilotNode is left out unless the key is given.
    """
    config: Config = apply_overrides(load_config(header.config, file="config of the log"), overrides)
    mission = parse_mission(header.mission, file="mission of the log")
    keyless = header.signed and signing_key is None
    kinds = [kind for kind in kinds_of(header) if not (keyless and kind is AutopilotNode)]
    return build(config, mission, seed=header.seed, only=kinds, signing_key=signing_key, shelf=FileShelf())


def kinds_of(header: Header) -> list[type[Node]]:
    """The nodes' classes, in the order of the data flow."""
    return [kind for kind in NODES if kind.__name__ in header.nodes]
