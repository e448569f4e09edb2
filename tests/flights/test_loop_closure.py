"""A loop that closes in flight: the map and the goals move, what flies does not notice."""

import numpy as np
import pytest

from companion.core import topics
from companion.core.geometry import rotate
from companion.estimation.places.loops import LoopFinder
from companion.runtime.codec import decode
from companion.runtime.log_file import MESSAGE, read_log

DRIFT_M = np.array([0.3, 0.4, 0.0])  # that closures claim
STEP_NS = 20_000_000
LAP = """
defaults: {speed: 3.0, clearance: 0.3}
steps:
  - {do: takeoff, alt: 2.0}
  - {do: follow_path, points: [[12, 0, 2], [12, 9, 2], [0, 9, 2], [0, 0, 2], [8, 0, 2]]}
  - {do: return_home, land: land}
"""


@pytest.fixture(scope="module")
def closed(fly):
    """Odometry is right, so it is made to doubt itself, and closures to say that it drifts by `DRIFT_M` in a lap."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoopFinder, "_compare", _displaced(LoopFinder._compare))
        patch.setattr(LoopFinder, "_possible_m", lambda finder, closure: np.inf)
        patch.setattr(LoopFinder, "_step_sigmas", lambda finder, k, way_m: (0.15, 2e-3))
        return fly(LAP, world="poisson", seed=3)


def _displaced(compare):
    def displaced(finder, old, new):
        closure = compare(finder, old, new)
        if closure is not None:
            closure.p[:] += finder.keyframe_R_odom(closure.earlier).T @ DRIFT_M
        return closure

    return displaced


def test_the_map_follows_and_home_is_where_loops_say_that_the_start_was(closed):
    assert closed.summary.completed, closed.summary.reason
    assert closed.summary.contact == ""
    assert any(w.node == "mapping" and w.what.startswith("corrected the map") for w in closed.tracks.why)
    newest = said(closed, topics.MAP_FROM_ODOM)[-1]
    goal = [g for g in said(closed, topics.GOAL) if g.kind != "land"][-1]
    assert np.linalg.norm(newest.p_map_odom[:2]) > 0.4
    assert np.linalg.norm((rotate(newest.q_map_odom, goal.p_odom) + newest.p_map_odom)[:2]) < 0.05
    landed = closed.tracks.truth[-1].p_world  # by odometry, which is right, the start is at 0
    assert np.linalg.norm(landed[:2] + newest.p_map_odom[:2]) < 0.35


def test_no_setpoint_steps_when_a_loop_closes(closed):
    """5 cm, of position or of what the velocity makes of one period; velocity never changes faster than it may."""
    closures = [m.stamp_ns for m in said(closed, topics.MAP_FROM_ODOM) if m.closures]
    setpoints = said(closed, topics.SETPOINT)
    stamps_ns = np.array([s.stamp_ns for s in setpoints])
    for name, scale_s in (("p_odom", 1.0), ("v_odom", 1e-9 * STEP_NS)):
        step_m = scale_s * np.linalg.norm(np.diff([getattr(s, name) for s in setpoints], axis=0), axis=1)
        for closure_ns in closures:
            step_at = step_m[np.abs(stamps_ns[1:] - closure_ns) < 3e9]
            assert len(step_at) > 200
            assert np.nanmax(step_at, initial=0.0) <= 0.05


def said(flight, topic):
    """Every message of a topic in a flight's log."""
    entries = (e for e in read_log(flight.out / "flight.log") if e[0] == MESSAGE and e[3] == topic.name)
    return [decode(e[4], topic.type) for e in entries if e[4] is not None]
