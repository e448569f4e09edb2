"""The direct camera: derivatives, known motion, brightness, bad images, honesty, repetition."""

import hashlib
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from scipy.linalg import eigh
from scipy.ndimage import gaussian_filter, uniform_filter
from scipy.spatial.transform import Rotation

from companion.core import topics
from companion.core.geometry import exp_so3, log_so3
from companion.core.rig import Rig
from companion.estimation import patches, photometric
from companion.estimation.camera import CameraConfig
from companion.estimation.config import EstimationConfig
from companion.estimation.direct_camera import DirectCamera, _marginal
from companion.estimation.filter import Filter
from companion.estimation.lio_node import LioNode
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneConfig
from companion.estimation.state import State
from companion.estimation.warm_up import warm_up
from tests.unit.estimation.synthetic import Ground, record
from tests.unit.estimation.test_flight import aligned_rms, run

RIG = Rig()
MOUNT = (np.ascontiguousarray(RIG.camera.R_body_sensor), RIG.camera.p_body)
INTRINSICS = np.array([RIG.pinhole.focal_px, *RIG.pinhole.center_px])
DIRECT = EstimationConfig(camera=CameraConfig(method="direct"))
FIRST = (exp_so3(np.array([0.03, -0.02, 0.5])), np.array([0.4, -0.3, 2.5]))
SECOND = (FIRST[0] @ exp_so3(np.array([0.01, 0.015, 0.03])), FIRST[1] + [0.06, -0.05, 0.04])


@pytest.fixture(scope="module")
def ground():
    texture = Ground()
    smooth = gaussian_filter(texture.texture, 1.0, mode="wrap")
    texture.texture = 128 + 40 * (smooth - smooth.mean()) / smooth.std()
    return texture


@pytest.fixture(scope="module")
def plain():
    """The map of z = 0, 12 x 12 m."""
    grid = np.arange(-6, 6, 0.16) + 0.08
    x, y = np.meshgrid(grid, grid)
    target = PointMap(PointMapConfig())
    points = np.column_stack([x.ravel(), y.ravel(), 0.0 * x.ravel()])
    target.insert(points.astype(np.float32), np.eye(3), np.zeros(3))
    return target


def picture(ground, pose, seed=0):
    still = SimpleNamespace(pose=lambda t: (Rotation.from_matrix(pose[0][None]), pose[1][None]))
    return ground.image(still, 0.0, RIG, np.random.default_rng(seed)).pixels


def filter_at(pose, *, turn_rad=0.05, shift_m=0.15):
    state = State.at_rest(9.80665)
    state.R[:], state.p[:] = pose
    P = np.eye(18) * 1e-4
    P[:3, :3], P[3:6, 3:6] = np.eye(3) * turn_rad**2, np.eye(3) * shift_m**2
    return Filter(state, P, 0.0)


def begun(ground, plain, lidar_hold=lambda: 0.0):
    """A camera that has seen the ground from FIRST."""
    camera = DirectCamera(CameraConfig(method="direct"), RIG, lidar_hold)
    assert camera.update(picture(ground, FIRST), filter_at(FIRST), plain, PlaneConfig()) is None
    return camera


def error_of(state, pose):
    return np.concatenate([log_so3(state.R.T @ pose[0]), pose[1] - state.p])


def error_px(state, pose):
    """rms over the ground in view, between where it is seen and where the state has it."""
    grid = np.arange(-1.0, 1.01, 0.25)
    x, y = np.meshgrid(grid, grid)
    points = np.column_stack([x.ravel() + pose[1][0], y.ravel() + pose[1][1], 0.0 * x.ravel()])
    seen, had = (np.array([projected(q, *at)[0] for q in points]) for at in (pose, (state.R, state.p)))
    return np.sqrt(((seen - had) ** 2).sum(axis=1).mean())


def projected(point, R, p):
    pixel, J, Q = np.empty(2), np.empty((2, 6)), np.empty((2, 3))
    assert photometric.project(point, R, p, MOUNT, INTRINSICS, pixel, J, Q) > 0
    return pixel, J, Q


def test_projection_and_its_jacobians_are_the_finite_differences():
    rng = np.random.default_rng(1)
    R, p = FIRST
    for point in np.column_stack([p[:2] + rng.uniform(-1.5, 1.5, (20, 2)), rng.normal(0, 0.1, 20)]):
        pixel, J, Q = projected(point, R, p)
        optical = ((point - p) @ R - MOUNT[1]) @ MOUNT[0]
        np.testing.assert_allclose(pixel, INTRINSICS[0] * optical[:2] / optical[2] + INTRINSICS[1:], atol=1e-9)
        h = 1e-6
        moved = [(projected(point, R @ exp_so3(h * e[:3]), p + h * e[3:])[0] - pixel) / h for e in np.eye(6)]
        np.testing.assert_allclose(J, np.transpose(moved), atol=0.01)
        shifted = [(projected(point + h * e, R, p)[0] - pixel) / h for e in np.eye(3)]
        np.testing.assert_allclose(Q, np.transpose(shifted), atol=0.01)


def test_gradient_is_that_of_the_residuals(ground, plain):
    """Far gates and weights: g = H dx to first order, so the pose that g leads to is the true one."""
    camera = begun(ground, plain)
    images = patches.pyramid(picture(ground, FIRST, seed=5), 3, 0.8)
    for axis in range(6):
        dx = np.eye(6)[axis] * (0.002 if axis < 3 else 0.004)
        fate = np.zeros(len(camera._patches), np.int8)
        pose = (FIRST[0] @ exp_so3(dx[:3]), FIRST[1] + dx[3:])
        normal = camera._linearise(images, 0, pose, 1e9, fate)
        assert normal.used > 40
        state = filter_at(pose).state
        before = error_px(state, FIRST)
        state.retract(np.concatenate([np.linalg.solve(normal.H, normal.g), np.zeros(12)]))
        assert error_px(state, FIRST) < max(0.1 * before, 0.05)
        np.testing.assert_allclose(normal.H, normal.H.T, rtol=1e-9, atol=1e-6)


def test_tangents_are_the_way_along_the_plane_per_pixel(ground, plain):
    camera = begun(ground, plain)
    centres, tangents = camera._patches.centres, camera._patches.tangents
    np.testing.assert_allclose(centres[:, 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(tangents[:, 2], 0.0, atol=1e-6)
    for centre, T in zip(centres, tangents, strict=True):
        pixel = projected(centre, *FIRST)[0]
        for du, dv in ((4, 0), (0, 4), (-4, 4)):
            at = projected(centre + T @ [du, dv], *FIRST)[0]
            np.testing.assert_allclose(at - pixel, [du, dv], atol=0.02)


def test_gain_and_offset_are_projected_out(ground, plain):
    q = begun(ground, plain)._patches
    np.testing.assert_allclose(q.slopes.sum(axis=2), 0.0, atol=1e-6)
    along = np.einsum("nlj,nlja->nla", q.pictures, q.slopes)
    np.testing.assert_allclose(along, 0.0, atol=1e-6 * q.energy.max())


def test_finds_the_motion_between_two_images(ground, plain):
    camera, filter_ = begun(ground, plain), filter_at(FIRST)
    normal = camera.update(picture(ground, SECOND, seed=1), filter_, plain, PlaneConfig())
    assert normal.used > 40
    off = error_of(filter_.state, SECOND)
    assert error_px(filter_at(FIRST).state, SECOND) > 4.0
    assert error_px(filter_.state, SECOND) < 0.1
    assert np.abs(off[:3]).max() < 1.5e-3
    assert np.linalg.norm(off[3:]) < 4e-3  # turn and shift may trade: 1 mrad is 2.5 mm on the ground


@pytest.mark.parametrize(("gain", "offset"), [(0.6, 0.0), (1.4, -50.0), (0.8, 45.0)])
def test_exposure_moves_nothing(ground, plain, gain, offset):
    image = picture(ground, SECOND, seed=1)
    other = np.clip(image * gain + offset + 0.5, 0, 255).astype(np.uint8)
    poses = []
    for pixels in (image, other):
        filter_ = filter_at(FIRST)
        begun(ground, plain).update(pixels, filter_, plain, PlaneConfig())
        poses.append((filter_.state.R, filter_.state.p))
    assert error_px(filter_.state, poses[0]) < 0.05


def test_what_covers_the_ground_is_left_out(ground, plain):
    image = picture(ground, SECOND, seed=1).copy()
    image[:, 220:] = np.random.default_rng(3).integers(0, 255, (image.shape[0], 100))
    camera, filter_ = begun(ground, plain), filter_at(FIRST)
    normal = camera.update(image, filter_, plain, PlaneConfig())
    assert 10 < normal.used < 0.8 * normal.offered
    assert error_px(filter_.state, SECOND) < 0.2


@pytest.mark.parametrize("spoil", ["dark", "blurred", "frozen"])
def test_bad_images_are_dropped_at_once_and_move_nothing(ground, plain, spoil):
    camera, filter_ = begun(ground, plain), filter_at(FIRST)
    camera.update(picture(ground, SECOND, seed=1), filter_, plain, PlaneConfig())
    before = filter_.state.x.copy(), filter_.P.copy()
    last = picture(ground, SECOND, seed=1)
    for k in range(3):
        image = picture(ground, SECOND, seed=2 + k)
        bad = {"dark": (image * 0.02).astype(np.uint8), "blurred": uniform_filter(image, (1, 25)), "frozen": last}
        assert camera.update(bad[spoil], filter_, plain, PlaneConfig()) is None
        assert camera.objection == f"camera {spoil}"
        np.testing.assert_array_equal(filter_.state.x, before[0])
        np.testing.assert_array_equal(filter_.P, before[1])
    normal = camera.update(picture(ground, SECOND, seed=9), filter_, plain, PlaneConfig())
    assert normal.used > 40
    assert error_px(filter_.state, SECOND) < 0.1


def test_patches_outlive_a_second_of_bad_images_and_no_more(ground, plain):
    camera, filter_ = begun(ground, plain), filter_at(FIRST)
    frozen = picture(ground, FIRST)
    for _ in range(camera.config.direct.keep_images):
        camera.update(frozen, filter_, plain, PlaneConfig())
    assert len(camera._patches) > 40
    camera.update(frozen, filter_, plain, PlaneConfig())
    assert len(camera._patches) == 0


def test_another_place_moves_nothing(ground, plain):
    """Not a patch of it is known: the pose stays, and after three images there are new patches."""
    camera, filter_ = begun(ground, plain), filter_at(FIRST, turn_rad=1e-3, shift_m=0.01)
    far = (FIRST[0], FIRST[1] + [2.0, 0.0, 0.0])
    for k in range(3):
        assert camera.update(picture(ground, far, seed=k), filter_, plain, PlaneConfig()) is None
    np.testing.assert_array_equal(filter_.state.p, FIRST[1])
    assert camera.update(picture(ground, far, seed=7), filter_, plain, PlaneConfig()).used > 40


def test_a_sweep_that_moved_the_prior_far_does_not_lose_the_patches(ground, plain):
    """0.4 m are 32 px: too far to find from there, but not from where the last image was."""
    camera = begun(ground, plain)
    filter_ = filter_at((FIRST[0], FIRST[1] + [0.4, 0.0, 0.0]), shift_m=1.0)
    normal = camera.update(picture(ground, FIRST, seed=3), filter_, plain, PlaneConfig())
    assert normal.used > 40
    assert error_px(filter_.state, FIRST) < 0.1


def test_information_is_honest_when_the_map_is_wrong(ground, plain):
    """Depths off by their sigmas, each and all together: NEES per degree of freedom of the pose by the image alone."""
    nees, c = [], CameraConfig().direct
    for seed in range(15):
        camera, rng = begun(ground, plain), np.random.default_rng(seed)
        q, filter_ = camera._patches, filter_at(FIRST)
        height, slopes = rng.normal(0, c.sigma_height_m), rng.normal(0, c.sigma_slope, 2)
        together = (height + (q.centres[:, :2] - FIRST[1][:2]) @ slopes) / q.rays[:, 2]
        q.centres += q.rays * (together + rng.normal(0, c.sigma_depth_m, len(q)))[:, None]
        normal = camera.update(picture(ground, SECOND, seed=seed), filter_, plain, PlaneConfig())
        off = error_of(filter_.state, SECOND)
        nees.append(off @ normal.H @ off / 6)
    assert 0.3 < c.inflation * np.mean(nees) < 2.5


def test_the_ground_as_a_whole_is_marginalised():
    rng = np.random.default_rng(4)
    S, truth, sigmas = rng.normal(size=(30, 9)), rng.normal(size=9), np.array([0.1, 0.2, 0.3])
    H, g = S.T @ S, S.T @ S @ truth
    joint = H + np.diag(np.concatenate([np.zeros(6), sigmas**-2]))
    marginal, gradient = _marginal(H, g, sigmas)
    np.testing.assert_allclose(np.linalg.inv(marginal), np.linalg.inv(joint)[:6, :6], atol=1e-9)
    np.testing.assert_allclose(np.linalg.solve(marginal, gradient), np.linalg.solve(joint, g)[:6], atol=1e-9)


def test_it_knows_how_high_it_is_above_the_ground(ground, plain):
    state = filter_at(FIRST).state
    state.p[2] += 0.2
    height = state.p[2] + (state.R @ MOUNT[1])[2]
    assert begun(ground, plain).above_m(state) == pytest.approx(height, abs=0.01)


def test_it_yields_to_a_lidar_that_holds_every_axis(ground, plain):
    """Twice the inflation where a sweep's smallest eigenvalue is `yield_above`: never less than half is left."""
    hold = [0.0]
    camera, normals = begun(ground, plain, lambda: hold[0]), []
    for seed, hold[0] in enumerate((0.0, CameraConfig().direct.yield_above)):
        camera.update(picture(ground, FIRST, seed=3 + seed), filter_at(FIRST), plain, PlaneConfig())
        images = patches.pyramid(picture(ground, SECOND, seed=1), 1, 0.8)
        normals.append(camera._linearise(images, 0, SECOND, 100.0, np.zeros(len(camera._patches), np.int8)))
    left = eigh(normals[1].H, normals[0].H, eigvals_only=True)
    assert left[0] > 0.499
    assert left[0] < 0.55
    assert left[-1] < 1.0


def test_same_bytes_twice_and_the_lidar_is_outdone():
    """A plain, LiDAR to 8 m: nothing but the camera sees horizontal motion."""
    truth, events = record(8.0, camera=True, forest=False, max_range=8.0)
    states = [run(events, config=DIRECT, nodes=[LioNode(DIRECT, RIG)])[topics.LIO_STATE.name] for _ in range(2)]
    digests = [hashlib.sha256(b"".join(s.p_odom.tobytes() + s.covariance.tobytes() for s in of)) for of in states]
    assert digests[0].hexdigest() == digests[1].hexdigest()
    assert sum(s.source == "camera" for s in states[0]) > 60
    assert aligned_rms(truth, states[0]) < 0.05


def test_nothing_compiles_after_the_warm_up():
    warm_up(DIRECT, RIG)
    kernels = (photometric.linearise, patches._cut)
    before = [len(k.signatures) for k in kernels]
    assert min(before) >= 1
    _, events = record(3.0, camera=True)
    run(events, config=DIRECT, nodes=[LioNode(DIRECT, RIG)])
    assert [len(k.signatures) for k in kernels] == before


@pytest.mark.parametrize(
    ("text", "says"),
    [("method: orb", "Invalid enum value 'orb'"), ("direct: {half_px: 1}", ">= 2"), ("direct: {patch: 1}", "patch")],
)
def test_bad_values_are_named(text, says):
    with pytest.raises(msgspec.ValidationError, match=says):
        msgspec.yaml.decode(text, type=CameraConfig)
