"""`companion keys`: the key of MAVLink signing, and the certificates of the ground link."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import typer

from companion.core.errors import InputError
from companion.runtime.bus.certificate_files import certificate_fingerprint
from companion.runtime.bus.certificates import (
    AUTHORITY_DAYS,
    CERTIFICATE_DAYS,
    describe_certificate,
    make_authority,
    make_certificate,
)
from companion.runtime.ports.key_file import fingerprint, load_key, new_key

Force = Annotated[bool, typer.Option("--force", help="Replace what is there.")]


def new(
    file: Annotated[Path, typer.Argument(help="Where to write it; mode 0600.")],
    force: Annotated[bool, typer.Option("--force", help="Replace a key that is there.")] = False,
) -> None:
    """Write a new key: 32 random bytes in hex. Example: companion keys new ~/drone1.key"""
    key = new_key(file, force=force)
    typer.echo(f"{file}: new signing key, fingerprint {fingerprint(key)}")


def ca(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the certificates.")],
    days: Annotated[int, typer.Option(help="How long it holds.")] = AUTHORITY_DAYS,
    force: Force = False,
) -> None:
    """Make the authority that signs the certificates of a ground link. Example: companion keys ca certs

    DIR/ca.key can admit anyone: keep it off the vehicle and off the ground stations.
    """
    _tell(make_authority(folder, now=datetime.now(UTC), days=days, force=force))


def cert(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of `companion keys ca`.")],
    name: Annotated[str, typer.Argument(help="Of the machine: the vehicle's, or a ground station's.")],
    host: Annotated[
        list[str] | None,
        typer.Option(help="Address or name by which a vehicle is dialled; repeatable. Without: a ground station."),
    ] = None,
    days: Annotated[int, typer.Option(help="How long it holds.")] = CERTIFICATE_DAYS,
    force: Force = False,
) -> None:
    """Make a certificate and its key. Example: companion keys cert certs drone1 --host 192.168.1.7

    The machine gets DIR/ca.crt, DIR/NAME.crt and DIR/NAME.key, and nothing else.
    """
    _tell(make_certificate(folder, name, now=datetime.now(UTC), hosts=tuple(host or ()), days=days, force=force))


def show(
    file: Annotated[Path, typer.Argument(help="A key file, a certificate (.crt) or a folder of certificates.")],
) -> None:
    """Show fingerprints, to compare both sides; never a key. Example: companion keys show ~/drone1.key"""
    if file.is_dir():
        certificates = sorted(file.glob("*.crt"))
        if not certificates:
            raise InputError("holds no certificates (*.crt)", file=str(file))
        for certificate in certificates:
            _tell(certificate)
    elif file.suffix == ".crt":
        _tell(file)
    else:
        typer.echo(f"{file}: fingerprint {fingerprint(load_key(file))}")


def _tell(certificate: Path) -> None:
    mark = certificate_fingerprint(certificate)
    whose = describe_certificate(certificate)
    typer.echo(f"{certificate}: {whose + ', ' if whose else ''}fingerprint {mark}")
