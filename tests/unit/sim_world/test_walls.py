"""Racks, halls and rock: what a ray meets, what a hull touches, and that sensors see the same."""

import numpy as np
import pytest
from scipy.optimize import minimize

from companion.core.messages import LidarScan
from companion.core.rig import Rig
from sim.sensors.camera import CameraConfig
from sim.sensors.caster import Caster
from sim.sensors.lidar import LidarConfig
from sim.sensors.scene import RenderSetup, Sensors
from sim.vehicle import Obstacles, Vehicle, load_params
from sim.vehicle.wind import WindConfig
from sim.world import load_world
from sim.world.mesh import wall_mesh
from sim.world.mine import junctions, tunnels
from sim.world.model import CLEAR, Air
from sim.world.solids import box_triangles, cut_small, skin
from sim.world.spec import MineSpec
from sim.world.walkers import NOBODY
from sim.world.walls import make_walls, point_to_triangle
from sim.world.world import build_world

SMALL_MINE = MineSpec(size_m=50.0, spacing_m=25.0, loops=1.0)


def area(triangles):
    a, b = triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    return 0.5 * np.linalg.norm(np.cross(a, b), axis=1).sum()


def test_boxes_have_the_area_of_boxes_also_when_cut():
    box = box_triangles(np.array([[1.0, 2.0, 3.0]]), np.array([[1.0, 2.0, 0.5]]))
    assert area(box) == pytest.approx(2 * (2 * 4 + 2 * 1 + 4 * 1))
    small = cut_small(box, 0.7)
    assert area(small) == pytest.approx(area(box))
    assert np.linalg.norm(small - np.roll(small, 1, axis=1), axis=2).max() <= 0.7


def test_the_skin_of_a_ball_is_a_ball():
    x, y, z = np.meshgrid(*[np.arange(-2, 2.01, 0.2)] * 3, indexing="ij")
    ball = skin(np.sqrt(x**2 + y**2 + z**2) - 1.5, np.full(3, -2.0), 0.2)
    assert np.linalg.norm(ball, axis=2) == pytest.approx(1.5, abs=0.02)
    assert area(ball) == pytest.approx(4 * np.pi * 1.5**2, rel=0.02)


def test_distance_to_a_triangle_is_the_least_over_its_points():
    rng = np.random.default_rng(0)
    for _ in range(60):
        corners, p = rng.normal(size=(3, 3)), 2.0 * rng.normal(size=3)

        def gap(weights, corners=corners, p=p):
            v, w = weights
            return np.linalg.norm(corners[0] + v * (corners[1] - corners[0]) + w * (corners[2] - corners[0]) - p)

        inside = {"type": "ineq", "fun": lambda weights: 1.0 - weights.sum()}
        starts = ([0.3, 0.3], [0.9, 0.05], [0.05, 0.9])
        best = min(minimize(gap, s, bounds=[(0, 1), (0, 1)], constraints=[inside]).fun for s in starts)
        assert point_to_triangle(corners, *p) == pytest.approx(best, abs=1e-4)


def test_a_ray_meets_the_wall_that_embree_meets():
    rng = np.random.default_rng(1)
    triangles = rng.uniform(-8, 8, (200, 1, 3)) + rng.normal(0, 1.0, (200, 3, 3))
    rays = np.concatenate([rng.uniform(-9, 9, (300, 3)), rng.normal(size=(300, 3))], axis=1)
    rays[:, 3:] /= np.linalg.norm(rays[:, 3:], axis=1, keepdims=True)
    expected, _ = Caster(wall_mesh(triangles)).cast(rays.astype(np.float32))
    walls = make_walls(triangles)
    found = np.array([walls.first_hit(r[:3], r[3:], 60.0) for r in rays])
    assert 40 < np.isfinite(expected).sum() < 290
    close = np.isclose(found, expected, atol=1e-3) | (np.isinf(found) & np.isinf(expected))
    assert close.mean() > 0.99  # a ray along an edge may go either way


def test_flying_into_a_wall_is_a_contact_and_clearance_counts_down_to_it():
    wall = cut_small(box_triangles(np.array([[1.5, 0.0, 20.0]]), np.array([[0.1, 30.0, 20.0]])), 4.0)
    empty = np.zeros((0, 9)), np.zeros(0, np.int8), np.zeros((2, 2)), np.array([-100.0, -100.0]), 200.0
    vehicle = Vehicle(
        load_params(), p_world=np.array([0.0, 0.0, 20.0]), yaw=0.0,
        obstacles=Obstacles(*empty, walls=make_walls(wall)), wind=WindConfig(mean_m_s=6.0), seed=0,
    )  # fmt: skip
    hover = np.full(4, 0.45)
    vehicle.step(hover, 1)
    rotor_reach = 0.159 * np.sqrt(2) * np.cos(np.radians(45)) + 0.127
    assert vehicle.take_min_clearance() == pytest.approx(1.4 - rotor_reach, abs=0.01)
    for _ in range(4000):
        vehicle.step(hover, 2)
    assert vehicle.contact == "wall"
    assert -0.01 < vehicle.take_min_clearance() <= 0.0


def test_tunnels_join_all_junctions_and_loops_add_rings():
    spec = MineSpec()
    nodes = junctions(spec, np.random.default_rng(0))
    counts = []
    for share in (0.0, 1.0):
        rng = np.random.default_rng(1)
        lines = tunnels(nodes, MineSpec(loops=share), rng)
        ends = {tuple(line[k]) for line in lines for k in (0, -1)}
        assert len(ends) == nodes.shape[0] * nodes.shape[1]
        counts.append(len(lines))
    assert counts == [15, 24]  # a tree of the 4 x 4 grid, and the whole grid


def test_a_mine_is_closed_except_for_its_floor():
    world = build_world(SMALL_MINE, name="small", seed=2)
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(400, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ranges = [world.range_to_surface(np.array([0.0, 0.0, 1.5]), d, max_range_m=200.0) for d in directions]
    assert np.all(np.isfinite(ranges))
    up = world.range_to_surface(np.array([0.0, 0.0, 1.5]), np.array([0.0, 0.0, 1.0]))
    assert 3.2 - 1.5 - 0.6 < up < 4.5 - 1.5 + 0.6


def test_aisles_of_the_warehouse_are_free_and_racks_are_not():
    world = load_world("warehouse", seed=0)
    for y in (-11.0, -6.6, -2.2, 2.2, 6.6, 11.0):  # middles of the aisles
        along = world.range_to_surface(np.array([0.0, y, 1.5]), np.array([1.0, 0.0, 0.0]))
        assert along == pytest.approx(41.1, abs=0.01)
    x, y, side = (v.ravel() for v in np.meshgrid(np.arange(4, 35, 0.4), (-6.6, -2.2, 2.2, 6.6), (-1.0, 1.0)))
    across = [
        world.range_to_surface(np.array([a, b, 0.5]), np.array([0.0, s, 0.0]))
        for a, b, s in zip(x, y, side, strict=True)
    ]
    room = 0.8 * 0.765 * (1.4 - 0.1) / 1.4  # share of loads, mean length, place without its post
    assert np.mean(np.array(across) < 2.8) == pytest.approx(room, abs=0.1)


def scan_in(world, air):
    sensors = Sensors(RenderSetup(world.mesh, LidarConfig(points=4000), CameraConfig(), Rig(), 1, NOBODY, air))
    pose = np.tile([0.0, 0.0, 1.5], (2, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1))
    scan, _ = sensors.render("lidar", {"p_world": pose[0], "q_world_body": pose[1], "stamp_ns": 10**8, "counter": 0})
    frame, _ = sensors.render(
        "camera", {"p_world": pose[0][0], "q_world_body": pose[1][0], "stamp_ns": 10**8, "counter": 0}
    )
    assert isinstance(scan, LidarScan)
    return np.linalg.norm(scan.points_sensor, axis=1), frame.pixels


def test_the_air_of_a_mine_takes_light_and_returns_and_adds_dust():
    world = build_world(SMALL_MINE, name="small", seed=2)
    clear, bright = scan_in(world, CLEAR)
    dusty, dark = scan_in(world, Air(light=0.1, dust=0.05, lidar_loss=0.3))
    assert len(dusty) / len(clear) == pytest.approx(0.7, abs=0.05)
    assert np.mean(dusty < 1.2) > np.mean(clear < 1.2) + 0.005
    assert dark.mean() == pytest.approx(0.1 * bright.mean(), abs=2.0)
