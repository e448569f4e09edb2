"""The whole stack, flown: it arrives, keeps clearance and limits, and ends well when it cannot."""

import numpy as np
import pytest

HOP = """
defaults: {speed: 2.0}
steps:
  - {do: takeoff, alt: 2.0}
  - {do: goto, at: [10, 3, 2]}
  - {do: return_home, land: land}
"""


@pytest.fixture(scope="module")
def hop(fly):
    return fly(HOP, world="poisson", seed=1)


def test_it_arrives_comes_back_and_lands(hop):
    assert hop.summary.completed, hop.summary.reason
    p = np.array([m.p_world for m in hop.tracks.truth])
    assert np.linalg.norm(p[:, :2] - [10, 3], axis=1).min() < 0.7
    assert np.linalg.norm(p[-1, :2]) < 0.6
    assert not hop.tracks.truth[-1].armed


def test_it_keeps_clearance_and_knows_where_it_is(hop):
    assert hop.summary.contact == ""
    assert hop.summary.min_clearance_m >= 0.3
    assert hop.summary.position_rmse_m < 0.1
    assert hop.summary.drift_percent < 1.0


def test_it_holds_its_speed_limit(hop):
    assert hop.summary.max_speed_m_s < 2.0 * 1.1


def test_a_step_that_cannot_be_done_in_time_ends_in_a_landing(fly):
    flight = fly(
        """
steps:
  - {do: takeoff, alt: 2.0}
  - {do: goto, at: [40, 0, 2], timeout_s: 5, on_fail: {do: land_here}}
  - {do: land}
""",
        seed=2,
    )
    assert not flight.summary.completed
    assert "timeout" in flight.summary.reason or "time" in flight.summary.reason
    assert not flight.tracks.truth[-1].armed
    assert flight.summary.contact == ""


def test_a_goal_inside_a_trunk_does_not_keep_it_hovering(fly, stem_goal):
    x, y = stem_goal
    flight = fly(
        f"""
steps:
  - {{do: takeoff, alt: 2.0}}
  - {{do: goto, at: [{x:.2f}, {y:.2f}, 2], if_blocked: fail, timeout_s: 60, on_fail: {{do: land_here}}}}
  - {{do: land}}
""",
        seed=3,
    )
    assert not flight.summary.completed
    assert flight.summary.contact == ""
    assert not flight.tracks.truth[-1].armed


@pytest.fixture(scope="module")
def stem_goal():
    from sim.world import load_world

    stems = load_world("poisson", seed=3).stems
    near = np.hypot(stems.x, stems.y)
    k = int(np.argmin(np.where(near > 8, near, np.inf)))
    return float(stems.x[k]), float(stems.y[k])


CROSSED = """
kind: poisson
stems_per_ha: 200
branches: 4
walker_paths: [[[5, -6], [5, 6]]]
walker_height_m: 2.8
walker_speed_m_s: [1.2, 1.2]
"""


def test_where_somebody_walks_through_a_hovering_vehicle_it_steps_aside_and_comes_back(fly, tmp_path):
    """The walker passes the place every 10 s, at most; it is elsewhere when the vehicle comes.

    It passes again as the vehicle is to land, which waits.
    """
    world = tmp_path / "crossed.yaml"
    world.write_text(CROSSED)
    flight = fly(
        """
steps:
  - {do: takeoff, alt: 2.0}
  - {do: goto, at: [5, 0, 2], alt_ref: agl}
  - {do: hover, seconds: 14}
  - {do: land}
""",
        world=str(world),
        seed=0,
    )
    assert flight.summary.completed, flight.summary.reason
    assert flight.summary.min_clearance_m > 0.3
    p = np.array([m.p_world for m in flight.tracks.truth])
    there = np.linalg.norm(p[:, :2] - [5, 0], axis=1) < 0.5
    first, last = np.flatnonzero(there)[[0, -1]]
    assert np.linalg.norm(p[first:last, :2] - [5, 0], axis=1).max() > 0.8
