"""The camera projects the photograph where the pinhole says, and moves it as the motion says."""

import cv2
import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from companion.core.rig import Mount, Rig
from sim.sensors.camera import Camera, CameraConfig
from sim.sensors.caster import Caster
from sim.sensors.texture import TILE_PX, load_tile, mip_levels
from sim.world import load_world
from sim.world.mesh import GROUND

CLEAN = CameraConfig(noise_sigma=0.0, vignetting=0.0)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
RIG = Rig()


@pytest.fixture(scope="module")
def meadow():
    world = load_world("empty", seed=1, options={"roughness_m": 0.0})
    return world, Caster(world.mesh)


def make(place, config=CLEAN, mount=RIG.camera, seed=0):
    world, caster = place
    return Camera(config, mount, RIG.pinhole, caster=caster, mesh=world.mesh, seed=seed)


def ground_points(p, q, mount=RIG.camera):
    """Where the centres of all pixels meet the plane z = 0; written apart from the product's code."""
    u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
    dirs = np.stack([(u - 160) / 200, (v - 120) / 200, np.ones_like(u)], axis=-1)
    R = Rotation.from_quat(q, scalar_first=True)
    origin = np.asarray(p) + R.apply(mount.p_body)
    beams = R.apply(dirs.reshape(-1, 3) @ mount.R_body_sensor.T)
    return (origin - beams * (origin[2] / beams[:, 2])[:, None]).reshape(240, 320, 3)


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0, 0.0), (8.0, -11.0, 70.0)])
def test_every_pixel_shows_the_ground_point_that_it_looks_at(meadow, tilt_deg):
    p = np.array([1.3, -0.7, 1.6])  # below 2 m a pixel is smaller than a texel: no mip level blends in
    q = Rotation.from_euler("xyz", tilt_deg, degrees=True).as_quat(scalar_first=True)
    image = make(meadow).frame(p, q, stamp_ns=5, counter=0)
    assert image.stamp_ns == 5
    ground = ground_points(p, q)
    at = ((ground[..., :2] * 100 + 512) % TILE_PX - 0.5).astype(np.float32)
    expected = cv2.remap(load_tile(), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    near = np.linalg.norm(ground[..., :2] - p[:2], axis=-1) < 1.9
    error = np.abs(image.pixels.astype(float) - expected)[near]
    assert near.mean() > 0.9
    assert np.quantile(error, 0.99) <= 3.0
    assert error.mean() < 0.7


def test_the_top_of_the_image_is_ahead_and_its_right_is_the_right(meadow):
    ground = ground_points([0.0, 0.0, 5.0], LEVEL)
    assert ground[0, 160, 0] > ground[239, 160, 0]
    assert ground[120, 0, 1] > ground[120, 319, 1]
    camera = make(meadow)
    here = camera.frame(np.array([0.0, 0.0, 2.0]), LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    depth = 2.0 + RIG.camera.xyz_m[2]
    step = 10 * depth / 200  # metres for 10 px
    ahead = camera.frame(np.array([step, 0.0, 2.0]), LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    left = camera.frame(np.array([0.0, step, 2.0]), LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    assert np.abs(ahead[10:] - here[:-10]).mean() < 1.0  # flying ahead, the ground moves down the image
    assert np.abs(left[:, 10:] - here[:, :-10]).mean() < 1.0  # flying to the left, it moves to the right
    assert np.abs(ahead - here).mean() > 10.0


def test_yaw_turns_the_image_about_the_camera(meadow):
    mount = msgspec.structs.replace(RIG.camera, xyz_m=(0.0, 0.0, 0.0))
    camera = make(meadow, mount=mount)
    half = np.array([0.0, 0.0, 0.0, 1.0])
    p = np.array([2.0, 1.0, 2.0])
    one = camera.frame(p, LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    turned = camera.frame(p, half, stamp_ns=0, counter=0).pixels.astype(float)
    assert np.abs(turned[::-1, ::-1] - one).mean() < 0.6


def test_noise_vignette_and_gain(meadow):
    p = np.array([0.0, 0.0, 3.0])
    clean = make(meadow).frame(p, LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    config = msgspec.structs.replace(CLEAN, noise_sigma=3.0)
    noisy = make(meadow, config).frame(p, LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    assert (noisy - clean).std() == pytest.approx(3.0, rel=0.05)
    other = make(meadow, config).frame(p, LEVEL, stamp_ns=0, counter=1).pixels.astype(float)
    assert (noisy - other).std() == pytest.approx(3.0 * np.sqrt(2), rel=0.05)
    shaded = make(meadow, msgspec.structs.replace(CLEAN, vignetting=0.4))
    dim = shaded.frame(p, LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    assert dim[:4, :4].sum() / clean[:4, :4].sum() == pytest.approx(0.6, abs=0.03)
    assert dim[118:122, 158:162].sum() / clean[118:122, 158:162].sum() == pytest.approx(1.0, abs=0.03)
    assert not make(meadow).frame(p, LEVEL, stamp_ns=0, counter=0, gain=0.0).pixels.any()


def test_far_ground_is_averaged_not_aliased(meadow):
    """From 16 m a pixel covers 8 texels: the image's contrast is that of the photograph's third mip level."""
    camera = make(meadow)
    pixels = camera.frame(np.array([0.0, 0.0, 16.05]), LEVEL, stamp_ns=0, counter=0).pixels
    flat, starts = mip_levels(load_tile())
    third = flat[starts[3] : starts[4]]
    assert pixels.std() == pytest.approx(third.std(), rel=0.15)
    assert pixels.std() < 0.9 * load_tile().std()


def test_depth_of_the_cheap_cast_equals_a_ray_per_pixel():
    world = load_world("poisson", seed=1, options={"branches": 20, "stems_per_ha": 800, "roughness_m": 0.3})
    caster = Caster(world.mesh)
    camera = make((world, caster))
    R = RIG.camera.R_body_sensor
    for k, p in enumerate(np.random.default_rng(2).uniform(-30, 30, (4, 3))):
        p[2] = float(world.ground_z(p[0], p[1])) + 2.5 + 2 * k
        depth, triangle = camera._surfaces(R, p)
        u, v = np.meshgrid(np.arange(320) + 0.5, np.arange(240) + 0.5)
        dirs = np.stack([(u - 160) / 200, (v - 120) / 200, np.ones_like(u)], axis=-1).reshape(-1, 3)
        far, ids = caster.cast(np.column_stack([np.tile(p, (len(dirs), 1)), dirs @ R.T]).astype(np.float32))
        same = world.mesh.classes[triangle.ravel()] == world.mesh.classes[ids]
        assert same.mean() > 0.99  # what differs is thinner than the 2 px of the first cast
        ground = same & (world.mesh.classes[ids] == GROUND)
        assert np.quantile(np.abs(depth.ravel() / far - 1)[ground], 0.999) < 2e-3


def test_a_camera_may_sit_anywhere(meadow):
    mount = Mount(xyz_m=(0.3, -0.2, 0.1), rpy_deg=(180.0, 20.0, -60.0))
    p = np.array([0.5, 0.5, 1.5])
    image = make(meadow, mount=mount).frame(p, LEVEL, stamp_ns=0, counter=0).pixels.astype(float)
    ground = ground_points(p, LEVEL, mount)
    at = ((ground[..., :2] * 100 + 512) % TILE_PX - 0.5).astype(np.float32)
    expected = cv2.remap(load_tile(), at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
    near = np.linalg.norm(ground - p, axis=-1) < 1.9
    assert np.abs(image - expected)[near].mean() < 0.8
