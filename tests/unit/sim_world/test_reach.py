"""A single ray's range agrees with geometry on paper and with the mesh."""

import math

import numpy as np
import pytest

from sim.sensors.caster import Caster
from sim.world import load_world
from sim.world.mesh import LEAF

FLAT = {"roughness_m": 0.0}


def test_range_to_a_plane_is_exact():
    world = load_world("empty", seed=0, options=FLAT)
    for angle in np.linspace(0.1, math.pi / 2, 7):
        direction = np.array([math.cos(angle), 0.0, -math.sin(angle)])
        expected = 3.0 / math.sin(angle)
        assert world.range_to_surface(np.array([1.0, 2.0, 3.0]), direction) == pytest.approx(expected, abs=1e-9)
    assert world.range_to_surface(np.array([0.0, 0.0, 3.0]), np.array([0.0, 0.0, 1.0])) == math.inf
    assert world.range_to_surface(np.array([0.0, 0.0, 70.0]), np.array([0.0, 0.0, -1.0])) == math.inf
    assert world.range_to_surface(np.array([math.nan, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])) == math.inf


def test_range_to_an_upright_trunk_is_exact(tmp_path):
    (tmp_path / "one.csv").write_text("x_m,y_m,dbh_m,h_m\n0,0,0.4,20\n30,0,0.4,20\n0,30,0.4,20\n30,30,0.4,20\n")
    world = load_world(f"stems:{tmp_path}/one.csv", seed=0, options={**FLAT, "lean_deg": 0.0, "crown": False})
    x, y = world.stems.x[0], world.stems.y[0]
    p = np.array([x + 5.0, y + 5.0, 1.3])
    direction = np.array([-1.0, -1.0, 0.0]) / math.sqrt(2)
    assert world.range_to_surface(p, direction) == pytest.approx(math.hypot(5, 5) - 0.2, abs=1e-9)


def test_range_equals_the_mesh_within_the_polygons_error():
    world = load_world("poisson", seed=3, options={"branches": 10, "crown": False, "roughness_m": 0.3})
    assert not np.any(world.mesh.classes == LEAF)
    rng = np.random.default_rng(1)
    xy = rng.uniform(-40, 40, (3000, 2))
    p = np.column_stack([xy, world.ground_z(*xy.T) + rng.uniform(1.0, 6.0, 3000)])
    d = rng.normal(size=(3000, 3)) * [1, 1, 0.4]
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    far, _ = Caster(world.mesh).cast(np.column_stack([p, d]).astype(np.float32))
    ours = np.array([world.range_to_surface(a, b, max_range_m=30.0) for a, b in zip(p, d, strict=True)])
    near = (far < 29.0) | (ours < 29.0)
    agree = np.abs(far[near] - ours[near]) < 0.03
    assert near.sum() > 1000
    assert agree.mean() > 0.98  # the rest grazes an edge of a 12- or 4-sided tube
