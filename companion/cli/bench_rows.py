"""Where the rows of a benchmark go while it runs."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypeVar

import msgspec

from companion.cli.bus_options import say
from companion.core.errors import InputError

Row = TypeVar("Row", bound=msgspec.Struct)


def check_out(out: Path | None) -> None:
    """Raise InputError if `out` cannot be written, before the work begins."""
    if out is not None and not out.parent.is_dir():
        raise InputError("no such folder", field="--out", file=str(out.parent))


def written(rows: Iterable[Row], *, out: Path | None, plain: bool) -> Iterator[Row]:
    """The rows as they come: each a JSON line on standard output if `plain`, and all so far in `out`."""
    done: list[Row] = []
    for row in rows:
        done.append(row)
        if plain:
            say(msgspec.json.encode(row).decode())
        if out is not None:
            out.write_bytes(msgspec.json.Encoder().encode_lines(done))
        yield row
