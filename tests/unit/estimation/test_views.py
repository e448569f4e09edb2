"""Panoramas turn with the vehicle, tried motions find the true one, and a room is known again, a like one is not."""

import numpy as np
import pytest

from companion.estimation.places.correlate import CorrelateConfig, HitMap
from companion.estimation.places.locate import LocateConfig, Locator, Search
from companion.estimation.places.submap import CompareConfig, Submap, compare, turn_z
from companion.estimation.places.views import ViewConfig, eyes_about, panorama, panoramas, sights


def wall(a, b, low=0.0, high=3.0, step=0.12):
    """Points of an upright wall from a to b, (N, 3)."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    along = np.arange(0.0, 1.0, step / np.linalg.norm(b - a))
    height = np.arange(low, high, step)
    xy = np.repeat(a + along[:, None] * (b - a), len(height), axis=0)
    return np.column_stack([xy, np.tile(height, len(along))])


def floor(x, y, step=0.2):
    grid = np.stack(np.meshgrid(np.arange(*x, step), np.arange(*y, step), [0.0], indexing="ij"), axis=-1)
    return grid.reshape(-1, 3)


def halls(seed):
    """Three rooms in a row, 12 x 8 m each, with doors, and blocks at places of their own."""
    rng = np.random.default_rng(seed)
    parts = [floor((0, 36), (0, 8)), wall((0, 0), (36, 0)), wall((0, 8), (36, 8)), wall((0, 0), (0, 8))]
    parts += [wall((12 * k, 0), (12 * k, 3)) for k in (1, 2)] + [wall((12 * k, 5), (12 * k, 8)) for k in (1, 2)]
    parts.append(wall((36, 0), (36, 8)))
    for k in range(3):
        for x, y in rng.uniform([1, 0.5], [11, 7.5], (5, 2)):
            if abs(y - 4.0) > 1.5:
                corners = [(12 * k + x + a, y + b) for a, b in ((0, 0), (0.8, 0), (0.8, 0.8), (0, 0.8))]
                parts += [wall(corners[n], corners[n - 1], high=rng.uniform(0.8, 2.4)) for n in range(4)]
    return np.concatenate(parts).astype(np.float32)


def seen_from(points, p, yaw, rng, reach=11.0):
    """The points about p in the frame of a vehicle there, with 2 cm of noise and a third missing."""
    near = points[np.linalg.norm(points[:, :2] - p[:2], axis=1) < reach]
    near = near[rng.random(len(near)) > 0.33]
    return ((near - p + rng.normal(0, 0.02, near.shape)) @ turn_z(yaw)).astype(np.float32)


def test_a_panorama_turns_with_the_vehicle():
    config = ViewConfig()
    points = halls(0)
    p = np.array([6.0, 4.0, 1.5])
    known = panoramas(points, p[None], config)
    for sectors in (0, 7, 60):
        yaw = 2 * np.pi * sectors / config.sectors
        turned = ((points - p) @ turn_z(yaw)).astype(np.float32)
        (sight,) = sights(known, p[None], panorama(turned, config), config)
        assert np.remainder(sight.yaw - yaw + np.pi, 2 * np.pi) - np.pi == pytest.approx(0.0, abs=1e-6)
        assert sight.unlike < 0.02


def test_an_eye_inside_of_something_sees_nothing():
    config = ViewConfig()
    points = halls(0)
    assert np.isnan(panoramas(points, np.array([[6.0, 0.05, 1.5]]), config)).all()
    assert (
        sights(panoramas(points, np.array([[6.0, 0.05, 1.5]]), config), np.zeros((1, 3)), np.zeros((8, 90)), config)
        == []
    )


def test_eyes_lie_on_a_level_grid_within_the_radius():
    eyes = eyes_about(np.array([1.0, 2.0, 3.0]), 2.0, 0.5)
    assert len(eyes) == 49  # lattice points in a disc of radius 4
    assert np.all(eyes[:, 2] == 3.0)
    assert np.linalg.norm(eyes[:, :2] - [1, 2], axis=1).max() <= 2.0


def test_tried_motions_find_the_true_one():
    rng = np.random.default_rng(1)
    points, p, yaw = halls(0), np.array([15.0, 4.0, 1.5]), 0.7
    hits = HitMap(points, CorrelateConfig())
    view = hits.thinned(seen_from(points, p, yaw, rng))
    found, turn, share = hits.refined(view, p + np.array([0.5, -0.5, 0.2]), yaw + 0.06)
    assert share > 0.95
    assert np.linalg.norm(found - p) < 0.3
    assert abs(turn - yaw) < 0.04


def test_a_submap_without_trunks_is_known_again_and_another_place_is_not():
    rng = np.random.default_rng(2)
    config = CompareConfig()
    points, p = halls(0), np.array([15.0, 4.0, 1.5])
    old = Submap(0, seen_from(points, p, 0.0, rng, reach=14.0), config)
    q = np.array([17.0, 4.6, 1.6])
    new = Submap(9, seen_from(points, q, 0.05, rng), config)
    met = compare(old, new, q - p + [1.5, -1.0, 0.0], 6.0)
    assert np.linalg.norm(met.p - (q - p)) < 0.06
    assert np.linalg.norm(met.R - turn_z(0.05)) < 0.02
    assert (met.trunks, met.near > 0.85) == (0, True)
    elsewhere = Submap(9, seen_from(halls(7), q, 0.05, rng), config)
    assert compare(old, elsewhere, q - p, 6.0) is None


def test_lost_in_halls_it_is_found_by_the_second_view_and_never_in_others():
    rng = np.random.default_rng(3)
    points = halls(0)
    eyes = np.stack(np.meshgrid(np.arange(0.6, 36, 0.6), np.arange(2.6, 5.6, 0.6), [1.5], indexing="ij"), -1)
    locator = Locator(points, eyes.reshape(-1, 3), LocateConfig())
    for world, known in ((points, True), (halls(11), False)):
        for x in (5.0, 19.0, 31.0):
            p, yaw, search = np.array([x, 4.1, 1.5]), rng.uniform(-3, 3), Search(locator)
            step = turn_z(yaw).T @ np.array([0.8, 0.1, 0.0])
            first = search.look(seen_from(world, p, yaw, rng), np.eye(3), np.zeros(3))
            q = p + np.array([0.8, 0.1, 0.0])
            second = search.look(seen_from(world, q, yaw, rng), np.eye(3), step)
            assert first is None
            assert (second is not None) == known
            if second:
                assert np.linalg.norm(second.p - q) < 0.15
