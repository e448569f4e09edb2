"""The landmarks of a flight are in its map's file, and come out as they went in."""

import dataclasses

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.core.rig import Rig
from companion.mapping.association import TRUNK, Observations
from companion.mapping.landmark_node import LandmarkConfig, LandmarkNode
from companion.mapping.node import MappingConfig, MappingNode
from companion.runtime.map_file import FEATURES, features_of, read_map, save_map


def test_landmarks_are_saved_with_the_map_and_read_again(tmp_path):
    world, eye = MappingNode(MappingConfig(), Rig(), hull_radius_m=0.35), LandmarkNode(LandmarkConfig(), Rig())
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3)).astype(np.float32) * 5
    world.voxels.insert(points, R_odom_body=np.eye(3), p_odom=np.zeros(3), origin_odom=np.zeros(3))
    trees = Observations.of(rng.normal(size=(7, 3)) * 30, np.tile(np.eye(3) * 0.01, (7, 1, 1)), TRUNK)
    eye.features.observe(trees, stamp_ns=5)
    save_map(tmp_path / "a.umap", [eye, world])
    stored = read_map(tmp_path / "a.umap")
    assert features_of(stored).landmarks.tobytes() == eye.features.landmarks.tobytes()

    save_map(tmp_path / "b.umap", [world])
    bare = read_map(tmp_path / "b.umap")
    assert features_of(bare) is None
    np.testing.assert_array_equal(bare.log_odds, stored.log_odds)
    with pytest.raises(InputError, match="features"):
        features_of(dataclasses.replace(stored, sections={FEATURES: stored.sections[FEATURES][:-1]}))
