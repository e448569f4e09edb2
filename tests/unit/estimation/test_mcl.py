"""Laws of localisation in a prior map: the exact posterior on a grid, the field's gradient, recovery, the study."""

import os
import subprocess
import sys

import numpy as np
import pytest
from scipy import ndimage

from companion.core.errors import InputError
from companion.estimation.mcl.map_filter import MapFilter
from companion.estimation.mcl.particles import MclConfig, MonteCarlo, kld_count
from companion.estimation.mcl.prior_map import FieldModel, PriorMap
from companion.runtime.bench import estimators_warehouse as study
from companion.runtime.bench import warehouse_plan as plan

STEPS = (np.array([0.4, 0.1, 0.0]), np.array([0.3, -0.2, 0.0]), np.array([0.5, 0.2, 0.0]))
CELL = 0.1


def small_world():
    """A room of 6 x 4 m with one pillar."""
    walls = np.array(
        [[0, 0, 6, 0], [6, 0, 6, 4], [6, 4, 0, 4], [0, 4, 0, 0], [2, 1, 2, 1.5], [2, 1.5, 2.4, 1.5]], float
    )
    return walls, PriorMap(plan.known_points(walls), cell_m=CELL, reach_m=1.0)


def scans(walls, every=6):
    """Of the ends of the steps, from (1.2, 2.1) with heading 0, three metres far."""
    rng, p = np.random.default_rng(1), np.array([1.2, 2.1, 0.0, 0.0])
    for step in STEPS:
        p[:3] += step
        seen = plan.scan(p, walls, rng)
        yield seen[np.linalg.norm(seen, axis=1) < 2.5][::every]


def exact_posterior(prior, walls, config):
    """Bayes filter on a grid of 0.1 m, heading known: motion is a convolution, a scan a product."""
    x, y = np.meshgrid(np.arange(0.05, 6, CELL), np.arange(0.05, 4, CELL), indexing="ij")
    belief = np.ones(x.shape)
    table = prior.log_likelihood(config.model)
    for step, scan in zip(STEPS, scans(walls), strict=True):
        sigma = config.move_sigma_m + config.move_share * np.linalg.norm(step)
        belief = ndimage.shift(belief, step[:2] / CELL, order=1, mode="constant")
        belief = ndimage.gaussian_filter(belief, sigma / CELL, mode="constant", truncate=6)
        at = np.stack([x, y], axis=-1)[:, :, None] + scan[:, :2]
        cells = np.floor((at - prior.corner[:2]) / CELL).astype(int)
        inside = np.all((cells >= 0) & (cells < table.shape[:2]), axis=-1)
        i, j = np.where(inside, cells[..., 0], 0), np.where(inside, cells[..., 1], 0)
        fit = np.where(inside, table[i, j, 0], np.log(config.model.chance)).sum(axis=-1)
        belief *= np.exp(min(1.0, config.model.independent / len(scan)) * (fit - fit.max()))
    return x, y, belief / belief.sum()


def particle_posterior(count, prior, walls, config, seed):
    rng = np.random.default_rng(seed)
    poses = np.zeros((count, 4))
    poses[:, :2] = rng.uniform((0, 0), (6, 4), (count, 2))
    mcl = MonteCarlo(poses, prior, config)
    for step, scan in zip(STEPS, scans(walls), strict=True):
        mcl.move(rng, step, 0.0)
        mcl.see(scan)
    return mcl


def test_particles_converge_to_the_exact_posterior():
    """Total variation over cells of 0.5 m: below 0.06 with 200,000 particles, and falling as 1 / sqrt(n)."""
    walls, prior = small_world()
    config = MclConfig(move_sigma_m=0.05, turn_sigma_rad=0.0, model=FieldModel(sigma_m=0.3, independent=3.0))
    x, y, belief = exact_posterior(prior, walls, config)
    edges = (np.arange(0, 6.01, 0.5), np.arange(0, 4.01, 0.5))
    exact = np.histogram2d(x.ravel(), y.ravel(), bins=edges, weights=belief.ravel())[0]
    off = {}
    for count in (2_000, 200_000):
        runs = []
        for seed in range(3):
            mcl = particle_posterior(count, prior, walls, config, seed)
            found = np.histogram2d(*mcl.poses[:, :2].T, bins=edges, weights=mcl.weights)[0]
            runs.append(0.5 * np.abs(found - exact).sum())
        off[count] = np.mean(runs)
    assert off[200_000] < 0.06
    assert off[200_000] < 0.5 * off[2_000]


def test_resampling_keeps_the_belief():
    """Mean and spread before and after are the same within what so many draws allow."""
    walls, prior = small_world()
    config = MclConfig(fewest=20_000, resample_below=1.0, slow_rate=0.0)
    mcl = particle_posterior(20_000, prior, walls, config, 3)
    mean = mcl.weights @ mcl.poses[:, :2]
    spread = np.sqrt(mcl.weights @ (mcl.poses[:, :2] - mean) ** 2)
    assert mcl.resample(np.random.default_rng(4))
    np.testing.assert_allclose(mcl.poses[:, :2].mean(axis=0), mean, atol=0.01)
    np.testing.assert_allclose(mcl.poses[:, :2].std(axis=0), spread, atol=0.01)
    np.testing.assert_allclose(mcl.weights, 1.0 / len(mcl.poses))


def test_kld_count_is_the_chi_square_quantile():
    """Fox 2003: n = chi2(k - 1, 0.99) / (2 error), to which the formula is an approximation."""
    from scipy.stats import chi2

    config = MclConfig(fewest=2, most=10**6, kld_error=0.05)
    for bins in (5, 50, 500):
        assert kld_count(bins, config) == pytest.approx(chi2.ppf(0.99, bins - 1) / 0.1, rel=0.02)


@pytest.mark.parametrize("axes", [2, 3])
def test_the_fields_gradient_is_its_finite_difference(axes):
    rng = np.random.default_rng(5)
    prior = PriorMap(rng.uniform(0, 3, (60, axes)), cell_m=0.1, reach_m=0.8)
    # 0.31 cells off each centre: no cell's border within the difference.
    points = np.column_stack([rng.integers(0, 30, (200, 3)) * 0.1 + 0.031]) + prior.corner
    _, gradient = prior.distance_and_gradient(points)
    for k in range(3):
        shift = np.eye(3)[k] * 1e-5
        numeric = (prior.distance(points + shift) - prior.distance(points - shift)) / 2e-5
        np.testing.assert_allclose(gradient[:, k], numeric, atol=1e-6)


def test_the_field_is_the_distance_to_what_is_known():
    """Within a cell's diagonal and up to its reach; what is beyond is that far."""
    known = np.array([[1.0, 1.0, 1.0]])
    prior = PriorMap(known, cell_m=0.05, reach_m=1.0)
    points = known + np.array([[0.5, 0, 0], [0.3, 0.4, 0.0], [0.0, 0.0, 5.0]])
    np.testing.assert_allclose(prior.distance(points), [0.5, 0.5, 1.0], atol=0.06)
    with pytest.raises(InputError, match="known"):
        PriorMap(np.zeros((0, 2)), cell_m=0.1, reach_m=1.0)


def test_map_filter_agrees_with_particles_where_one_gaussian_is_enough():
    walls, prior = small_world()
    config = MclConfig(turn_sigma_rad=0.01)
    start = np.array([1.2, 2.1, 0.0, 0.0])
    sigmas = np.array([0.1, 0.1, 1e-6, 0.03])
    ekf = MapFilter(start + np.array([0.1, -0.05, 0, 0.02]), np.diag(sigmas**2), prior, config)
    rng = np.random.default_rng(6)
    mcl = MonteCarlo(ekf.pose + rng.normal(size=(20_000, 4)) * sigmas, prior, config)
    for step, scan in zip(STEPS, scans(walls, every=2), strict=True):
        ekf.move(step, 0.0)
        mcl.move(rng, step, 0.0)
        assert ekf.see(scan) > 20
        mcl.see(scan)
    truth = start + np.array([1.2, 0.1, 0.0, 0.0])
    assert np.linalg.norm(ekf.pose[:2] - truth[:2]) < 0.06
    assert np.linalg.norm(mcl.estimate().pose[:2] - ekf.pose[:2]) < 0.06


def test_a_carried_vehicle_is_found_again_by_particles_alone():
    """One drive of the study: EKF ends metres off, MCL within 0.5 m, and tracking is right with both."""
    prior, walls = study.warehouse_map()
    ends = {name: run("kidnapped", 1, prior, walls).error_m[-1] for name, run in study.RUNS.items()}
    assert ends["mcl"] < study.RIGHT_M
    assert ends["ekf"] > 2.0
    assert study.run_ekf("tracking", 0, prior, walls).error_m[-1] < study.RIGHT_M


PROGRAM = """
import hashlib
from companion.runtime.bench.estimators_warehouse import run_mcl, warehouse_map
trace = run_mcl("tracking", 3, *warehouse_map())
print(hashlib.sha256(b"".join(p.tobytes() for p in trace.pose)).hexdigest())
"""


def test_two_processes_give_equal_bytes():
    runs = [
        subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, text=True, env=os.environ, check=True)
        for _ in range(2)
    ]
    assert len(runs[0].stdout.strip()) == 64
    assert runs[0].stdout == runs[1].stdout
