"""The LiDAR's laws: exact ranges without noise, noise as stated, motion distortion, misses."""

import math

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from companion.core.rig import Mount, Rig
from sim.sensors.caster import Caster
from sim.sensors.lidar import Lidar, LidarConfig, knot_stamps
from sim.sensors.patterns import rosette_pattern
from sim.world import load_world
from sim.world.mesh import BRANCH

CLEAN = LidarConfig(
    range_sigma_m=0.0, range_sigma_per_m=0.0, angle_sigma_deg=0.0, divergence_mrad=0.0, dropout=0.0,
    body_radius_m=0.0, miss_stride=1,
)  # fmt: skip
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
CENTER = Mount()


@pytest.fixture(scope="module")
def forest():
    world = load_world("poisson", seed=1, options={"branches": 10})
    return world, Caster(world.mesh)


@pytest.fixture(scope="module")
def meadow():
    world = load_world("empty", seed=1, options={"roughness_m": 0.0, "size_m": 200.0})
    return world, Caster(world.mesh)


def still(p, q=LEVEL, knots=2):
    return np.tile(p, (knots, 1)).astype(float), np.tile(q, (knots, 1)).astype(float)


def make(place, config=CLEAN, mount=CENTER, seed=0):
    world, caster = place
    return Lidar(config, mount, caster, world.mesh, seed)


def both(scan):
    return np.vstack([scan.points_sensor, scan.miss_dirs_sensor])


def test_a_still_sweep_is_a_cast_from_one_pose(forest):
    rig = Rig()
    p, q = np.array([1.0, 2.0, 2.5]), Rotation.from_euler("xyz", [0.1, -0.2, 0.7]).as_quat(scalar_first=True)
    scan = make(forest, mount=rig.lidar).scan(*still(p, q), stamp_ns=10**9, counter=4)
    dirs, phases = rosette_pattern(20_000, 0.1, 4, (-7.0, 52.0))
    R = Rotation.from_quat(q, scalar_first=True)
    origin = p + R.apply(rig.lidar.p_body)
    beams = R.apply(dirs @ rig.lidar.R_body_sensor.T)
    far, _ = forest[1].cast(np.column_stack([np.tile(origin, (len(dirs), 1)), beams]).astype(np.float32))
    hit = (far <= 40.0) & (far >= 0.2)
    assert len(scan.points_sensor) == hit.sum()
    np.testing.assert_allclose(scan.points_sensor, far[hit, None] * dirs[hit], atol=2e-3)
    np.testing.assert_allclose(scan.point_age_s, 0.1 * (1 - phases[hit]), atol=1e-7)
    np.testing.assert_array_equal(scan.miss_dirs_sensor, dirs[far > 40.0])


def test_a_moving_sweep_deskews_onto_the_world(meadow):
    """Points put back through the pose at their own time lie on the ground; through one pose they do not."""
    stamps = knot_stamps(CLEAN, 10**9)
    assert stamps[0] == 900_000_000
    assert stamps[-1] == 10**9
    t = (stamps - stamps[0]) * 1e-9
    p = np.column_stack([6.0 * t, 0.0 * t, 3.0 + 2.0 * t])
    R = Rotation.from_rotvec(np.column_stack([0 * t, 1.5 * t, 2.0 * t]))
    mount = Mount(xyz_m=(0.1, 0.0, 0.1), rpy_deg=(0.0, 25.0, 0.0))
    scan = make(meadow, mount=mount).scan(p, R.as_quat(scalar_first=True), stamp_ns=10**9, counter=0)
    at = 0.1 - scan.point_age_s.astype(float)
    body = scan.points_sensor @ mount.R_body_sensor.T + mount.p_body
    near = np.linalg.norm(body, axis=1) < 15.0
    moved = Slerp(t, R)(at).apply(body) + np.column_stack([np.interp(at, t, p[:, k]) for k in range(3)])
    frozen = R[-1].apply(body) + p[-1]
    assert near.sum() > 500
    assert np.abs(moved[near, 2]).max() < 2e-3
    assert np.abs(frozen[near, 2]).max() > 0.3


def test_range_to_a_plane_has_the_stated_noise(meadow):
    config = msgspec.structs.replace(CLEAN, range_sigma_m=0.02, range_sigma_per_m=0.001)
    down = Mount(rpy_deg=(0.0, 90.0, 0.0))
    lidar, exact = make(meadow, config, down), make(meadow, CLEAN, down)
    p, q = still([0.0, 0.0, 10.0])
    pairs = [(lidar.scan(p, q, stamp_ns=0, counter=k), exact.scan(p, q, stamp_ns=0, counter=k)) for k in range(3)]
    noisy = np.concatenate([np.linalg.norm(a.points_sensor, axis=1) for a, _ in pairs])
    true = np.concatenate([np.linalg.norm(b.points_sensor, axis=1) for _, b in pairs])
    for low, high in ((10.0, 12.0), (25.0, 35.0)):
        part = (true > low) & (true < high)
        error = noisy[part] - true[part]
        sigma = math.hypot(0.02, 0.001 * true[part].mean())
        assert abs(error.mean()) < 4 * sigma / math.sqrt(part.sum())
        assert error.std() == pytest.approx(sigma, rel=0.05)


def test_reported_directions_have_the_stated_noise(meadow):
    config = msgspec.structs.replace(CLEAN, angle_sigma_deg=0.1)
    p, q = still([0.0, 0.0, 2.0])
    noisy = make(meadow, config).scan(p, q, stamp_ns=0, counter=1).points_sensor.astype(float)
    exact = make(meadow).scan(p, q, stamp_ns=0, counter=1).points_sensor.astype(float)
    angle = np.linalg.norm(np.cross(noisy, exact), axis=1) / np.linalg.norm(exact, axis=1) ** 2
    assert np.sqrt(np.mean(angle**2)) == pytest.approx(math.radians(0.1) * math.sqrt(2), rel=0.05)


def test_the_rosette_never_repeats_and_is_a_function_of_its_counter():
    one, _ = rosette_pattern(20_000, 0.1, 7, (-7.0, 52.0))
    again, _ = rosette_pattern(20_000, 0.1, 7, (-7.0, 52.0))
    other, phases = rosette_pattern(20_000, 0.1, 8, (-7.0, 52.0))
    np.testing.assert_array_equal(one, again)
    assert np.linalg.norm(one - other, axis=1).mean() > 0.02
    np.testing.assert_allclose(np.linalg.norm(other, axis=1), 1.0, atol=1e-6)
    elevation = np.degrees(np.arcsin(other[:, 2]))
    assert elevation.min() > -7.01
    assert elevation.max() < 52.01
    assert np.all(np.diff(phases) > 0)
    every = np.histogram2d(np.arctan2(other[:, 1], other[:, 0]), elevation, bins=(36, 6))[0]
    assert every.min() > 0.6 * every.mean()  # even over the field of view


def test_sweeps_together_see_more_than_one_sweep():
    def cells(counters):
        d = np.vstack([rosette_pattern(20_000, 0.1, k, (-7.0, 52.0))[0] for k in counters])
        degrees = np.degrees([np.arctan2(d[:, 1], d[:, 0]), np.arcsin(d[:, 2])]) * 2
        return len(np.unique(np.floor(degrees).astype(int), axis=1).T)

    assert cells(range(5)) > 2.5 * cells([0])


def test_spin64_fires_column_by_column_between_its_elevations(meadow):
    config = msgspec.structs.replace(CLEAN, pattern="spin64", columns=256)
    scan = make(meadow, config).scan(*still([0.0, 0.0, 2.0]), stamp_ns=0, counter=0)
    assert len(both(scan)) == 64 * 256
    elevation = np.arcsin(both(scan)[:, 2] / np.linalg.norm(both(scan), axis=1))
    assert np.degrees(elevation.min()) == pytest.approx(-22.5, abs=1e-3)
    assert np.degrees(elevation.max()) == pytest.approx(22.5, abs=1e-3)
    assert len(np.unique(scan.point_age_s)) == 256


def test_what_is_lost_is_neither_point_nor_miss(forest):
    p, q = still([0.0, 0.0, 2.5])
    full = make(forest).scan(p, q, stamp_ns=0, counter=0)
    lossy = make(forest, msgspec.structs.replace(CLEAN, dropout=0.3)).scan(p, q, stamp_ns=0, counter=0)
    assert len(lossy.points_sensor) == pytest.approx(0.7 * len(full.points_sensor), rel=0.03)
    np.testing.assert_array_equal(lossy.miss_dirs_sensor, full.miss_dirs_sensor)
    faulty = make(forest).scan(p, q, stamp_ns=0, counter=0, lost_fraction=0.3)
    np.testing.assert_array_equal(faulty.points_sensor, lossy.points_sensor)
    strided = make(forest, msgspec.structs.replace(CLEAN, miss_stride=4)).scan(p, q, stamp_ns=0, counter=0)
    np.testing.assert_array_equal(strided.miss_dirs_sensor, full.miss_dirs_sensor[::4])


def test_dust_returns_near_and_takes_its_share(forest):
    p, q = still([0.0, 0.0, 2.5])
    scan = make(forest).scan(p, q, stamp_ns=0, counter=0, dust_fraction=0.2)
    clear = make(forest).scan(p, q, stamp_ns=0, counter=0)

    def near(s):
        return np.count_nonzero(np.linalg.norm(s.points_sensor, axis=1) < 1.9)

    assert near(scan) - near(clear) > 0.1 * 20_000
    assert np.linalg.norm(scan.points_sensor, axis=1).min() >= 0.5


def test_beams_into_the_own_body_say_nothing(meadow):
    mount = Mount(xyz_m=(0.0, 0.0, 0.1), rpy_deg=(0.0, 60.0, 0.0))
    config = msgspec.structs.replace(CLEAN, body_radius_m=0.2)
    scan = make(meadow, config, mount).scan(*still([0.0, 0.0, 5.0]), stamp_ns=0, counter=0)
    beams = both(scan) @ mount.R_body_sensor.T
    steep = np.arctan2(-beams[:, 2], np.hypot(beams[:, 0], beams[:, 1]))
    assert steep.max() < math.atan2(0.1, 0.2) + 1e-3
    open_scan = make(meadow, CLEAN, mount).scan(*still([0.0, 0.0, 5.0]), stamp_ns=0, counter=0)
    assert len(both(scan)) < 0.85 * len(both(open_scan))


def test_thin_branches_fade_with_range(tmp_path):
    """Beams at 2 cm sticks: all return at 4 m, a quarter at 13 m, by (d / (3 mrad r))^2."""
    rows = [f"{x:.1f},0.0,0.3,15" for x in (-12.0, -5.0, 5.0, 13.0)]
    (tmp_path / "s.csv").write_text("x_m,y_m,dbh_m,h_m\n" + "\n".join(rows) + "\n0,-30,0.3,15\n0,30,0.3,15\n")
    options = {
        "branches": 400, "branch_diameter_m": [0.0267, 0.0267], "branch_length_m": [3.0, 3.0], "crown": False,
        "branch_height_m": [1.0, 12.0], "start_m": [0.0, 0.0], "clearing_m": 1.5,
    }  # fmt: skip
    world = load_world(f"stems:{tmp_path}/s.csv", seed=0, options=options)
    place = world, Caster(world.mesh)
    beam = msgspec.structs.replace(CLEAN, divergence_mrad=3.0)
    dirs, _ = rosette_pattern(20_000, 0.1, 0, (-7.0, 52.0))
    p, q = still([0.0, 0.0, 3.0])
    far, ids = place[1].cast(np.column_stack([np.tile(p[0], (len(dirs), 1)), dirs]).astype(np.float32))
    hit = far < 40.0
    dirs, far, ids = dirs[hit], far[hit], ids[hit]
    thin = world.mesh.classes[ids] == BRANCH
    scan = make(place, beam).scan(p, q, stamp_ns=0, counter=0)
    got = {tuple(v) for v in np.round(scan.points_sensor, 3)}
    kept = np.array([tuple(v) in got for v in np.round(far[:, None] * dirs, 3)])
    for low, high in ((1.0, 5.0), (10.0, 16.0)):
        part = thin & (far > low) & (far < high)
        expected = np.minimum(1.0, 0.02 / (0.003 * far[part])) ** 2
        assert part.sum() > 100
        assert kept[part].mean() == pytest.approx(expected.mean(), abs=0.08)
