"""Lost in a saved map: all places are tried, what is blind along a tunnel is slid to its end, far views count, too."""

import numpy as np
import pytest

from companion.estimation.places.likeliest import CoarseMap, LikeliestConfig
from companion.estimation.places.locate import LocateConfig, Locator, Search
from companion.estimation.places.submap import turn_z
from companion.estimation.places.verify import VerifyConfig, align


def trunks(rng, count, size_m):
    """Upright trunks of 15 cm radius at random, and the ground, (N, 3)."""
    places = rng.uniform(0.0, size_m, (count, 2))
    turn = np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False)
    ring = 0.15 * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    height = np.arange(0.0, 4.0, 0.15)
    xy = (places[:, None, None] + ring[None, :, None] + np.zeros((1, 1, len(height), 1))).reshape(-1, 2)
    z = np.broadcast_to(height, (count, 12, len(height))).reshape(-1)
    grid = np.arange(0.0, size_m, 0.5)
    ground = np.stack(np.meshgrid(grid, grid, [0.0], indexing="ij"), axis=-1).reshape(-1, 3)
    return np.vstack([np.column_stack([xy, z]), ground]).astype(np.float32)


def seen_from(points, p, yaw, rng, reach_m):
    """What of the points lies within reach, in the frame of a vehicle at p, with 2 cm of noise, a half missing."""
    near = points[np.linalg.norm(points - p, axis=1) < reach_m]
    near = near[rng.random(len(near)) > 0.5]
    return ((near - p + rng.normal(0.0, 0.02, near.shape)) @ turn_z(yaw)).astype(np.float32)


@pytest.mark.parametrize("reach_m", [15.0, 34.0])
def test_a_forest_is_known_at_the_first_view_however_far_that_reaches(reach_m):
    """Views of 34 m once were laid on 20 m of map, and never fitted."""
    rng = np.random.default_rng(1)
    points, p, yaw = trunks(rng, 450, 120.0), np.array([57.0, 63.0, 2.0]), 2.2
    eyes = np.stack(np.meshgrid(np.arange(1.0, 120.0, 2.0), np.arange(1.0, 120.0, 2.0), [2.0], indexing="ij"), -1)
    locator = Locator(points, eyes.reshape(-1, 3), LocateConfig())
    found = Search(locator).look(seen_from(points, p, yaw, rng, reach_m), np.eye(3), np.zeros(3))
    assert found.by == "trunks" and found.near > 0.9
    assert np.linalg.norm(found.p - p) < 0.05
    assert np.linalg.norm(found.R - turn_z(yaw)) < 0.01


def boxes(rng, count):
    """Faces of boxes all over a hall of 40 x 24 m with a floor, (N, 3)."""
    step, parts = np.arange(0.0, 1.5, 0.15), []
    for x, y in rng.uniform([0.0, 0.0], [40.0, 24.0], (count, 2)):
        high = np.arange(0.0, rng.uniform(1.0, 3.0), 0.15)
        side, z = (v.ravel() for v in np.meshgrid(step, high))
        parts += [np.column_stack([x + side, np.full_like(side, y), z]), np.column_stack([0 * side + x, y + side, z])]
    grid = np.stack(np.meshgrid(np.arange(0, 40, 0.4), np.arange(0, 24, 0.4), [0.0], indexing="ij"), -1)
    return np.vstack([*parts, grid.reshape(-1, 3)]).astype(np.float32)


@pytest.mark.parametrize("seed", range(5))
def test_the_true_place_is_the_likeliest_at_any_heading(seed):
    rng = np.random.default_rng(seed)
    points = boxes(rng, 60)
    eyes = np.stack(np.meshgrid(np.arange(1.0, 39.0, 0.6), np.arange(1.0, 23.0, 0.6), [1.5], indexing="ij"), -1)
    p, yaw = np.array([rng.uniform(8, 32), rng.uniform(6, 18), 1.5]), rng.uniform(-np.pi, np.pi)
    places = CoarseMap(points, LikeliestConfig()).likeliest(eyes.reshape(-1, 3), seen_from(points, p, yaw, rng, 12.0))
    assert np.linalg.norm(places[0].p_map - p) < 0.5  # half a step of the grid, in both directions
    assert abs(np.remainder(places[0].yaw - yaw + np.pi, 2 * np.pi) - np.pi) < 0.07  # a turn of 4 degrees
    assert [s.unlike for s in places] == sorted(s.unlike for s in places)
    apart = [np.linalg.norm(a.p_map - b.p_map) for n, a in enumerate(places) for b in places[:n]]
    assert min(apart) >= LikeliestConfig().elsewhere_m


def test_a_huge_map_is_tried_in_larger_cells_and_an_empty_view_nowhere():
    far = np.array([[0.0, 0.0, 0.0], [3000.0, 2000.0, 60.0]], np.float32)
    grid = CoarseMap(far, LikeliestConfig())
    assert grid.cell_m == pytest.approx(3.2)
    assert grid.likeliest(np.zeros((1, 3)), np.empty((0, 3), np.float32)) == []
    (place,) = grid.likeliest(np.array([[2999.0, 2000.0, 60.0]]), np.array([[1.0, 0.0, 0.0]], np.float32))
    assert place.unlike == 0.0


def tunnel(rng):
    """60 m of a tunnel of 2 m radius, smooth but for ribs of 0.2 m at random places, (N, 3)."""
    x, turn = (v.ravel() for v in np.meshgrid(np.arange(0.0, 60.0, 0.1), np.linspace(0, 2 * np.pi, 90, endpoint=False)))
    ribs = rng.uniform(0.0, 60.0, 15)
    radius = np.where(np.abs(x[:, None] - ribs).min(axis=1) < 0.25, 1.8, 2.0) + 0.03 * np.sin(2.0 * turn + 0.5 * x)
    return np.column_stack([x, radius * np.cos(turn), radius * np.sin(turn)]).astype(np.float32)


def test_along_a_tunnel_a_view_is_slid_to_where_it_lies_best():
    rng = np.random.default_rng(4)
    points, p = tunnel(rng), np.array([30.0, 0.1, 0.0])
    view = seen_from(points, p, 0.0, rng, 9.0)
    noisy = points + rng.normal(0.0, 0.05, points.shape).astype(np.float32)
    off = {}
    for slides in (0, 4):
        config = VerifyConfig(
            near_m=0.2, least_near=0.5, settled_m=5e-3, iterations=20, least_eigenvalue=1e-4, slides=slides
        )
        starts = [p + np.array([d, 0.0, 0.0]) for d in (-0.6, -0.4, 0.4, 0.6)]
        found = [align(noisy, view, (np.eye(3), start), config) for start in starts]
        off[slides] = np.array([abs(f.p[0] - p[0]) for f in found])
    assert off[0].max() > 0.2  # it stops where steps get short
    assert off[4].max() < 0.12
    assert abs(found[0].blindest[0]) > 0.99
