"""The acceptance study: ten seeds in each forest. Minutes per flight, so: pytest -m slow tests/flights/test_study.py"""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
LONGLEAF = ROOT.parent / "shared" / "data" / "forest_stem_maps" / "longleaf.csv"
WORLDS = {
    "longleaf": f"stems:{LONGLEAF},branches=8",
    "poisson400": "poisson,stems_per_ha=400",
    "poisson800": "poisson,stems_per_ha=800",
}
MISSION = (ROOT / "missions" / "first_flight.yaml").read_text().split("\n", 3)[3]


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(10))
@pytest.mark.parametrize("world", WORLDS)
def test_a_survey_between_the_stems_comes_home(fly, world, seed):
    if world == "longleaf" and not LONGLEAF.exists():
        pytest.skip("the measured stem map is not here")
    flight = fly(MISSION, world=WORLDS[world], seed=seed, limit_s=400.0)
    s = flight.summary
    assert s.completed, s.reason
    assert s.contact == ""
    assert s.path_length_m >= 150
    assert s.min_clearance_m >= 0.3
    assert s.drift_percent <= 1.0
