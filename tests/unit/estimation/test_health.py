"""What the estimator says of itself: health, map error, images, gaps of the IMU, search after a gap."""

import numpy as np
import pytest
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation

from companion.estimation.fit_watch import FitWatch
from companion.estimation.health import HealthConfig, judge
from companion.estimation.image_gate import ImageGate, ImageGateConfig
from companion.estimation.imu_doubt import ImuDoubt, ImuDoubtConfig
from companion.estimation.map_error import MapError
from companion.estimation.normal import Normal
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.search import SearchConfig, few_of, search
from companion.estimation.start import StartConfig, start_filter
from companion.estimation.state import State

REST = np.tile([0, 0, 0, 0, 0, 9.80665], (200, 1))


@pytest.mark.parametrize(
    ("sigma_m", "age_s", "doubts", "state"),
    [
        (0.05, 0.1, "", "nominal"),
        (0.05, 0.5, "", "degraded"),
        (0.4, 0.1, "", "degraded"),
        (0.05, 0.1, "camera dark", "degraded"),
        (1.5, 0.1, "", "lost"),
        (float("nan"), 0.1, "", "lost"),
    ],
)
def test_health_names_its_reason(sigma_m, age_s, doubts, state):
    said, reason = judge(sigma_m=sigma_m, lidar_age_s=age_s, doubts=doubts, config=HealthConfig())
    assert said == state
    assert (reason == "") == (state == "nominal")
    assert doubts in reason


def test_map_error_is_the_covariance_of_a_drifting_map():
    """Against the sample covariance of maps that turn and shift by a little with every step."""
    rng = np.random.default_rng(4)
    P = np.zeros((18, 18))
    P[:6, :6] = np.diag([1e-8, 1e-8, 1e-6, 1e-6, 2e-6, 3e-6])
    way = np.cumsum(rng.uniform(0, 1, (60, 3)) * [1, 0.4, 0.1], axis=0)
    model, state = MapError(), State.at_rest(9.8)
    yaw, shift = np.zeros(4000), np.zeros((4000, 3))
    before = way[0]
    for p in way:
        model.move(p)
        model.extend(state, P, 0.5)
        step = p - before
        shift += yaw[:, None] * np.array([-step[1], step[0], 0.0])
        yaw += rng.normal(0, np.sqrt(0.5 * 1e-6), 4000)
        shift += rng.normal(0, 1, (4000, 3)) * np.sqrt(0.5 * np.diag(P)[3:6])
        before = p
    sample = np.cov(np.column_stack([yaw, shift]).T)
    assert not model.C[:2].any()  # roll and pitch are another matter
    np.testing.assert_allclose(model.C[2:, 2:], sample, rtol=0.12, atol=0.05 * sample.max())
    assert np.linalg.eigvalsh(model.covariance(state))[0] > -1e-12


def test_images_that_are_dark_blurred_or_the_same_again_are_refused_at_once():
    rng = np.random.default_rng(5)
    gate = ImageGate(ImageGateConfig())
    fine = [rng.integers(60, 200, (240, 320), dtype=np.uint8) for _ in range(40)]
    assert [gate.objection(image) for image in fine] == [""] * 40
    assert gate.objection(fine[-1]) == "camera frozen"
    assert gate.objection((fine[0] // 60).astype(np.uint8)) == "camera dark"
    assert gate.objection(uniform_filter(fine[1], (1, 25))) == "camera blurred"
    assert gate.objection(fine[2]) == ""


def test_a_gap_of_the_imu_widens_what_it_hides_and_is_named():
    filter_ = start_filter(REST, StartConfig(), t_s=5.0)
    before = filter_.P.copy()
    doubt = ImuDoubt(ImuDoubtConfig())
    doubt.gap(filter_, 0.005)
    np.testing.assert_array_equal(filter_.P, before)
    assert doubt.reason(5.0) == ""
    doubt.gap(filter_, 0.2)
    assert np.sqrt(filter_.P[6, 6] - before[6, 6]) == pytest.approx(0.6)
    assert doubt.reason(5.1) == "IMU silent for 0.20 s"
    assert doubt.reason(9.0) == ""


def test_surprise_after_surprise_opens_the_biases_a_single_one_does_not():
    filter_ = start_filter(REST, StartConfig(), t_s=5.0)
    before, doubt = filter_.P[12, 12], ImuDoubt(ImuDoubtConfig())
    for surprise in (20.0, 1.0, 20.0, 20.0):
        filter_.surprise = surprise
        doubt.corrected(filter_)
    assert filter_.P[12, 12] == before
    doubt.corrected(filter_)
    assert filter_.P[12, 12] == pytest.approx(0.09)
    assert doubt.reason(5.0) == "IMU bias jumped"
    for _ in range(3):
        doubt.corrected(filter_)
    assert filter_.P[12, 12] == pytest.approx(0.09)  # again adds nothing, or the estimate would swing


def test_surprises_right_after_a_gap_are_its_own():
    filter_ = start_filter(REST, StartConfig(), t_s=5.0)
    doubt, before = ImuDoubt(ImuDoubtConfig()), filter_.P[12, 12]
    doubt.gap(filter_, 0.2)
    filter_.surprise = 20.0
    for t_s, state in ((5.9, before), (6.1, 0.09)):
        filter_.t_s = t_s
        for _ in range(3):
            doubt.corrected(filter_)
        assert filter_.P[12, 12] == pytest.approx(state)


def test_a_fall_of_the_usual_share_is_noticed_and_a_slow_change_is_not():
    watch = FitWatch()
    for used in np.linspace(600, 120, 60):
        assert not watch.falls(normal(int(used)))
        watch.took(normal(int(used)))
    assert not watch.falls(normal(100))
    assert watch.falls(normal(30))


def normal(used):
    """What a sweep of 1,000 points said of which so many met planes."""
    eye = np.eye(6)
    return Normal(H=eye, g=np.zeros(6), used=used, offered=1000, R=np.eye(3), p=np.zeros(3))


def room(rng, n=9000):
    """Points of a room with a pillar, 8 x 6 x 3 m."""
    u = rng.uniform(-1, 1, (n, 3)) * [4, 3, 1.5]
    wall = rng.integers(0, 3, n)
    u[np.arange(n), wall] = np.sign(u[np.arange(n), wall]) * np.array([4, 3, 1.5])[wall]
    turn = rng.uniform(0, 2 * np.pi, n // 4)
    pillar = np.column_stack([1 + 0.5 * np.cos(turn), 0.5 + 0.5 * np.sin(turn), rng.uniform(-1.5, 1.5, n // 4)])
    return np.concatenate([u, pillar]) + rng.normal(0, 0.01, (n + n // 4, 3))


def test_the_search_finds_a_pose_that_is_metres_away():
    rng = np.random.default_rng(6)
    target = PointMap(PointMapConfig())
    target.insert(room(rng, 40_000).astype(np.float32), np.eye(3), np.zeros(3))
    R, p = Rotation.from_euler("z", 0.05).as_matrix(), np.array([0.4, -0.3, 0.1])
    seen = (room(rng) - p) @ R
    guess = (np.eye(3), p + np.array([1.9, -1.4, 0.05]))
    config = SearchConfig()
    found_R, found_p, share = search(
        lambda: PlaneRegistration(target, few_of(seen, config), config.plane), guess, sigma_m=1.0, config=config
    )
    assert np.linalg.norm(found_p - p) < 0.05
    assert np.linalg.norm(Rotation.from_matrix(found_R.T @ R).as_rotvec()) < 0.01
    assert share > 0.5
    scan = PlaneRegistration(target, seen, PlaneConfig())
    (fits, met, offered), (wrong, also_met, _) = scan.fits(R, p, 0.06), scan.fits(*guess, 0.06)
    assert offered == len(seen)
    assert fits / met > 0.9 > 0.6 > wrong / also_met


def test_blind_directions_are_named_in_odom():
    H = np.diag([1e5, 1e5, 1e5, 1e-3, 4e4, 4e4])
    R = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert Normal(R, np.zeros(3), H, np.zeros(6), 100, 100).weak_axes(0.005) == ["position along (1.0 0.0 0.0)"]
    H[3, 3], H[2, 2] = 4e4, 1.0
    assert Normal(R, np.zeros(3), H, np.zeros(6), 100, 100).weak_axes(0.005) == ["turn about (0.0 0.0 1.0)"]
