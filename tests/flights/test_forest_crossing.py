"""The closed loop study: 60 m of unknown forest, everything in the loop. Half a minute of CPU each: pytest -m slow."""

from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MISSION = (ROOT / "missions" / "dash.yaml").read_text().split("name: dash\n")[1]
SEEDS = 25  # in each forest: 50 flights at each speed
STEMS_PER_HA = {"one_in_25": 400, "one_in_16": 625}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.parametrize("forest", STEMS_PER_HA)
@pytest.mark.parametrize("speed", [3.0, 6.0])
def test_sixty_metres_of_unknown_forest_are_crossed(fly, speed, forest, seed):
    world = f"poisson,stems_per_ha={STEMS_PER_HA[forest]},branches=0,size_m=140"
    flight = fly(MISSION.replace("speed: 6.0", f"speed: {speed}"), world=world, seed=seed)
    s = flight.summary
    assert s.completed, s.reason
    assert s.contact == "" and s.min_clearance_m > 0.0
    assert s.path_length_m > 60.0
