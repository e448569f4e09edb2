"""Laws of the filters: batch least squares, exactness on linear models, Jacobians, consistency."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.core.geometry import exp_so3
from companion.estimation.filter import Filter
from companion.estimation.filters.align_in_motion import align_in_motion
from companion.estimation.filters.extended import ExtendedFilter
from companion.estimation.filters.fixed_lag import FixedLagFilter
from companion.estimation.filters.kalman import KalmanFilter, constant_velocity
from companion.estimation.filters.measurements import GroundFlow, PositionFix, RangeBelow, VelocityFix
from companion.estimation.filters.sigma_points import errors_about, move_to_mean, propagate_points, spread
from companion.estimation.filters.unscented import UnscentedFilter, whitened
from companion.estimation.normal import Normal
from companion.estimation.propagation import ImuNoise, propagate
from companion.estimation.state import State

DENSITIES = ImuNoise().densities
MEASUREMENTS = (
    PositionFix(np.array([1.3, 2.1, 9.0]), 0.01 * np.eye(3), np.array([0.1, -0.2, 0.3])),
    VelocityFix(np.array([1.0, 2.0, 2.5]), 0.04 * np.eye(3)),
    RangeBelow(np.array([9.5]), np.array([[0.01]]), ground_m=0.4),
    GroundFlow(np.array([0.1, 0.25]), 1e-4 * np.eye(2), ground_m=0.4),
)


def moving_state():
    state = State.at_rest(9.80665)
    state.R[:] = exp_so3(np.array([0.1, -0.2, 1.3]))
    state.p[:], state.v[:] = (1.0, 2.0, 10.0), (1.0, 2.0, 3.0)
    state.gyro_bias[:], state.accel_bias[:] = 0.01, 0.05
    return state


def covariance(rng, scale=1e-2):
    root = rng.normal(size=(18, 18)) * scale
    return root @ root.T + 1e-8 * np.eye(18)


def normalised(filter_, truth):
    error = truth.minus(filter_.state)[:15]
    return float(error @ np.linalg.solve(filter_.P[:15, :15], error)) / 15


def test_kalman_equals_batch_least_squares():
    """The last mean and covariance are those of one weighted least-squares problem over all states."""
    rng, n, steps = np.random.default_rng(1), 4, 12
    F, Q = constant_velocity(0.3, accel_density=0.5, axes=2)
    H, noise = np.eye(2, n), np.array([[0.2, 0.05], [0.05, 0.1]])
    z = rng.normal(size=(steps, 2))
    kf = KalmanFilter(np.array([1.0, 2.0, 0.0, 0.5]), np.diag([1.0, 2.0, 3.0, 4.0]))
    A, b = [np.eye(n, n * (steps + 1)) / np.sqrt(np.diag(kf.P))[:, None]], [kf.x / np.sqrt(np.diag(kf.P))]
    for k in range(steps):
        kf.predict(F, Q)
        kf.update(z[k], H, noise)
        motion, seen = np.zeros((n, n * (steps + 1))), np.zeros((2, n * (steps + 1)))
        motion[:, n * k : n * k + n], motion[:, n * k + n : n * k + 2 * n] = -F, np.eye(n)
        seen[:, n * k + n : n * k + 2 * n] = H
        white_motion, white_seen = (np.linalg.inv(np.linalg.cholesky(C)) for C in (Q, noise))
        A += [white_motion @ motion, white_seen @ seen]
        b += [np.zeros(n), white_seen @ z[k]]
    A, b = np.vstack(A), np.concatenate(b)
    P = np.linalg.inv(A.T @ A)
    np.testing.assert_allclose(kf.x, (P @ A.T @ b)[-n:], atol=1e-9)
    np.testing.assert_allclose(kf.P, P[-n:, -n:], atol=1e-9)


def test_constant_velocity_noise_adds_up():
    """Two steps of half the time are one step: F and Q come from one continuous model."""
    F, Q = constant_velocity(0.4, accel_density=2.0, axes=3)
    f, q = constant_velocity(0.2, accel_density=2.0, axes=3)
    np.testing.assert_allclose(f @ f, F, atol=1e-12)
    np.testing.assert_allclose(f @ q @ f.T + q, Q, atol=1e-12)


@pytest.mark.parametrize("measurement", MEASUREMENTS, ids=lambda m: type(m).__name__)
def test_jacobians_are_finite_differences(measurement):
    state, numeric, h = moving_state(), [], 1e-6
    for unit in np.eye(18):
        ahead, behind = state.copy(), state.copy()
        ahead.retract(h * unit)
        behind.retract(-h * unit)
        numeric.append((measurement.expected(ahead) - measurement.expected(behind)) / (2 * h))
    np.testing.assert_allclose(measurement.jacobian(state), np.transpose(numeric), atol=1e-7)


def test_sigma_points_carry_mean_and_covariance():
    rng = np.random.default_rng(2)
    state, P = moving_state(), covariance(rng)
    points = spread(state, P)
    errors = errors_about(points, state)
    np.testing.assert_allclose(errors.mean(axis=0), 0.0, atol=1e-12)
    np.testing.assert_allclose(errors.T @ errors / len(points), P, atol=1e-12)
    off = state.copy()
    off.retract(rng.normal(size=18) * 0.05)
    move_to_mean(points, off)
    np.testing.assert_allclose(off.minus(state), 0.0, atol=1e-9)


def test_points_move_as_the_mean_of_the_filter():
    rng = np.random.default_rng(3)
    imu = np.column_stack([np.full(40, 0.005), rng.normal(size=(40, 3)), rng.normal((0.0, 0.0, 9.8), 1.0, (40, 3))])
    state = moving_state()
    points = state.x[None].copy()
    propagate_points(points, imu)
    propagate(state, np.zeros((18, 18)), imu, DENSITIES, t_s=0.0)
    np.testing.assert_allclose(points[0], state.x, atol=1e-12)


def test_unscented_is_exact_on_linear_measurements():
    """Position and velocity are linear in the error state: both filters are then the Kalman filter."""
    P = covariance(np.random.default_rng(4))
    kf = KalmanFilter(np.zeros(18), P.copy())
    ekf, ukf = ExtendedFilter(moving_state(), P.copy(), 0.0), UnscentedFilter(moving_state(), P.copy(), 0.0)
    fixes = (PositionFix(np.array([1.01, 2.02, 9.97]), 1e-3 * np.eye(3)), MEASUREMENTS[1])
    for fix in fixes:
        # The update of the attitude turns the tangent space; one measurement each from the same start.
        kf.x, kf.P = np.zeros(18), P.copy()
        kf.update(fix.z - fix.expected(moving_state()), fix.jacobian(moving_state()), fix.noise)
        for one in (ekf, ukf):
            one.state, one.P = moving_state(), P.copy()
            one.correct(fix)
            np.testing.assert_allclose(one.state.minus(moving_state()), kf.x, atol=1e-9)
            np.testing.assert_allclose(one.P, kf.P, atol=1e-10)


def test_unscented_is_exact_on_linear_motion():
    """With the attitude and gyro bias known, strapdown motion is linear: mean and covariance agree."""
    rng = np.random.default_rng(5)
    P = covariance(rng, 0.1)
    known = [0, 1, 2, 9, 10, 11]
    P[known, :], P[:, known] = 0.0, 0.0
    P[known, known] = 1e-20
    imu = np.tile([0.005, 0.3, -0.2, 0.5, 0.5, 0.4, 9.8], (40, 1))
    still = DENSITIES * [1e-12, 1.0, 1e-12, 1.0]
    ekf, ukf = ExtendedFilter(moving_state(), P.copy(), 0.0), UnscentedFilter(moving_state(), P.copy(), 0.0)
    ekf.predict(imu, still)
    ukf.predict(imu, still)
    np.testing.assert_allclose(ukf.state.x, ekf.state.x, atol=1e-9)
    np.testing.assert_allclose(ukf.P, ekf.P, atol=1e-9)


def test_unscented_update_is_the_filters_update_on_a_quadratic():
    """A registration that is quadratic in position gives the same posterior."""
    rng = np.random.default_rng(6)
    P = covariance(rng, 0.02)
    J = np.concatenate([np.zeros((8, 3)), rng.normal(size=(8, 3))], axis=1) * 20.0
    target = np.array([1.02, 1.97, 10.04])

    def linearise(R, p):
        return Normal(R=R.copy(), p=p.copy(), H=J.T @ J, g=J.T @ (J[:, 3:] @ (target - p)), used=100, offered=100)

    ekf, ukf = Filter(moving_state(), P.copy(), 0.0), UnscentedFilter(moving_state(), P.copy(), 0.0)
    for one in (ekf, ukf):
        one.update(linearise, iterations=5, at_least=20)
    np.testing.assert_allclose(ukf.state.p, ekf.state.p, atol=1e-6)
    np.testing.assert_allclose(ukf.P[3:15, 3:15], ekf.P[3:15, 3:15], atol=1e-8)


def test_whitened_gives_the_normal_equations_back():
    rng = np.random.default_rng(7)
    J = rng.normal(size=(4, 6))  # two directions are blind
    g = J.T @ rng.normal(size=4)
    A, z = whitened(Normal(R=np.eye(3), p=np.zeros(3), H=J.T @ J, g=g, used=4, offered=4))
    assert A.shape == (4, 6)
    np.testing.assert_allclose(A.T @ A, J.T @ J, atol=1e-9)
    np.testing.assert_allclose(A.T @ z, g, atol=1e-9)


def test_unscented_mean_of_a_wide_heading_is_the_true_mean():
    """Heading within 20 degrees, 1 m/s2 ahead, 2 s: the mean falls short of the linear one, as sampling says."""
    P, imu = 1e-8 * np.eye(18), np.tile([0.01, 0.0, 0.0, 0.0, 1.0, 0.0, 9.80665], (200, 1))
    P[2, 2] = np.radians(20.0) ** 2
    ekf, ukf = (kind(State.at_rest(9.80665), P.copy(), 0.0) for kind in (ExtendedFilter, UnscentedFilter))
    samples = np.tile(State.at_rest(9.80665).x, (4000, 1))
    for x, yaw in zip(samples, np.random.default_rng(8).normal(0.0, np.radians(20.0), 4000), strict=True):
        x[:9] = exp_so3(np.array([0.0, 0.0, yaw])).ravel()
    propagate_points(samples, imu)
    ekf.predict(imu, DENSITIES)
    ukf.predict(imu, DENSITIES)
    true_x = samples[:, 9].mean()
    assert ekf.state.p[0] - true_x > 0.1
    assert abs(ukf.state.p[0] - true_x) < 0.2 * (ekf.state.p[0] - true_x)


def fly_with_fixes(filter_, truth, rng, seconds):
    """Circles with fixes at 10 Hz; yields the filter's NEES after each."""
    for k in range(seconds * 10):
        imu = np.tile([0.005, 0.1, -0.05, 0.8, 1.5 * np.cos(0.1 * k), 1.0, 9.8], (20, 1))
        propagate(truth, np.zeros((18, 18)), imu, DENSITIES, t_s=0.0)
        seen = imu.copy()
        seen[:, 1:4] += rng.normal(0.0, np.sqrt(DENSITIES[0] / 0.005), (20, 3))
        seen[:, 4:7] += rng.normal(0.0, np.sqrt(DENSITIES[1] / 0.005), (20, 3))
        filter_.predict(seen, DENSITIES)
        filter_.correct(PositionFix(truth.p + rng.normal(0.0, 0.05, 3), 0.0025 * np.eye(3)))
        yield normalised(filter_, truth)


def start(kind, rng):
    P = np.diag(np.repeat([0.02, 0.1, 0.2, 1e-3, 0.05, 1e-6], 3) ** 2)
    truth, state = moving_state(), moving_state()
    state.retract(-rng.normal(size=18) * np.sqrt(np.diag(P)))
    truth.g[:] = state.g
    return (FixedLagFilter(state, P, 0.0, ImuNoise()) if kind is FixedLagFilter else kind(state, P, 0.0)), truth


@pytest.mark.parametrize("kind", [ExtendedFilter, UnscentedFilter])
def test_filters_are_consistent(kind):
    """NEES per degree of freedom over 30 flights of 6 s is 1, within what chance allows."""
    rng, ends = np.random.default_rng(9), []
    for _ in range(30):
        filter_, truth = start(kind, rng)
        ends.append(list(fly_with_fixes(filter_, truth, rng, 6))[-1])
    assert 0.8 < np.mean(ends) < 1.2


def test_fixed_lag_agrees_with_the_filter():
    """Near-linear motion: the smoother's newest state is the filter's, well within its sigma."""
    states = {}
    for kind in (ExtendedFilter, FixedLagFilter):
        filter_, truth = start(kind, np.random.default_rng(10))
        nees = list(fly_with_fixes(filter_, truth, np.random.default_rng(11), 4))
        states[kind] = filter_
        assert np.mean(nees[-10:]) < 2.0
    ekf, graph = states[ExtendedFilter], states[FixedLagFilter]
    off = graph.state.minus(ekf.state)[:15] / np.sqrt(np.diag(ekf.P)[:15])
    assert np.abs(off).max() < 0.3
    ratio = np.diag(graph.P)[:15] / np.diag(ekf.P)[:15]
    assert 0.7 < ratio.min() <= ratio.max() < 1.4


def test_gates_refuse_what_cannot_be():
    for kind in (ExtendedFilter, UnscentedFilter):
        filter_ = kind(moving_state(), 1e-2 * np.eye(18), 0.0)
        said = filter_.correct(PositionFix(np.array([50.0, 2.0, 10.0]), 0.01 * np.eye(3)), gate_nis=16.3)
        assert said.nis > 1e4
        np.testing.assert_array_equal(filter_.state.x, moving_state().x)


def test_alignment_in_motion_finds_attitude_and_velocity():
    """Exact fixes: attitude within 0.1 deg, velocity within 2 cm/s; with noise of 5 cm 15 times that."""
    truth, rng = moving_state(), np.random.default_rng(12)
    truth.gyro_bias[:], truth.accel_bias[:] = 0.0, 0.0
    begin, imu, fixes = truth.copy(), [], []
    for k in range(50):
        piece = np.tile([0.005, 0.2, -0.1, 0.8, 2.0 * np.cos(0.2 * k), 2.0 * np.sin(0.3 * k), 9.8], (20, 1))
        propagate(truth, np.zeros((18, 18)), piece, DENSITIES, t_s=0.0)
        imu.append(piece)
        fixes.append(truth.p.copy())
    for sigma, allowed in ((0.0, 1.0), (0.05, 15.0)):
        seen = np.array(fixes) + rng.normal(0.0, sigma, (50, 3))
        found = align_in_motion(np.concatenate(imu), 0.1 * np.arange(1, 51), seen, gravity_m_s2=9.80665)
        error = found.state.minus(begin)
        assert np.degrees(np.linalg.norm(error[:3])) < 0.1 * allowed
        assert np.linalg.norm(error[6:9]) < 0.02 * allowed
    with pytest.raises(InputError, match="fixes"):
        align_in_motion(np.concatenate(imu), np.array([9.0]), np.zeros((1, 3)), gravity_m_s2=9.8)
