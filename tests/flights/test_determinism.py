"""Same seed, same bytes: across processes, hash seeds, and one or two cores."""

import json
import os
import subprocess
import sys

import pytest

MISSION = """
version: 1
name: hop
steps:
  - {do: takeoff, alt: 1.5}
  - {do: goto, at: [3, 0, 1.5]}
  - {do: land}
"""


def flight_hash(tmp_path, *, seed: int, hash_seed: str, cores: int) -> str:
    file = tmp_path / "hop.yaml"
    file.write_text(MISSION)
    out = tmp_path / f"{seed}-{hash_seed}-{cores}"
    command = [
        sys.executable, "-c", "from companion.cli.main import main; main()", "fly", str(file),
        "--world", "poisson", "--seed", str(seed), "--cores", str(cores), "--out", str(out), "--quiet",
    ]  # fmt: skip
    subprocess.run(command, check=True, env={**os.environ, "PYTHONHASHSEED": hash_seed}, timeout=600)
    return json.loads((out / "summary.json").read_text())["flight_hash"]


@pytest.fixture(scope="module")
def first(tmp_path_factory):
    return flight_hash(tmp_path_factory.mktemp("a"), seed=5, hash_seed="1", cores=1)


def test_the_same_seed_gives_the_same_bytes_in_another_process_and_on_two_cores(first, tmp_path):
    assert flight_hash(tmp_path, seed=5, hash_seed="2", cores=2) == first


def test_another_seed_gives_another_flight(first, tmp_path):
    assert flight_hash(tmp_path, seed=6, hash_seed="1", cores=1) != first
