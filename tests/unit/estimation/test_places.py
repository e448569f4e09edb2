"""Laws of place recognition: trunks are found where they stand, and a view of them where it was taken."""

from pathlib import Path

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.estimation.places.constellation import ConstellationConfig, accepted, constellation, match
from companion.estimation.places.trunks import TrunkConfig, detect_trunks

STEMS = Path(__file__).parents[4] / "shared" / "data" / "forest_stem_maps"
CONFIG = ConstellationConfig()


def turned(points, yaw):
    c, s = np.cos(yaw), np.sin(yaw)
    return points @ np.array([[c, s], [-s, c]])


def poisson(seed, size_m=(200.0, 140.0), per_m2=1 / 25):
    rng = np.random.default_rng(seed)
    return rng.uniform(0, 1, (int(size_m[0] * size_m[1] * per_m2), 2)) * size_m


def surveyed(trees, seed, noise_m=0.08, missing=0.1):
    """What a survey with errors makes of them."""
    rng = np.random.default_rng(seed)
    return (trees + rng.normal(0, noise_m, trees.shape))[rng.random(len(trees)) > missing]


def view(trees, p, yaw, rng, radius_m=14.0, noise_m=0.05, missing=0.15, false=0.1):
    """Trunks as seen from p with heading yaw: some unseen, some that are none."""
    near = trees[np.linalg.norm(trees - p, axis=1) < radius_m]
    near = near[rng.random(len(near)) > missing]
    wrong = p + rng.uniform(-radius_m, radius_m, (rng.poisson(false * len(near)), 2))
    seen = np.vstack([near, wrong])
    return turned(seen + rng.normal(0, noise_m, seen.shape) - p, -yaw)


def starts(trees, count, rng):
    """(p, yaw, view) at random places that see at least ten trunks."""
    low, high = trees.min(axis=0) + 12, trees.max(axis=0) - 12
    while count:
        p, yaw = rng.uniform(low, high), rng.uniform(-np.pi, np.pi)
        seen = view(trees, p, yaw, rng)
        if len(seen) >= 10:
            count -= 1
            yield p, yaw, seen


def found_in(trees, count, seed):
    """(right, wrong, refused, largest error in m and rad) over random starts in the surveyed map."""
    rng = np.random.default_rng(seed)
    known = constellation(surveyed(trees, seed), CONFIG)
    right = wrong = refused = 0
    errors = []
    for p, yaw, seen in starts(trees, count, rng):
        place = accepted(match(known, constellation(seen, CONFIG), CONFIG), CONFIG)
        if place is None:
            refused += 1
        elif np.linalg.norm(place.p_map - p) < 0.3:
            right += 1
            turn = (place.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
            errors.append((np.linalg.norm(place.p_map - p), abs(turn)))
        else:
            wrong += 1
    return right, wrong, refused, np.max(errors, axis=0)


def test_a_view_is_found_in_a_surveyed_forest_and_never_in_the_wrong_place():
    right, wrong, refused, worst = found_in(poisson(0), 100, seed=1)
    assert wrong == 0
    assert right >= 98
    assert refused <= 2
    assert worst[0] < 0.2
    assert worst[1] < 0.03


@pytest.mark.skipif(not STEMS.is_dir(), reason="needs ../shared/data/forest_stem_maps")
@pytest.mark.parametrize(("name", "least"), [("longleaf", 45), ("spruces", 49)])
def test_a_view_is_found_among_real_stems(name, least):
    trees = np.loadtxt(STEMS / f"{name}.csv", delimiter=",", skiprows=1)[:, :2]
    right, wrong, _, _ = found_in(trees, 50, seed=2)
    assert wrong == 0
    assert right >= least


def test_views_of_another_forest_are_refused():
    known = constellation(surveyed(poisson(0), 0), CONFIG)
    for _, _, seen in starts(poisson(77), 100, np.random.default_rng(3)):
        assert accepted(match(known, constellation(seen, CONFIG), CONFIG), CONFIG) is None


def test_rows_that_repeat_are_refused_rather_than_guessed():
    """A plantation on a perfect grid looks the same from many places."""
    x, y = np.meshgrid(np.arange(0, 80, 4.0), np.arange(0, 80, 5.1))
    trees = np.stack([x.ravel(), y.ravel()], axis=1)
    known = constellation(trees, CONFIG)
    rng = np.random.default_rng(1)
    for _ in range(20):
        p = rng.uniform(20, 60, 2)
        seen = view(trees, p, rng.uniform(-3, 3), rng, false=0.0)
        assert accepted(match(known, constellation(seen, CONFIG), CONFIG), CONFIG) is None


def test_the_same_place_is_found_whatever_the_heading():
    trees = poisson(5, (60.0, 60.0))
    known, rng = constellation(trees, CONFIG), np.random.default_rng(0)
    near = trees[np.linalg.norm(trees - 30.0, axis=1) < 14]
    for yaw in rng.uniform(-np.pi, np.pi, 20):
        place = match(known, constellation(turned(near - 30.0, -yaw), CONFIG), CONFIG)[0]
        assert place.p_map == pytest.approx([30.0, 30.0], abs=1e-6)
        assert np.cos(place.yaw - yaw) == pytest.approx(1.0, abs=1e-12)
        assert (place.inliers, place.share) == (len(near), 1.0)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_few_trunks_are_no_place(count):
    known = constellation(poisson(0), CONFIG)
    seen = constellation(np.random.default_rng(0).uniform(-5, 5, (count, 2)), CONFIG)
    assert accepted(match(known, seen, CONFIG), CONFIG) is None
    assert match(seen, known, CONFIG) == [] or count == 3


def cloud_of(trunks, rng, per_trunk=150, noise_m=0.01):
    """(N, 3): ground on a slope, trunks seen from the origin, ferns that are not tall."""
    ground = rng.uniform(-15, 15, (6000, 2))
    parts = [np.column_stack([ground, 0.1 * ground[:, 0] + rng.normal(0, 0.03, len(ground))])]
    for x, y, radius, lean in trunks:
        height = rng.uniform(0, 6, per_trunk)
        facing = np.arctan2(-y, -x) + rng.uniform(-1.3, 1.3, per_trunk)
        parts.append(
            np.column_stack(
                [x + radius * np.cos(facing) + lean * height, y + radius * np.sin(facing), 0.1 * x + height]
            )
        )
    ferns = rng.uniform(-12, 12, (40, 2))
    for x, y in ferns:
        parts.append(np.array([x, y, 0.1 * x + 0.4]) + rng.normal(0, 0.2, (30, 3)))
    cloud = np.vstack(parts)
    return cloud + rng.normal(0, noise_m, cloud.shape)


def test_trunks_are_found_where_they_stand():
    rng = np.random.default_rng(4)
    corners = np.array([(x, y) for x in range(-12, 13, 4) for y in range(-12, 13, 4) if x or y], float)
    places = corners + rng.uniform(-1, 1, corners.shape)
    trunks = np.column_stack([places, rng.uniform(0.08, 0.3, 48), rng.normal(0, 0.03, 48)])
    found = detect_trunks(cloud_of(trunks, rng), TrunkConfig())
    breast = np.array([(x + 1.8 * lean, y) for x, y, _, lean in trunks])
    gap = np.linalg.norm(found.centers[:, None] - breast[None], axis=2)
    nearest = gap.argmin(axis=1)
    assert (gap.min(axis=1) < 0.15).mean() >= 0.95  # precision
    assert len(set(nearest[gap.min(axis=1) < 0.15].tolist())) >= 45  # of 48
    assert np.median(gap.min(axis=1)) < 0.03
    right = gap.min(axis=1) < 0.15
    radii = np.array([t[2] for t in trunks])[nearest]
    assert np.median(np.abs(found.radii - radii)[right]) < 0.02


def test_a_turned_cloud_gives_turned_trunks():
    rng = np.random.default_rng(2)
    trunks = [(5.0, 2.0, 0.2, 0.0), (-4.0, 6.0, 0.15, 0.0), (3.0, -7.0, 0.25, 0.0)]
    cloud = cloud_of(trunks, rng)
    spun = np.column_stack([turned(cloud[:, :2], 1.0), cloud[:, 2]])
    first, second = (detect_trunks(c, TrunkConfig()).centers for c in (cloud, spun))
    gap = np.linalg.norm(turned(first, 1.0)[:, None] - second[None], axis=2)
    assert gap.min(axis=1).max() < 0.05


def test_nothing_and_nonsense_give_no_trunk():
    for cloud in (np.empty((0, 3)), np.full((100, 3), np.nan), np.zeros((50, 3))):
        assert len(detect_trunks(cloud, TrunkConfig()).centers) == 0
    with pytest.raises(InputError, match="least_bands"):
        TrunkConfig(least_bands=9)
