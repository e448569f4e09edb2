"""`companion doctor`: what is installed, what is missing, what this machine can hold."""

from __future__ import annotations

import importlib.metadata
import os
import platform
import shutil
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import typer
from rich.console import Console
from rich.table import Table

State = Literal["ok", "warn", "missing"]
_LIBRARIES = (
    "numpy", "scipy", "numba", "gtsam", "libusb-package", "opencv-python-headless", "pymavlink",
    "fastcrc", "msgspec", "xxhash", "PyYAML", "typer", "rich", "matplotlib", "pillow",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Check:
    """One line of the report."""

    what: str
    found: str
    state: State
    fix: str = ""


def doctor(as_json: Annotated[bool, typer.Option("--json", help="Print JSON.")] = False) -> None:
    """Check Python, libraries and the machine. Example: companion doctor"""
    checks = [*_machine(), *(_library(name) for name in _LIBRARIES), _open3d()]
    if as_json:
        typer.echo(msgspec.json.encode([asdict(c) for c in checks]).decode())
    else:
        _print(checks)
    if any(c.state == "missing" for c in checks):
        raise typer.Exit(1)


def _machine() -> list[Check]:
    cores = os.cpu_count() or 1
    memory = _memory_gib()
    free_gib = shutil.disk_usage(Path.cwd()).free / 2**30
    python_ok: State = "ok" if sys.version_info >= (3, 11) else "missing"
    return [
        Check("Python", platform.python_version(), python_ok, "install Python 3.11 or newer"),
        Check("machine", f"{platform.system()} {platform.machine()}", "ok"),
        Check(
            "cores",
            str(cores),
            "ok" if cores > 1 else "warn",
            "lockstep flies at about half speed on one core",
        ),
        Check("memory", f"{memory:.1f} GiB", "ok" if memory >= 3 else "warn", "a flight needs about 2 GiB"),
        Check(
            "disk",
            f"{free_gib:.0f} GiB free",
            "ok" if free_gib >= 2 else "warn",
            "a flight log takes 10-100 MB",
        ),
        _cache(),
    ]


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30


def _cache() -> Check:
    """Numba keeps compiled kernels beside the sources; without that each start compiles anew."""
    folder = Path(__file__).resolve().parents[1] / "core"
    writable = os.access(folder, os.W_OK)
    fix = "set NUMBA_CACHE_DIR to a folder that you may write"
    return Check("kernel cache", "writable" if writable else "read-only", "ok" if writable else "warn", fix)


def _library(name: str) -> Check:
    try:
        return Check(name, importlib.metadata.version(name), "ok")
    except importlib.metadata.PackageNotFoundError:
        return Check(name, "not installed", "missing", f"pip install {name}")


def _open3d() -> Check:
    found = [c for c in (_library("open3d-cpu"), _library("open3d")) if c.state == "ok"]
    return found[0] if found else _library("open3d-cpu")


def _print(checks: list[Check]) -> None:
    table = Table("check", "found", "", "what to do", title="companion doctor", title_justify="left")
    marks = {"ok": "[green]ok[/]", "warn": "[yellow]note[/]", "missing": "[red]missing[/]"}
    for check in checks:
        table.add_row(check.what, check.found, marks[check.state], "" if check.state == "ok" else check.fix)
    Console().print(table)
