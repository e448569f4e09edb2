"""Landmarks follow corrected poses: from a drifted flight to where they are, also in two steps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.geometry import exp_so3, quaternion_from_rotation
from companion.core.messages import PoseCorrections, freeze
from companion.mapping.association import TRUNK, Observations
from companion.mapping.feature_map import FeatureMap, FeatureMapConfig
from companion.mapping.landmark_correction import LandmarkCorrection

LOOKS = 12


def word(stamps_ns, poses):
    p, q = np.array([p for _, p in poses]), np.array([quaternion_from_rotation(R) for R, _ in poses])
    return freeze(PoseCorrections(stamp_ns=int(stamps_ns[-1]), stamps_ns=stamps_ns, p_odom=p, q_odom_body=q))


def flown(rng):
    """True poses, poses as believed (they drift; the newest is right), and a landmark beside each."""
    true = [(exp_so3(rng.normal(size=3) * 0.3), np.array([3.0 * k, rng.normal(), 2.0])) for k in range(LOOKS)]
    believed = []
    for k, (R, p) in enumerate(true):
        drift = (LOOKS - 1 - k) * np.array([0.02, 0.1, -0.03])
        believed.append((exp_so3(0.1 * drift) @ R, p + drift))
    beside = rng.normal(size=(LOOKS, 3)) * 2 + [0, 0, -2]
    places = [np.array([R @ b + p for (R, p), b in zip(poses, beside, strict=True)]) for poses in (true, believed)]
    return true, believed, *places


def mapped(believed, places):
    features, correction = FeatureMap(FeatureMapConfig()), LandmarkCorrection()
    spread = np.diag([0.01, 0.04, 0.09])
    for k, (R, p) in enumerate(believed):
        correction.looked(k * 1000, p, quaternion_from_rotation(R))
        features.add(Observations.of(places[k : k + 1], spread[None], TRUNK), np.array([True]), k * 1000)
    return features, correction


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None)
def test_landmarks_go_where_they_are_at_once_or_in_steps(seed):
    rng = np.random.default_rng(seed)
    true, believed, at, seen = flown(rng)
    stamps_ns = np.arange(LOOKS) * 1000
    features, correction = mapped(believed, seen)
    correction.apply(features, word(stamps_ns, true))
    np.testing.assert_allclose(features.landmarks["position_odom"], at, atol=1e-9)
    spread = np.linalg.eigvalsh(features.landmarks["covariance"])
    np.testing.assert_allclose(spread, np.tile([0.01, 0.04, 0.09], (LOOKS, 1)), atol=1e-12)

    stepwise, correction = mapped(believed, seen)
    half = [(exp_so3(rng.normal(size=3) * 0.02) @ R, p + rng.normal(size=3) * 0.2) for R, p in believed]
    correction.apply(stepwise, word(stamps_ns, half))
    correction.apply(stepwise, word(stamps_ns, true))
    np.testing.assert_allclose(stepwise.landmarks["position_odom"], at, atol=1e-9)


def test_what_is_seen_after_the_newest_corrected_pose_stays():
    true, believed, at, seen = flown(np.random.default_rng(1))
    features, correction = mapped(believed, seen)
    correction.apply(features, word(np.arange(4) * 1000, true[:4]))
    np.testing.assert_array_equal(features.landmarks["position_odom"][4:], seen[4:])
    moved = features.landmarks["position_odom"][:4] - seen[:4]
    assert np.linalg.norm(moved[3]) == pytest.approx(0.0, abs=1e-9)  # the newest of them does not move either
    assert (np.linalg.norm(moved[:3], axis=1) > 0.05).all()
    assert np.linalg.norm(at[0] - at[3]) == pytest.approx(
        np.linalg.norm(features.landmarks["position_odom"][0] - features.landmarks["position_odom"][3])
    )


def test_a_correction_that_is_none_moves_nothing():
    true, believed, _, seen = flown(np.random.default_rng(2))
    features, correction = mapped(believed, seen)
    before = features.to_bytes()
    correction.apply(features, word(np.zeros(LOOKS, np.int64), true))
    unit = PoseCorrections(
        stamp_ns=0, stamps_ns=np.array([0]), p_odom=np.full((1, 3), np.nan), q_odom_body=np.eye(4)[:1]
    )
    correction.apply(features, unit)
    assert (features.to_bytes(), correction.skipped) == (before, 2)
    early = LandmarkCorrection()
    early.apply(features, word(np.arange(LOOKS), true))
    assert (features.to_bytes(), early.skipped) == (before, 1)
