"""Every planner of the registry flies a mission when it is chosen."""

import pytest

from companion.planning.registry import PLANNERS

SHORT = """
defaults: {speed: 2.5, clearance: 0.4, agl: [1.0, 6.0]}
steps:
  - {do: takeoff, alt: 2.0}
  - {do: goto, at: [16, 5, 2], alt_ref: agl}
  - {do: return_home, land: land}
"""


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNERS)
def test_a_chosen_planner_flies(fly, name):
    flight = fly(SHORT, world="poisson", seed=3, planning__route__planner=name)
    assert flight.summary.completed, flight.summary.reason
    assert flight.summary.contact == "" and flight.summary.min_clearance_m >= 0.3
