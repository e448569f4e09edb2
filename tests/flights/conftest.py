"""Flights as tests: a mission's text in, what came out of it back."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from companion.cli.fly import Request, fly_request
from companion.config import Config, apply_overrides
from companion.mission.model import parse_mission

Fly = Callable[..., SimpleNamespace]


@pytest.fixture(scope="module")
def fly(tmp_path_factory: pytest.TempPathFactory) -> Fly:
    def run(steps: str, *, world: str = "poisson", seed: int = 0, limit_s: float = 120.0, **options: str):
        out: Path = tmp_path_factory.mktemp("flight")
        file = out / "in.yaml"
        file.write_text(f"version: 1\nname: test\n{steps}")
        overrides = tuple(f"{k.replace('__', '.')}={v}" for k, v in options.items())
        request = Request(
            mission_file=file,
            mission=parse_mission(file.read_text(), file=str(file)),
            config=apply_overrides(Config(), [o for o in overrides if not o.startswith("sim.")]),
            overrides=overrides,
            world=world,
            seed=seed,
            out=out,
            workers=0,
            limit_s=limit_s,
            log_all=False,
        )
        outcome = fly_request(request, Console(quiet=True))
        return SimpleNamespace(summary=outcome.summary, out=out, tracks=outcome.tracks)

    return run
