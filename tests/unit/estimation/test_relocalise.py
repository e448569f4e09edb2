"""Laws of being lost: particles follow the exact posterior, and an answer is right or not given."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.estimation.places.particles import LikelihoodField, ParticleConfig, Particles
from companion.estimation.places.relocalise import RelocaliseConfig, Relocaliser
from tests.unit.estimation.test_places import poisson, surveyed, turned, view

LANDMARKS = np.array([[0.0, 0.0], [3.0, 0.5], [1.0, 4.0], [5.0, 4.5]])


def on_grid(field, view_body, yaw, step=0.1):
    """Exact posterior over positions at a known heading, uniform before: (cells' centres, share)."""
    axis = np.arange(-3, 8, step) + step / 2
    x, y = np.meshgrid(axis, axis, indexing="ij")
    places = np.stack([x.ravel(), y.ravel()], axis=1)
    placed = places[:, None] + turned(view_body, yaw)[None]
    fit = np.exp(field.at(placed).sum(axis=1))
    return places, fit / fit.sum()


def by_square(places, weights, edge=0.5):
    """Weight per square of 0.5 m."""
    square = np.floor((places + 3) / edge).astype(int)
    return np.bincount(square[:, 0] * 22 + square[:, 1], weights, 22 * 22)


def test_weights_equal_the_exact_posterior():
    rng = np.random.default_rng(0)
    config = ParticleConfig(sigma_m=0.4, chance=0.2)
    field = LikelihoodField(LANDMARKS, config)
    seen = turned(LANDMARKS[:2] - [1.0, 1.0], -0.3)
    places, exact = on_grid(field, seen, 0.3)
    poses = np.column_stack([rng.uniform(-3, 8, (400_000, 2)), np.full(400_000, 0.3)])
    particles = Particles(poses, config)
    particles.see(field, seen)
    mass, expected = (by_square(p, w) for p, w in ((poses[:, :2], particles.weights), (places, exact)))
    assert 0.5 * np.abs(mass - expected).sum() < 0.02  # total variation
    assert (particles.weights @ poses[:, :2]) == pytest.approx(exact @ places, abs=0.02)


def test_resampling_keeps_the_posterior():
    rng = np.random.default_rng(1)
    field = LikelihoodField(LANDMARKS, ParticleConfig())
    particles = Particles(np.column_stack([rng.uniform(-3, 8, (50_000, 2)), np.zeros(50_000)]), ParticleConfig())
    particles.see(field, LANDMARKS - [1.0, 1.0])
    before = particles.weights @ particles.poses
    assert particles.effective < 5_000
    assert particles.resample(rng, 5_000)
    assert len(particles.poses) == 5_000
    assert particles.poses.mean(axis=0) == pytest.approx(before, abs=0.02)
    assert not particles.resample(rng)


def test_steps_are_taken_in_each_particles_own_frame():
    poses = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2]])
    config = ParticleConfig(move_sigma_m=1e-9, move_share=0.0, turn_sigma_rad=1e-9)
    particles = Particles(poses, config)
    particles.move(np.random.default_rng(0), np.array([2.0, 0.0]), 0.1)
    assert particles.poses == pytest.approx(np.array([[2.0, 0.0, 0.1], [0.0, 2.0, np.pi / 2 + 0.1]]), abs=1e-6)


def test_field_is_highest_at_the_points_and_chance_far_away():
    config = ParticleConfig()
    field = LikelihoodField(LANDMARKS, config)
    assert field.at(LANDMARKS) == pytest.approx(0.0, abs=1e-6)
    assert field.at(np.array([[100.0, 0.0], [-50.0, 3.0]])) == pytest.approx(np.log(config.chance))
    with pytest.raises(InputError, match="known"):
        LikelihoodField(np.empty((0, 2)), config)


def walk(trees, p, yaw, rng, views, step_m=1.0, **seen):
    """(view, step, turn, true p) along a way that turns gently."""
    step, turn = np.zeros(2), 0.0
    for _ in range(views):
        p = p + turned(step[None], yaw)[0]
        yaw = yaw + turn
        noisy = step + rng.normal(0, 0.01, 2)
        yield view(trees, p, yaw, rng, **seen), noisy, turn + rng.normal(0, 0.002), p
        step, turn = np.array([step_m, 0.0]), 0.05


def outcomes(trees, known, starts, seed, views, **seen):
    """(right, wrong, silent, the answers) of so many starts."""
    rng = np.random.default_rng(seed)
    low, high = trees.min(axis=0) + 20, trees.max(axis=0) - 20
    right = wrong = silent = 0
    answers = []
    for n in range(starts):
        search = Relocaliser(known, RelocaliseConfig(), seed=n)
        answer, p = None, np.zeros(2)
        for look, step, turn, here in walk(trees, rng.uniform(low, high), rng.uniform(-3, 3), rng, views, **seen):
            p, answer = here, search.look(look, step, turn)
            if answer is not None:
                break
        silent += answer is None
        good = answer is not None and np.linalg.norm(answer.p_map - p) < 0.3
        right, wrong = right + good, wrong + (answer is not None and not good)
        answers.append(answer)
    return right, wrong, silent, answers


def test_lost_in_a_changed_forest_it_is_found_within_three_views():
    """A tenth of the trees is gone, the survey has 5 cm of noise, and a view misses and invents trunks."""
    trees = poisson(4)
    known = surveyed(trees, 9, noise_m=0.05, missing=0.1)
    right, wrong, _, answers = outcomes(trees, known, 50, seed=2, views=3)
    assert wrong == 0
    assert right >= 49
    assert np.mean([a.views for a in answers if a]) < 1.3


def test_in_another_forest_it_never_answers():
    size_m = (100.0, 80.0)
    trees, known = poisson(4, size_m), surveyed(poisson(55, size_m), 1)
    right, wrong, silent, _ = outcomes(trees, known, 12, seed=3, views=6)
    assert (right, wrong, silent) == (0, 0, 12)


def plantation(rng):
    """Rows on a grid, with a tree missing here and there: each view alone fits in many places."""
    x, y = np.meshgrid(np.arange(0, 100, 4.0), np.arange(0, 100, 5.1))
    trees = np.stack([x.ravel(), y.ravel()], axis=1) + rng.normal(0, 0.05, (x.size, 2))
    return trees[rng.random(len(trees)) > 0.15]


def test_where_the_forest_repeats_particles_find_out_and_wrong_answers_are_rare():
    trees = plantation(np.random.default_rng(6))
    right, wrong, _, answers = outcomes(trees, trees, 20, seed=5, views=25, missing=0.02, false=0.02)
    assert wrong == 0
    assert right >= 10
    assert max(a.views for a in answers if a) > 1


def test_same_seed_gives_the_same_answer():
    trees = plantation(np.random.default_rng(6))
    first, second = (outcomes(trees, trees, 4, seed=8, views=12, missing=0.02, false=0.02)[3] for _ in range(2))
    assert [a and (a.p_map.tolist(), a.yaw, a.views) for a in first] == [
        a and (a.p_map.tolist(), a.yaw, a.views) for a in second
    ]


def test_few_trunks_are_never_an_answer():
    search = Relocaliser(poisson(1), RelocaliseConfig(), seed=0)
    for _ in range(10):
        assert search.look(np.array([[1.0, 2.0], [4.0, -3.0], [-2.0, 5.0]]), np.array([1.0, 0.0]), 0.0) is None


@pytest.mark.slow
def test_a_hundred_starts_in_a_changed_forest_and_a_hundred_in_another_one():
    """Of 200 x 140 m. pytest -m slow tests/unit/estimation/test_relocalise.py"""
    trees = poisson(4)
    right, wrong, _, _ = outcomes(trees, surveyed(trees, 9, noise_m=0.05, missing=0.1), 100, seed=12, views=3)
    assert (right >= 98, wrong) == (True, 0)
    assert outcomes(trees, surveyed(poisson(55), 1), 100, seed=13, views=3)[:2] == (0, 0)
