"""Options of the ground link."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from companion.core.errors import InputError
from companion.runtime.bus.certificate_files import find_credentials
from companion.runtime.bus.ground import GroundSettings, ground_config

Certificates = Annotated[
    Path | None,
    typer.Option(
        help="Certificates for --ground: DIR (the vehicle's by its --name), or DIR/NAME; see `companion keys`."
    ),
]
Rates = Annotated[
    list[str] | None,
    typer.Option(help="Most messages per second on the ground link, such as cloud=0.5; 0 withholds; repeatable."),
]
Allowed = Annotated[
    list[str] | None,
    typer.Option(help="Topic that ground stations may publish; never one of the stack's own; repeatable."),
]


def ground_settings(
    endpoint: str, certs: Path | None, rates: Sequence[str], allowed: Sequence[str], *, bus: str, vehicle: str
) -> GroundSettings | None:
    """None without an endpoint; raises InputError that names the option which is wrong."""
    if not endpoint:
        if certs is not None or rates or allowed:
            raise InputError("says something about a ground link, but there is no --ground", field="--ground-*")
        return None
    if certs is None:
        raise InputError("a ground link needs certificates", field="--ground-certs", valid="folder of `companion keys`")
    settings = GroundSettings(
        endpoint=endpoint,
        credentials=find_credentials(certs, prefer=vehicle),
        rates_hz=dict(map(_rate, rates)),
        allowed=tuple(allowed),
    )
    ground_config(settings, bus=bus, vehicle=vehicle)  # what is wrong is told before anything starts
    return settings


def _rate(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise InputError(f"{text!r} is no rate", field="--ground-rate", valid="TOPIC=HZ") from None
