"""Flights as tests: a mission's text in, what came out of it back."""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import patch

import pytest
from numba.core.registry import CPUDispatcher
from rich.console import Console

from companion.cli.fly import Request, fly_request
from companion.config import Config, apply_overrides
from companion.mission.model import parse_mission
from companion.runtime.flight import Flight

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
        with kernels_ready_before_the_flight():
            outcome = fly_request(request, Console(quiet=True))
        return SimpleNamespace(summary=outcome.summary, out=out, tracks=outcome.tracks)

    return run


@contextmanager
def kernels_ready_before_the_flight() -> Iterator[None]:
    """Nothing compiles, or is read from the cache, once a flight has begun: the rehearsal comes first."""
    late: list[Counter[str]] = []
    run = Flight.run

    def watched(flight: Flight, *, limit_s: float):
        before = kernels()
        yield from run(flight, limit_s=limit_s)
        late.append(kernels() - before)

    with patch.object(Flight, "run", watched):
        yield
    assert late[-1] == Counter()


def kernels() -> Counter[str]:
    """How many signatures of each kernel of ours are compiled."""
    ours = (k for k in gc.get_objects() if isinstance(k, CPUDispatcher))
    named = ((f"{k.py_func.__module__}.{k.py_func.__name__}", len(k.signatures)) for k in ours)
    return Counter({name: count for name, count in named if name.startswith(("companion.", "sim."))})
