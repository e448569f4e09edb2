"""What of a log can be replayed: a node needs every message that it was fed, stored or computed again."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from companion.core.errors import InputError
from companion.core.node import Node
from companion.runtime.lockstep import name
from companion.runtime.log_file import Fed, Message, entries


def survey(path: Path) -> tuple[list[tuple[str, int]], dict[str, set[str]]]:
    """Every delivered message as (node, its number); source -> its topics that are not stored throughout."""
    uses: list[tuple[str, int]] = []
    unstored: dict[str, set[str]] = defaultdict(set)
    for entry in entries(path):
        if isinstance(entry, Fed) and entry.number >= 0:
            uses.append((entry.node, entry.number))
        elif isinstance(entry, Message) and entry.payload is None:
            unstored[entry.source].add(entry.topic)
    return uses, unstored


def blocked_nodes(nodes: Sequence[Node], unstored: dict[str, set[str]]) -> dict[str, tuple[str, str]]:
    """Node -> (topic, its source) for those that were fed what is not stored and nobody computes again."""
    blocked: dict[str, tuple[str, str]] = {}
    known = {name(n) for n in nodes}
    for _ in nodes:  # as often as the longest chain of nodes
        for node in nodes:
            for source, silent in unstored.items():
                missing = sorted(silent & node.handlers.keys())
                if missing and (source not in known or source in blocked):
                    blocked.setdefault(name(node), (missing[0], source))
    return blocked


def with_producers(only: str, nodes: Sequence[Node], unstored: dict[str, set[str]]) -> set[str]:
    """The node, and those that must be replayed to know what it was fed."""
    by_name = {name(n): n for n in nodes}
    if only not in by_name:
        raise InputError(f"{only!r} is no node of this log", field="--node", valid=", ".join(by_name))
    wanted, ahead = {only}, [only]
    while ahead:
        heard = by_name[ahead.pop()].handlers
        for source in by_name:
            if source not in wanted and unstored.get(source, set()) & heard.keys():
                wanted.add(source)
                ahead.append(source)
    return wanted
