"""The landmarks of the demo flight against the world that was flown: run with -m slow -s to see the figures."""

import json
from pathlib import Path

import numpy as np
import pytest

from companion.core.geometry import quaternion_from_yaw, rotate, yaw_of
from companion.mapping.association import TRUNK, VISUAL
from companion.runtime.map_file import features_of, read_map
from sim.world import load_world
from sim.world.stand import ROOT_M

DEMO = Path(__file__).resolve().parents[2] / "missions" / "first_flight.yaml"
SEEN_M = 9.0  # a stem that the vehicle passed nearer than this was in reach
SAME_M = 0.4


def figures(features, tracks, world):
    """Of all landmarks in `features` that were seen twice; the world's stems and ground are the truth."""
    seen = features.landmarks[features.landmarks["observations"] >= 2]
    at = in_world(seen["position_odom"], tracks)
    trunk, visual = at[seen["kind"] == TRUNK], at[seen["kind"] == VISUAL]
    stems = breast_height(world)
    flown = np.array([m.p_world[:2] for m in tracks.truth[::25]])
    reach = np.linalg.norm(stems[:, None, :2] - flown, axis=2).min(axis=1) < SEEN_M
    away = np.linalg.norm(trunk[:, None, :2] - stems[:, :2], axis=2)
    nearest, right = away.argmin(axis=1), away.min(axis=1) < SAME_M
    diameter = 2 * seen["radius_m"][seen["kind"] == TRUNK]
    below = visual[:, 2] - world.ground_z(visual[:, 0], visual[:, 1])
    return {
        "trunks": len(trunk),
        "trunk_precision": float(right.mean()),
        "trunk_recall": float(np.isin(np.flatnonzero(reach), nearest[right]).mean()),
        "trunk_doubles": int(right.sum() - len(np.unique(nearest[right]))),
        "trunk_xy_rms_m": rms(away.min(axis=1)[right]),
        "trunk_z_rms_m": rms(trunk[right, 2] - stems[nearest[right], 2]),
        "trunk_diameter_rms_m": rms(diameter[right] - world.stems.dbh_m[nearest[right]]),
        "visual": len(visual),
        "visual_height_rms_m": rms(below),
    }


def in_world(p_odom, tracks):
    """Aligned by yaw and position of the first estimate alone, as the flight's own figures are."""
    first = tracks.odometry[0]
    then = min(tracks.truth, key=lambda m: abs(m.stamp_ns - first.stamp_ns))
    q_turn = quaternion_from_yaw(yaw_of(then.q_world_body) - yaw_of(first.q_odom_body))
    return rotate(q_turn, p_odom - first.p_odom) + then.p_world


def breast_height(world):
    """Axes of the trunks 1.3 m above the ground, (N, 3)."""
    trunks = world.cones[world.kinds == 0]
    axis = trunks[:, :3] + (ROOT_M + 1.3) * trunks[:, 3:6]
    return np.column_stack([axis[:, :2], world.stems.z_ground + 1.3])


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.slow
def test_trunks_are_where_they_stand_and_keypoints_on_the_ground(fly):
    steps = DEMO.read_text().split("\n", 3)[3]  # without the comment, the version and the name
    flight = fly(steps, world="demo", limit_s=300.0)
    assert flight.summary.completed, flight.summary.reason
    world = load_world("demo", seed=0)
    found = figures(features_of(read_map(flight.out)), flight.tracks, world)
    found["cpu_ms_per_s"] = 1e3 * flight.summary.cpu_s["LandmarkNode"] / flight.summary.duration_s
    print(json.dumps({k: round(v, 4) for k, v in found.items()}))
    assert found["trunk_precision"] >= 0.97
    assert found["trunk_recall"] >= 0.97
    assert found["trunk_doubles"] <= 1
    assert found["trunk_xy_rms_m"] < 0.10
    assert found["trunk_z_rms_m"] < 0.15
    assert found["trunk_diameter_rms_m"] < 0.06
    assert found["visual"] > 600
    assert found["visual_height_rms_m"] < 0.12
