"""The key of MAVLink signing in a file: 32 bytes in hex, readable by its owner alone."""

from __future__ import annotations

import hashlib
import os
import secrets
import stat
from pathlib import Path
from typing import Final

from companion.core.errors import InputError

KEY_BYTES: Final = 32
_OTHERS: Final = stat.S_IRWXG | stat.S_IRWXO


def new_key(path: Path, *, force: bool = False) -> bytes:
    """Write a new random key with mode 0600 and return it; an old one is replaced only by `force`."""
    key = secrets.token_bytes(KEY_BYTES)
    try:
        if force:
            fresh = path.with_name(f".{path.name}.{os.getpid()}")
            _write(fresh, key.hex() + "\n")
            os.replace(fresh, path)
        else:
            _write(path, key.hex() + "\n")
    except FileExistsError as error:
        problem = "exists already; --force replaces it, and then the vehicle needs the new one"
        raise InputError(problem, file=str(path)) from error
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=str(path)) from error
    return key


def _write(path: Path, text: str) -> None:
    """A new file, never readable by others, not even for a moment, whatever the umask."""
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(descriptor, "w") as file:
        os.fchmod(file.fileno(), 0o600)
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def load_key(path: Path) -> bytes:
    """The key; InputError if others can read the file, or if it holds no key."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
        with os.fdopen(descriptor, encoding="utf-8", errors="replace") as file:
            _check_mode(path, os.fstat(file.fileno()).st_mode)
            text = file.read(4096).strip()
    except OSError as error:
        raise InputError(f"cannot be read: {error.strerror}", file=str(path)) from error
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != KEY_BYTES:
        raise InputError("holds no signing key", file=str(path), valid=f"{2 * KEY_BYTES} hex digits")
    return key


def _check_mode(path: Path, mode: int) -> None:
    if not stat.S_ISREG(mode):
        raise InputError("is no file", file=str(path))
    if mode & _OTHERS:
        problem = f"can be used by others (mode {stat.S_IMODE(mode):04o}); run: chmod 600 {path}"
        raise InputError(problem, file=str(path))


def fingerprint(key: bytes) -> str:
    """16 hex digits that two people may compare aloud; they tell nothing of the key."""
    return hashlib.sha256(b"companion signing key " + key).hexdigest()[:16]
