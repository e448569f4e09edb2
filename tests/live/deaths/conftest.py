"""What the deaths need: a flight."""

import importlib.util
import sys
from pathlib import Path

import pytest

_spec = importlib.util.spec_from_file_location("flying", Path(__file__).resolve().parents[1] / "flying.py")
flying = importlib.util.module_from_spec(_spec)
sys.modules["flying"] = flying
_spec.loader.exec_module(flying)


@pytest.fixture
def flight(tmp_path):
    with flying.Flight(tmp_path) as running:
        yield running


@pytest.fixture
def hover(tmp_path):
    """A flight that stays long enough to be looked at."""
    with flying.Flight(tmp_path, mission=flying.HOVER) as running:
        yield running


@pytest.fixture(scope="session", name="speed_of")
def _speed_of():
    return flying.speed_of


@pytest.fixture(scope="session", name="faults")
def _faults():
    return flying.middleman.Faults
