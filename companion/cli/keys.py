"""`companion keys`: make and check the key of MAVLink signing."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from companion.runtime.ports.key_file import fingerprint, load_key, new_key


def new(
    file: Annotated[Path, typer.Argument(help="Where to write it; mode 0600.")],
    force: Annotated[bool, typer.Option("--force", help="Replace a key that is there.")] = False,
) -> None:
    """Write a new key: 32 random bytes in hex. Example: companion keys new ~/drone1.key"""
    key = new_key(file, force=force)
    typer.echo(f"{file}: new signing key, fingerprint {fingerprint(key)}")


def show(file: Annotated[Path, typer.Argument(help="A key file.")]) -> None:
    """Show a key's fingerprint, to compare both sides; never the key. Example: companion keys show ~/drone1.key"""
    typer.echo(f"{file}: fingerprint {fingerprint(load_key(file))}")
