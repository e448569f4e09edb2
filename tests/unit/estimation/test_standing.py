"""A vehicle that stands is held where it is until it moves."""

import numpy as np
import pytest

from companion.estimation.normal import Normal
from companion.estimation.propagation import ImuNoise
from companion.estimation.standing import Standing, StandingConfig
from companion.estimation.start import StartConfig, start_filter

DT = 0.005
REST = np.array([0.004, -0.006, 0.003, 0.06, -0.05, 9.85])
NOISE = np.repeat([1e-3, 2e-2], 3) / DT**0.5


def pieces(rng, extra=(0, 0, 0, 0, 0, 0), n=20):
    return np.column_stack([np.full(n, DT), REST + extra + rng.normal(0, 1, (n, 6)) * NOISE])


@pytest.fixture
def held():
    rng = np.random.default_rng(3)
    filter_ = start_filter(pieces(rng, n=200)[:, 1:], StartConfig(), t_s=0.0)
    return rng, filter_, Standing(filter_, StandingConfig(), ImuNoise().densities)


def run(rng, filter_, standing, seconds, extra=(0, 0, 0, 0, 0, 0)):
    for _ in range(round(seconds / 0.1)):
        imu = pieces(rng, extra)
        filter_.predict(imu, ImuNoise().densities)
        standing.watch(imu, filter_)


def test_noise_alone_neither_moves_it_nor_ends_it(held):
    rng, filter_, standing = held
    R = filter_.state.R.copy()
    run(rng, filter_, standing, 20.0)
    assert not standing.is_over
    assert np.linalg.norm(filter_.state.p) < 2e-3
    assert np.linalg.norm(filter_.state.R - R) < 1e-3
    assert np.linalg.eigvalsh(filter_.P)[0] > 0


def test_it_learns_the_gyro_bias_while_it_stands(held):
    rng, filter_, standing = held
    before = filter_.P[9, 9]
    run(rng, filter_, standing, 20.0)
    assert filter_.P[9, 9] < 0.1 * before
    assert np.abs(filter_.state.gyro_bias - REST[:3]).max() < 4 * np.sqrt(filter_.P[9, 9])


def test_what_moved_before_it_was_known_to_move_is_not_held_down(held):
    """It tips by 8 mrad in 0.2 s: that is told, though the filter was held for most of it."""
    rng, filter_, standing = held
    run(rng, filter_, standing, 5.0)
    R = filter_.state.R.copy()
    run(rng, filter_, standing, 0.2, (0.04, 0, 0, 0, 0, 0))
    run(rng, filter_, standing, 0.1, (0, 0, 0, 0, 0, 1.0))
    assert standing.is_over
    tipped = R.T @ filter_.state.R
    assert tipped[2, 1] == pytest.approx(0.008, abs=0.0015)
    assert np.linalg.eigvalsh(filter_.P)[0] > 0


def test_sweeps_are_settled_when_it_is_known_that_it_stood(held):
    rng, filter_, standing = held
    given = []
    for k in range(12):
        run(rng, filter_, standing, 0.1)
        given.append(standing.settled(0.125 * k, k))
    assert given == [None] * 4 + list(range(8))
    run(rng, filter_, standing, 0.3, (0, 0, 0, 0, 0, 1.0))
    assert standing.settled(1.5, 15) == 15


@pytest.mark.parametrize("extra", [(0, 0, 0, 0, 0, 0.6), (0, 0, 0, 0.4, 0, 0), (0, 0, 0.05, 0, 0, 0)])
def test_a_push_or_a_turn_ends_it_for_good(held, extra):
    rng, filter_, standing = held
    run(rng, filter_, standing, 2.0)
    run(rng, filter_, standing, 0.3, extra)
    assert standing.is_over
    run(rng, filter_, standing, 1.0)
    assert standing.is_over


def test_a_sweep_that_sees_it_elsewhere_ends_it(held):
    _, filter_, standing = held
    H = np.diag([1e6, 1e6, 1e6, 1e5, 1e5, 1e5])  # 3 mm
    at = filter_.state
    standing.seen(Normal(at.R, at.p, H, H @ [0, 0, 0, 0.01, 0, 0], 500, 1000))
    assert not standing.is_over
    standing.seen(Normal(at.R, at.p, H, H @ [0, 0, 0, 0.1, 0, 0], 500, 1000))
    assert standing.is_over
