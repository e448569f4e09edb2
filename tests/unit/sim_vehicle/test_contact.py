"""Clearances against brute force."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.core.geometry import rotate
from sim.vehicle.contact import (
    REACH_M,
    Near,
    Obstacles,
    _cone_clearance,
    clearance,
    flat_ground,
    frustum_distance,
)
from sim.vehicle.params import hull_spheres, load_params

SPHERES = hull_spheres(load_params())


def random_cones(rng: np.random.Generator, count: int, size: float) -> np.ndarray:
    cones = np.empty((count, 9))
    cones[:, :3] = rng.uniform(-size, size, (count, 3))
    cones[:, 3:6] = rng.standard_normal((count, 3))
    cones[:, 3:6] /= np.linalg.norm(cones[:, 3:6], axis=1)[:, None]
    cones[:, 6] = rng.uniform(0.2, 3.0, count)
    cones[:, 7:] = rng.uniform(0.005, 0.4, (count, 2))
    return cones


def stand(cones: np.ndarray, kinds: np.ndarray | None = None) -> Obstacles:
    if kinds is None:
        kinds = np.zeros(len(cones), np.int8)
    return Obstacles(cones, kinds, np.zeros((2, 2)), np.full(2, -100.0), 200.0)


def surface_points(cone: np.ndarray, count: int) -> np.ndarray:
    """Side and caps, dense."""
    axis, (length, r0, r1) = cone[3:6], cone[6:]
    e1 = np.cross(axis, [1.0, 0, 0] if abs(axis[0]) < 0.9 else [0, 1.0, 0])
    e1 /= np.linalg.norm(e1)
    ring = np.linspace(0, 2 * np.pi, count, endpoint=False)
    round_about = np.cos(ring)[:, None] * e1 + np.sin(ring)[:, None] * np.cross(axis, e1)
    parts = []
    for s in np.linspace(0, 1, count):
        parts.append(cone[:3] + s * length * axis + (r0 + s * (r1 - r0)) * round_about)
        parts.append(cone[:3] + s * r0 * round_about)
        parts.append(cone[:3] + length * axis + s * r1 * round_about)
    return np.concatenate(parts)


def state(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    x = np.zeros(17)
    x[:3], x[6:10] = p, q / np.linalg.norm(q)
    return x


def brute_force(cones: np.ndarray, x: np.ndarray) -> float:
    centres = x[:3] + rotate(x[6:10], SPHERES[:, :3])
    gaps = [frustum_distance(c, p) - r for c in cones for p, r in zip(centres, SPHERES[:, 3], strict=True)]
    return min([*gaps, REACH_M])


def test_distance_to_a_frustum_is_that_to_its_surface() -> None:
    rng = np.random.default_rng(1)
    for cone in random_cones(rng, 10, 1.0):
        points = surface_points(cone, 120)
        for p in rng.uniform(-2, 2, (10, 3)):
            nearest = np.linalg.norm(points - p, axis=1).min()
            assert abs(frustum_distance(cone, p)) == pytest.approx(nearest, abs=0.02)


def test_distance_to_a_cylinder_at_known_points() -> None:
    cone = np.array([0.0, 0, 0, 0, 0, 1, 2.0, 0.5, 0.5])
    for p, expected in [
        ((2.0, 0, 1), 1.5), ((0, 0, 3), 1.0), ((0, 0, -1), 1.0), ((1.5, 0, 3), 2**0.5),
        ((0, 0, 1), -0.5), ((0.4, 0, 1), -0.1), ((0, 0, 0.1), -0.1),
    ]:  # fmt: skip
        assert frustum_distance(cone, np.array(p)) == pytest.approx(expected, abs=1e-12)


def test_hull_clearance_matches_brute_force() -> None:
    rng = np.random.default_rng(2)
    cones = random_cones(rng, 150, 12.0)
    obstacles = stand(cones)
    for _ in range(60):
        x = state(rng.uniform(-14, 14, 3), rng.standard_normal(4))
        assert clearance(obstacles, SPHERES, x)[0] == pytest.approx(brute_force(cones, x), abs=1e-12)


def test_near_list_gives_the_same_along_a_path() -> None:
    rng = np.random.default_rng(3)
    cones = random_cones(rng, 200, 10.0)
    near = Near(stand(cones))
    for t in np.linspace(-12, 12, 300):
        x = state(np.array([t, 0.3 * t, 2 * np.sin(t)]), np.array([1.0, 0.1, 0.2, 0.3 * t]))
        found, _ = _cone_clearance(
            x, SPHERES, near.cones, near.kinds, near.frame, near.grid.start, near.grid.items,
            near.list, near.seen, REACH_M,
        )  # fmt: skip
        assert found == pytest.approx(brute_force(cones, x), abs=1e-12)


def test_kind_of_what_is_touched() -> None:
    cones = np.array([[0.0, 0, 0, 0, 0, 1, 10, 0.2, 0.2], [0.2, 0, 5, 1, 0, 0, 2, 0.02, 0.01]])
    obstacles = stand(cones, np.array([0, 1], np.int8))
    upright = np.array([1.0, 0, 0, 0])
    assert clearance(obstacles, SPHERES, state(np.array([0.0, 0.3, 3]), upright))[1] == "trunk"
    assert clearance(obstacles, SPHERES, state(np.array([1.5, 0.0, 5]), upright))[1] == "branch"
    assert clearance(obstacles, SPHERES, state(np.array([1.5, 2.0, 5]), upright))[1] == ""


def test_nothing_near_reads_as_the_reach() -> None:
    x = state(np.array([50.0, 0, 5]), np.array([1.0, 0, 0, 0]))
    assert clearance(flat_ground(), SPHERES, x) == (REACH_M, "")
    assert clearance(stand(random_cones(np.random.default_rng(4), 5, 2.0)), SPHERES, x) == (REACH_M, "")


def test_wrong_obstacles_are_named() -> None:
    with pytest.raises(InputError, match="cones"):
        stand(np.zeros((3, 8)))
    with pytest.raises(InputError, match="cones"):
        stand(np.full((1, 9), np.nan))
