"""Certificates of the ground link on disk: `ca.crt`, and NAME.crt with NAME.key for each machine.

The authority's key, `ca.key`, belongs on neither the vehicle nor a ground station.
"""

from __future__ import annotations

import hashlib
import os
import ssl
import stat
from pathlib import Path
from typing import NamedTuple

from companion.core.errors import InputError

AUTHORITY = "ca"
_OTHERS = stat.S_IRWXG | stat.S_IRWXO


class Credentials(NamedTuple):
    """Three PEM files: who is trusted, who we are, and the key that proves it."""

    authority: Path
    certificate: Path
    key: Path


def find_credentials(place: Path, *, prefer: str = "") -> Credentials:
    """The credentials in a folder, or those called NAME for DIR/NAME.

    A folder must hold one pair beside the authority's, or one called `prefer`. Raises InputError
    that names the file that is missing or unsafe, or the pairs to choose from.
    """
    folder, name = (place, "") if place.is_dir() else (place.parent, place.name)
    if not folder.is_dir():
        raise InputError("is no folder of certificates", file=str(place), valid="DIR, or DIR/NAME for DIR/NAME.crt")
    name = name or _only(folder, prefer)
    found = Credentials(folder / f"{AUTHORITY}.crt", folder / f"{name}.crt", folder / f"{name}.key")
    for path in (found.authority, found.certificate):
        certificate_fingerprint(path)
    _check_key(found.key)
    return Credentials(*(path.resolve() for path in found))


def certificate_fingerprint(path: Path) -> str:
    """SHA-256 of a certificate, as `openssl x509 -fingerprint -sha256` writes it; InputError if it is none."""
    try:
        der = ssl.PEM_cert_to_DER_cert(path.read_text(encoding="ascii").strip())
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=str(path)) from error
    except ValueError as error:
        raise InputError("holds no certificate", file=str(path), valid="PEM") from error
    return hashlib.sha256(der).digest().hex(":").upper()


def names_in(folder: Path) -> list[str]:
    """Names of all pairs in a folder, the authority's left out."""
    return sorted(p.stem for p in folder.glob("*.crt") if p.stem != AUTHORITY and p.with_suffix(".key").exists())


def _only(folder: Path, prefer: str) -> str:
    names = names_in(folder)
    if prefer in names:
        return prefer
    if len(names) == 1:
        return names[0]
    if not names:
        raise InputError(
            f"holds no certificate with its key: make them with `companion keys ca {folder}` and "
            f"`companion keys cert {folder} NAME`",
            file=str(folder),
        )
    raise InputError("holds several certificates", file=str(folder), valid=", ".join(f"{folder}/{n}" for n in names))


def _check_key(path: Path) -> None:
    try:
        mode = os.stat(path).st_mode
        head = path.read_bytes()[:64]
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=str(path)) from error
    if mode & _OTHERS:
        raise InputError(
            f"can be used by others (mode {stat.S_IMODE(mode):04o}); run: chmod 600 {path}", file=str(path)
        )
    if not (head.startswith(b"-----BEGIN ") and b"PRIVATE KEY" in head):
        raise InputError("holds no private key", file=str(path), valid="PEM")
