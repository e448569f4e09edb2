"""`companion config dump`: the whole configuration as YAML with comments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from companion.cli.flight_input import read_text
from companion.config import Config, apply_overrides, dump_config, load_config


def dump(
    config: Annotated[Path | None, typer.Option(help="Configuration YAML; holds only differences.")] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override, such as tracking.lookahead_s=0.5; repeatable."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False,
) -> None:
    """Print every setting with meaning, range and unit. Example: companion config dump > my.yaml"""
    base = load_config(read_text(config), file=str(config)) if config else Config()
    chosen = apply_overrides(base, set_ or [])
    typer.echo(msgspec.json.encode(chosen).decode() if as_json else dump_config(chosen), nl=as_json)
