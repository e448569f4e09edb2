"""Reads what a flight is made of: mission and configuration files, overrides."""

from __future__ import annotations

from pathlib import Path

from companion.config import Config, apply_overrides, load_config
from companion.core.errors import InputError


def stack_config(file: Path | None, overrides: tuple[str, ...]) -> Config:
    """The stack's configuration; overrides of the simulator are left to it."""
    base = load_config(read_text(file), file=str(file)) if file else Config()
    return apply_overrides(base, [o for o in overrides if not o.startswith("sim.")])


def read_text(file: Path) -> str:
    """The text of a file; raises InputError that names it."""
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        why = "not UTF-8 text" if isinstance(error, UnicodeDecodeError) else error.strerror or "cannot be read"
        raise InputError(why, file=str(file), valid="a YAML text file") from error
