"""The feature map: fusion is least squares, association is the best one-to-one, bytes come back or are refused."""

import itertools
import zlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from companion.core.errors import InputError
from companion.mapping.association import AMBIGUOUS, NEW, TRUNK, VISUAL, AssociationConfig, Observations
from companion.mapping.feature_map import FeatureMap, FeatureMapConfig

ROUND = np.eye(3) * 0.01  # sigma 0.1 m


def random_covariances(rng, count):
    """Between 1 cm and 1 m in any direction."""
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    spread = np.exp(rng.uniform(np.log(1e-4), 0.0, (count, 3)))
    product = (turn * spread[:, None]) @ turn.transpose(0, 2, 1)
    return (product + product.transpose(0, 2, 1)) / 2


def trunks(xyz, covariance=ROUND):
    xyz = np.asarray(xyz, float).reshape(-1, 3)
    return Observations.of(xyz, np.broadcast_to(covariance, (len(xyz), 3, 3)), TRUNK)


def visual(xyz, descriptor, covariance=ROUND):
    xyz = np.asarray(xyz, float).reshape(-1, 3)
    return Observations.of(xyz, np.broadcast_to(covariance, (len(xyz), 3, 3)), VISUAL, descriptor=descriptor)


def map_of(seen, **config):
    features = FeatureMap(FeatureMapConfig(**config))
    features.add(seen, np.ones(len(seen), bool), stamp_ns=0)
    return features


def random_map(seed, count=30):
    rng = np.random.default_rng(seed)
    seen = visual(rng.normal(size=(count, 3)) * 20, rng.integers(0, 256, (count, 32), np.uint8))
    features = map_of(seen)
    features.observe(trunks(rng.normal(size=(5, 3)) * 20), stamp_ns=7)
    features.observe(Observations.of(np.array([[90.0, 0, 0]]), ROUND[None], TRUNK, radius_m=np.array([0.2])), 9)
    return features


# --- fusion ---------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), looks=st.integers(2, 12))
@settings(max_examples=40, deadline=None)
def test_fusion_is_least_squares_over_all_looks_and_only_gains(seed, looks):
    rng = np.random.default_rng(seed)
    R = random_covariances(rng, looks)
    z = rng.normal(size=(looks, 3)) * 5
    features = map_of(Observations.of(z[:1], R[:1], TRUNK))
    for k in range(1, looks):
        before = features.landmarks["covariance"][0].copy()
        features.update(Observations.of(z[k : k + 1], R[k : k + 1], TRUNK), np.array([0]), stamp_ns=k)
        gain = np.linalg.eigvalsh(before - features.landmarks["covariance"][0])
        assert gain[0] > -1e-12 and gain[2] > 0.0
    # batch: stacked whitened rows, solved by QR
    roots = np.linalg.cholesky(np.linalg.inv(R)).transpose(0, 2, 1)
    A, b = roots.reshape(-1, 3), np.einsum("kij,kj->ki", roots, z).ravel()
    np.testing.assert_allclose(features.landmarks["position_odom"][0], np.linalg.lstsq(A, b)[0], atol=1e-8)
    np.testing.assert_allclose(features.landmarks["covariance"][0], np.linalg.inv(A.T @ A), rtol=1e-6, atol=1e-12)
    assert features.landmarks["observations"][0] == looks


def test_fused_errors_have_the_covariance_that_is_said():
    """Mean squared Mahalanobis error of 500 landmarks seen four times is that of chi2, 3 degrees of freedom."""
    rng = np.random.default_rng(1)
    count = 500
    truth, R = rng.normal(size=(count, 3)) * 100, random_covariances(rng, count)
    root = np.linalg.cholesky(R)

    def look():
        return Observations.of(truth + np.einsum("nij,nj->ni", root, rng.normal(size=(count, 3))), R, TRUNK)

    features = map_of(look())
    for k in range(3):
        features.update(look(), np.arange(count), stamp_ns=k)
    np.testing.assert_allclose(features.landmarks["covariance"], R / 4, rtol=1e-6, atol=1e-12)
    d = features.landmarks["position_odom"] - truth
    squared = np.einsum("ni,nij,nj->n", d, np.linalg.inv(features.landmarks["covariance"]), d)
    low, high = chi2.ppf([0.001, 0.999], 3 * count) / count
    assert low < squared.mean() < high


def test_radii_are_averaged_and_a_missing_one_changes_nothing():
    def seen(radius_m):
        return Observations.of(np.zeros((1, 3)), ROUND[None], TRUNK, radius_m=np.array([radius_m]))

    features = map_of(seen(np.nan))
    for radius_m in (0.10, 0.16, np.nan):
        features.update(seen(radius_m), np.array([0]), stamp_ns=1)
    expected = 0.10 + (0.16 - 0.10) / 3  # the landmark has been seen three times when the second radius comes
    np.testing.assert_allclose(features.landmarks["radius_m"], [expected])


def test_a_row_may_be_named_once():
    features = map_of(trunks([[0, 0, 0], [5, 0, 0]]))
    twice = trunks([[0, 0, 0], [0.1, 0, 0]])
    for rows in ([0, 0], [0, 2], [0]):
        with pytest.raises(InputError, match="rows"):
            features.update(twice, np.array(rows), stamp_ns=1)
    assert features.landmarks["observations"].tolist() == [1, 1]


# --- association ------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["gated", "nearest"])
@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_well_separated_landmarks_are_found_in_any_order(method, seed):
    rng = np.random.default_rng(seed)
    places = np.array(list(itertools.product(range(4), range(4), range(2))), float) * 3.0
    features = map_of(trunks(places), association=AssociationConfig(method=method))
    chosen = rng.permutation(len(places))[:20]
    noisy = places[chosen] + rng.uniform(-0.1, 0.1, (20, 3))
    far = rng.uniform(100, 200, (3, 3))
    rows = features.associate(trunks(np.concatenate([noisy, far])))
    assert rows.tolist() == [*chosen.tolist(), NEW, NEW, NEW]


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_assignment_is_the_cheapest_of_all(seed):
    """Against all one-to-one assignments of up to 4 observations to 4 landmarks, each also to none."""
    rng = np.random.default_rng(seed)
    config = AssociationConfig(ambiguity=0.0)
    n, m = rng.integers(1, 5, 2)
    known, seen = trunks(rng.uniform(0, 0.6, (n, 3))), trunks(rng.uniform(0, 0.6, (m, 3)))
    found = map_of(known, association=config).associate(seen)
    d = seen.position_odom[:, None] - known.position_odom
    cost = (d * d).sum(axis=2) / 0.02
    cost = np.where(cost <= config.chi2_gate, cost + 3 * np.log(2.0), np.inf)  # S = 2 R: ln |S| / |R|
    none = config.chi2_gate + 3 * np.log(2.0) + config.hamming_weight * config.hamming_gate

    def total(rows):
        return sum(none if row == NEW else cost[i, row] for i, row in enumerate(rows))

    best = np.inf
    for rows in itertools.product(range(NEW, n), repeat=m):
        taken = [row for row in rows if row != NEW]
        if len(set(taken)) == len(taken):
            best = min(best, total(rows))
    taken = found[found != NEW]
    assert len(set(taken.tolist())) == len(taken)
    assert total(found) == pytest.approx(best)


def test_one_observation_between_two_landmarks_is_ambiguous():
    features = map_of(trunks([[0, 0, 0], [0.4, 0, 0]]))
    assert features.associate(trunks([0.2, 0, 0])).tolist() == [AMBIGUOUS]
    assert features.associate(trunks([0.21, 0.1, 0])).tolist() == [AMBIGUOUS]
    assert features.associate(trunks([0.05, 0, 0])).tolist() == [0]
    before = features.to_bytes()
    features.observe(trunks([0.2, 0, 0]), stamp_ns=5)
    assert features.to_bytes() == before  # neither spoiled nor doubled


def test_two_observations_of_one_landmark_are_ambiguous():
    features = map_of(trunks([0, 0, 0]))
    assert features.associate(trunks([[0.05, 0, 0], [-0.05, 0, 0]])).tolist() == [AMBIGUOUS, AMBIGUOUS]
    assert features.associate(trunks([[0.05, 0, 0], [0.25, 0, 0]])).tolist() == [0, NEW]


def test_a_pair_that_moved_together_is_matched_as_a_pair():
    """The nearest landmark of the first is the wrong one: only the joint assignment is right."""
    features = map_of(trunks([[0, 0, 0], [0.5, 0, 0]]))
    shifted = trunks([[0.3, 0, 0], [0.8, 0, 0]])
    assert features.associate(shifted).tolist() == [0, 1]
    nearest = map_of(trunks([[0, 0, 0], [0.5, 0, 0]]), association=AssociationConfig(method="nearest"))
    assert nearest.associate(shifted).tolist() == [1, NEW]


def test_two_that_could_as_well_be_swapped_are_ambiguous():
    features = map_of(trunks([[0, 0, 0], [0.2, 0, 0]]))
    across = trunks([[0.1, 0.1, 0], [0.1, -0.1, 0]])
    assert features.associate(across).tolist() == [AMBIGUOUS, AMBIGUOUS]


def test_descriptors_tell_apart_what_places_cannot():
    rng = np.random.default_rng(0)
    bits = rng.integers(0, 256, (2, 32), np.uint8)
    features = map_of(visual([[0, 0, 0], [0.1, 0, 0]], bits))
    swapped = bits[::-1].copy()
    swapped[:, 0] ^= 0b101  # two bits flip
    assert features.associate(visual([[0, 0, 0], [0.1, 0, 0]], swapped)).tolist() == [1, 0]
    assert features.associate(visual([0, 0, 0], ~bits[:1])).tolist() == [NEW]


def test_the_gates_are_where_they_are_said_to_be():
    config = AssociationConfig(chi2_gate=9.0, hamming_gate=10)
    bits = np.zeros((1, 32), np.uint8)
    features = map_of(visual([0, 0, 0], bits), association=config)
    edge = 3.0 * np.sqrt(0.02)  # S = P + R
    assert features.associate(visual([edge - 1e-6, 0, 0], bits)).tolist() == [0]
    assert features.associate(visual([edge + 1e-6, 0, 0], bits)).tolist() == [NEW]
    for flips, row in ((10, 0), (11, NEW)):
        other = np.packbits(np.arange(256) < flips)[None]
        assert features.associate(visual([0, 0, 0], other)).tolist() == [row]


@pytest.mark.parametrize("method", ["gated", "nearest"])
def test_a_trunk_is_no_picture_of_itself(method):
    features = map_of(trunks([0, 0, 0]), association=AssociationConfig(method=method))
    assert features.associate(visual([0, 0, 0], np.zeros((1, 32), np.uint8))).tolist() == [NEW]
    assert features.associate(trunks([0, 0, 0])).tolist() == [0]


def test_a_wide_observation_reaches_farther():
    features = map_of(trunks([0, 0, 0]))
    assert features.associate(trunks([1.0, 0, 0])).tolist() == [NEW]
    assert features.associate(trunks([1.0, 0, 0], np.diag([0.25, 0.01, 0.01]))).tolist() == [0]


# --- what is kept -----------------------------------------------------------------------------------


def test_what_was_seen_once_long_ago_is_forgotten():
    features = map_of(trunks([[0, 0, 0], [9, 0, 0]]), forget_after_s=10.0)
    features.observe(trunks([[0, 0, 0], [20, 0, 0]]), stamp_ns=8_000_000_000)
    assert features.prune(10_000_000_000) == 0
    assert features.prune(10_000_000_001) == 1  # the one at 9 m
    assert features.landmarks["id"].tolist() == [0, 2]
    assert features.prune(100_000_000_000) == 1  # the one at 20 m; the proven one stays
    assert features.landmarks["id"].tolist() == [0]
    assert features.add(trunks([50, 0, 0]), np.array([True]), 0).tolist() == [3]


def test_the_capacity_holds_and_the_proven_stay():
    features = FeatureMap(FeatureMapConfig(capacity=10))
    first = trunks(np.arange(5)[:, None] * [10.0, 0, 0])
    features.observe(first, stamp_ns=0)
    features.observe(first, stamp_ns=1)
    for k in range(20):
        features.observe(trunks([[0, 100.0 + 10 * k, 0]]), stamp_ns=2 + k)
        assert len(features) <= 10
    assert features.landmarks["id"].tolist() == [0, 1, 2, 3, 4, 20, 21, 22, 23, 24]


def test_near_is_a_sphere():
    features = map_of(trunks([[0, 0, 0], [3, 4, 0], [0, 0, 5.1]]))
    assert features.near(np.zeros(3), 5.0)["id"].tolist() == [0, 1]


def test_what_is_not_finite_or_has_no_covariance_is_left_out():
    xyz = np.array([[0, 0, 0], [np.nan, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [np.inf, 0, 0]])
    spread = np.repeat(ROUND[None], 6, axis=0)
    spread[2, 0, 0] = np.nan
    spread[3, 0, 0] = -1.0
    spread[4, 0, 1] = 0.005  # not symmetric
    seen = Observations.of(xyz, spread, TRUNK)
    np.testing.assert_array_equal(seen.position_odom, [[0, 0, 0]])
    nothing = Observations.of(np.empty((0, 3)), np.empty((0, 3, 3)), TRUNK)
    features = map_of(seen)
    assert len(features.observe(nothing, stamp_ns=1)) == 0
    assert len(FeatureMap(FeatureMapConfig()).observe(nothing, stamp_ns=1)) == 0


def test_wrong_shapes_are_named():
    with pytest.raises(InputError, match="covariance"):
        Observations.of(np.zeros((2, 3)), ROUND[None], TRUNK)
    with pytest.raises(InputError, match="descriptor"):
        Observations.of(np.zeros((1, 3)), ROUND[None], VISUAL)
    with pytest.raises(InputError, match="kind"):
        Observations.of(np.zeros((1, 3)), ROUND[None], 7)


# --- bytes ------------------------------------------------------------------------------------------


def test_bytes_come_back_the_same_and_the_map_goes_on_alike():
    features = random_map(3)
    back = FeatureMap.from_bytes(features.to_bytes())
    assert back.landmarks.tobytes() == features.landmarks.tobytes()
    assert back.to_bytes() == features.to_bytes()
    more = trunks(np.random.default_rng(5).normal(size=(9, 3)) * 20)
    assert features.observe(more, 11).tolist() == back.observe(more, 11).tolist()
    assert back.to_bytes() == features.to_bytes()
    empty = FeatureMap(FeatureMapConfig())
    assert FeatureMap.from_bytes(empty.to_bytes()).to_bytes() == empty.to_bytes()


def test_every_cut_and_every_flipped_bit_is_told():
    data = random_map(4, count=3).to_bytes()
    for length in range(len(data)):
        with pytest.raises(InputError, match="features"):
            FeatureMap.from_bytes(data[:length])
    for at in range(len(data)):
        bad = bytearray(data)
        bad[at] ^= 1 << (at % 8)
        with pytest.raises(InputError, match="features"):
            FeatureMap.from_bytes(bytes(bad))
    with pytest.raises(InputError, match="cut or damaged"):
        FeatureMap.from_bytes(data + b"\0")


@given(st.binary(max_size=400))
@settings(max_examples=100, deadline=None)
def test_any_bytes_behind_a_good_head_give_a_map_or_a_clear_error(tail):
    body = b"UFEATURE" + b"\1\0\0\0" + tail
    data = body + zlib.crc32(body).to_bytes(4, "little")
    try:
        features = FeatureMap.from_bytes(data)
    except InputError:
        return
    assert features.to_bytes() == data


@pytest.mark.parametrize(
    ("name", "value", "told"),
    [
        ("id", -1, "ids"),
        ("id", 99, "ids"),
        ("kind", 2, "kind"),
        ("position_odom", np.nan, "place"),
        ("covariance", 0.0, "positive definite"),
        ("covariance", np.inf, "positive definite"),
        ("observations", 0, "nobody"),
    ],
)
def test_a_good_checksum_over_nonsense_is_refused(name, value, told):
    features = random_map(6, count=4)
    features.landmarks[name][2] = value
    with pytest.raises(InputError, match=told):
        FeatureMap.from_bytes(features.to_bytes())


def test_another_version_and_too_many_are_refused():
    features = random_map(7, count=4)
    data = bytearray(features.to_bytes())
    data[8] = 2
    with pytest.raises(InputError, match=r"version 2 \(valid: 1\)"):
        FeatureMap.from_bytes(bytes(data))
    with pytest.raises(InputError, match="up to 3"):
        FeatureMap.from_bytes(features.to_bytes(), FeatureMapConfig(capacity=3))
