"""Walkers: where they are follows from the time alone, and every sensor and the hull agree on it."""

import math

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core.errors import InputError
from companion.core.rig import Mount, Rig
from sim.config import SimConfig
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig
from sim.sensors.render import InlineRenderer, WorkerRenderer
from sim.vehicle import Obstacles, Vehicle, WindConfig, load_params
from sim.vehicle.contact import REACH_M
from sim.vehicle.params import hull_spheres
from sim.world import load_world
from sim.world.walkers import nearest_walker

CLEAN = LidarConfig(
    range_sigma_m=0.0, range_sigma_per_m=0.0, angle_sigma_deg=0.0, divergence_mrad=0.0, dropout=0.0,
    body_radius_m=0.0, miss_stride=1,
)  # fmt: skip
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
MEADOW = {"roughness_m": 0.0, "walker_radius_m": 0.5, "walker_height_m": 2.5}


def meadow(**options):
    return load_world("empty", seed=1, options={**MEADOW, **options})


@pytest.fixture(scope="module")
def line():
    """One walker on the line x = 6, y from -20 to 20, at 2 m/s."""
    return meadow(walker_paths=[[[6, -20], [6, 20]]], walker_speed_m_s=[2.0, 2.0])


@pytest.fixture(scope="module")
def moving():
    return load_world("moving", seed=3)


def test_a_walker_goes_to_and_fro_at_its_speed(line):
    stamps = np.arange(0, 60_000, 25) * 1_000_000
    feet = np.array([line.walkers.feet(int(t))[0] for t in stamps])
    assert np.all(feet[:, 0] == 6.0)
    assert np.all(feet[:, 2] == 0.0)
    assert -20.0 <= feet[:, 1].min() < -19.9
    assert 19.9 < feet[:, 1].max() <= 20.0
    way = np.abs(np.diff(feet[:, 1]))
    assert way.max() <= 0.05 + 1e-9
    assert np.median(way) == pytest.approx(0.05, abs=1e-9)
    period_ns = 40_000_000_000
    np.testing.assert_allclose(line.walkers.feet(7 + period_ns), line.walkers.feet(7), atol=1e-9)


def test_drawn_ways_keep_to_the_stand_off_trunks_and_start(moving):
    spec_radius, walkers = 0.35, moving.walkers
    assert len(walkers) == 6
    assert np.all((walkers.traits[:, 1] >= 0.5) & (walkers.traits[:, 1] <= 1.5))
    xy = walkers.tracks[:, :2]
    assert np.abs(xy).max() <= 18.0
    assert np.hypot(*xy.T).min() >= 3.0 + spec_radius - 0.13
    gap = np.hypot(xy[:, :1] - moving.stems.x, xy[:, 1:] - moving.stems.y) - moving.stems.dbh_m / 2 - spec_radius
    assert gap.min() > 0.12
    np.testing.assert_allclose(walkers.tracks[:, 2], moving.ground_z(*xy.T), atol=1e-9)
    again = load_world("moving", seed=3).walkers
    assert again.tracks.tobytes() == walkers.tracks.tobytes()
    assert load_world("moving", seed=4).walkers.tracks.tobytes() != walkers.tracks.tobytes()


def test_walkers_change_nothing_that_stands():
    still, moved = (load_world("poisson", seed=5, options={"walkers": n}) for n in (0, 4))
    assert still.mesh.vertices.tobytes() == moved.mesh.vertices.tobytes()
    assert still.cones.tobytes() == moved.cones.tobytes()
    assert (len(still.walkers), len(moved.walkers)) == (0, 4)


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"walkers": 3, "walker_turns": 10, "clearing_m": 0}, "walkers"),
        ({"walker_speed_m_s": [2, 1]}, "walker_speed_m_s"),
        ({"walker_paths": [[[1, 1]]]}, "walker_paths"),
        ({"walker_speed_m_s": [0, 1]}, "walker_speed_m_s"),
    ],
)
def test_wrong_walkers_are_named(options, field):
    dense = {"stems_per_ha": 3000, "min_spacing_m": 0.5}
    with pytest.raises(InputError) as error:
        load_world("poisson", seed=1, options={**dense, **options})
    assert error.value.field == field


def test_a_ray_meets_the_cylinder_where_geometry_says(line):
    rng = np.random.default_rng(0)
    tables, hits = line.walkers.tables(), 0
    for _ in range(300):
        stamp = int(rng.integers(0, 40_000_000_000))
        feet = line.walkers.feet(stamp)[0]
        p = feet + rng.uniform([-6, -6, 0], [6, 6, 5])
        if math.hypot(*(p - feet)[:2]) < 0.5 and p[2] < 2.5:
            continue
        d = feet + rng.uniform([-0.6, -0.6, 0], [0.6, 0.6, 2.6]) - p
        d /= np.linalg.norm(d)
        far = nearest_walker(tables, np.concatenate([p, d]), stamp * 1e-9, math.inf)
        t = np.linspace(0, 15, 30_001)
        points = p + t[:, None] * d - feet
        inside = (np.hypot(points[:, 0], points[:, 1]) < 0.5) & (points[:, 2] < 2.5) & (points[:, 2] > 0)
        if inside.any():
            assert far == pytest.approx(t[np.argmax(inside)], abs=1e-3)
            hits += 1
        else:
            assert far > 15 or np.abs(np.hypot(*(p + far * d - feet)[:2]) - 0.5) < 1e-2
    assert hits > 150


def test_each_beam_sees_the_walker_at_its_own_time(line):
    lidar = Lidar(CLEAN, Mount(), Caster(line.mesh), line.mesh, 0, walkers=line.walkers)
    stamp = 3_000_000_000
    y = line.walkers.feet(stamp)[0, 1]
    p = np.tile([0.0, y, 1.5], (2, 1))
    scan = lidar.scan(p, np.tile(LEVEL, (2, 1)), stamp_ns=stamp, counter=0)
    points = scan.points_sensor.astype(float) + p[0]
    on = points[:, 2] > 0.3
    assert on.sum() > 20
    at = [line.walkers.feet(stamp - round(age * 1e9))[0] for age in scan.point_age_s[on].astype(float)]
    np.testing.assert_allclose(np.hypot(*(points[on] - at)[:, :2].T), 0.5, atol=1e-4)
    frozen = np.abs(np.hypot(*(points[on] - line.walkers.feet(stamp)[0])[:, :2].T) - 0.5)
    assert frozen.max() > 0.05


def test_the_range_finder_and_the_camera_see_a_walker_below(line):
    stamp = 2_000_000_000
    x, y, _ = line.walkers.feet(stamp)[0]
    down, above = np.array([0.0, 0.0, -1.0]), np.array([x, y, 4.0])
    assert line.range_to_surface(above, down) == pytest.approx(4.0)
    assert line.range_to_surface(above, down, stamp_ns=stamp) == pytest.approx(1.5)
    assert line.range_to_surface(above, down, stamp_ns=stamp + 10**9) == pytest.approx(4.0)
    c = SimConfig()
    bare = msgspec.structs.replace(c.camera, noise_sigma=0.0)
    with (
        InlineRenderer(line, c.lidar, bare, c.rig, seed=0) as sees,
        InlineRenderer(meadow(), c.lidar, bare, c.rig, seed=0) as empty,
    ):
        with_walker, without = (
            r.submit_camera(above - Rig().camera.p_body, LEVEL, stamp_ns=stamp, counter=0).result().pixels
            for r in (sees, empty)
        )
    rows, columns = np.nonzero(with_walker != without)
    assert 0.3 < len(rows) / (math.pi * (0.5 / 1.5 * 200) ** 2) < 2.0
    assert abs(rows.mean() - 120) < 15
    assert abs(columns.mean() - 160) < 15


def test_both_renderers_give_the_same_bytes(moving):
    c = SimConfig()
    p, q = np.tile([2.0, 1.0, 3.0], (2, 1)), np.tile(LEVEL, (2, 1))
    got = []
    for kind in (InlineRenderer, WorkerRenderer):
        with kind(moving, c.lidar, c.camera, c.rig, seed=1) as renderer:
            scan = renderer.submit_lidar(p, q, stamp_ns=10**9, counter=9, part=1, parts=5).result()
            frame = renderer.submit_camera(p[0], q[0], stamp_ns=10**9, counter=3).result()
        got.append((scan.points_sensor.tobytes(), scan.miss_dirs_sensor.tobytes(), frame.pixels.tobytes()))
    assert got[0] == got[1]


def vehicle_over(world, p):
    obstacles = Obstacles(
        cones=world.cones, kinds=world.kinds, heights=world.heights, origin_xy=world.origin_xy, cell_m=world.cell_m,
        walkers=world.walkers,
    )  # fmt: skip
    return Vehicle(load_params(), p_world=np.array(p), yaw=0.0, obstacles=obstacles, wind=WindConfig(), seed=0)


def test_a_walker_that_walks_into_the_standing_aircraft_is_a_contact():
    world = meadow(walker_paths=[[[6, 0.02], [-6, 0.02]]], walker_speed_m_s=[1.0, 1.0])
    vehicle = vehicle_over(world, [0.0, 0.0, 0.0])
    x_before, nearest = None, REACH_M
    while not vehicle.contact and vehicle.time_ns < 30_000_000_000:
        x_before = world.walkers.feet(vehicle.time_ns)[0, 0]
        vehicle.step(np.zeros(4), 8)
        nearest = min(nearest, vehicle.take_min_clearance())
    assert vehicle.contact == "walker"
    assert nearest <= 0.0
    spheres = hull_spheres(load_params())
    widest = (np.hypot(spheres[:, 0], spheres[:, 1]) + spheres[:, 3]).max()
    assert abs(x_before) <= widest + 0.5 + 0.02


def test_clearance_is_that_of_the_nearest_hull_sphere():
    world = meadow(walker_paths=[[[3, 0], [3, 1e-3]]], walker_speed_m_s=[1e-3, 1e-3])
    vehicle = vehicle_over(world, [0.0, 0.0, 0.0])
    vehicle.step(np.zeros(4), 1)
    centres = Rotation.from_quat(vehicle.q_world_body, scalar_first=True).apply(hull_spheres(load_params())[:, :3])
    centres += vehicle.p_world
    reach = np.hypot(centres[:, 0] - 3.0, centres[:, 1]) - hull_spheres(load_params())[:, 3] - 0.5
    assert vehicle.take_min_clearance() == pytest.approx(reach.min(), abs=2e-3)
