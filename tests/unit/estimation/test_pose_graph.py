"""Laws of pose graphs: files round trip, published errors, wrong closures do no harm, bad files are named."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from companion.cli import main
from companion.core.errors import InputError
from companion.estimation.pose_graph.g2o import read_g2o, write_g2o
from companion.estimation.pose_graph.graph import PoseGraph
from companion.estimation.pose_graph.optimise import OptimiseConfig, optimise

DATA = Path(__file__).parents[4] / "shared" / "data" / "posegraph_g2o"
# half the sum of squared residuals that gtsam's Levenberg-Marquardt is known to reach
PUBLISHED = {
    "smallGrid3D": 517.9,
    "intel": 22.5,
    "input_M3500_g2o": 69.0,
    "parking-garage": 0.634,
    "sphere2500": 675.7,
}
SIGMA_ODOMETRY = np.array([0.02, 0.02, 0.02, 2e-3, 2e-3, 4e-3])
SIGMA_CLOSURE = np.array([0.1, 0.1, 0.15, 0.02, 0.02, 0.02])


def relative(a, b):
    """Pose b seen from pose a, each (7,)."""
    turn = Rotation.from_quat(a[3:], scalar_first=True).inv()
    moved = turn.apply(b[:3] - a[:3])
    turned = turn * Rotation.from_quat(b[3:], scalar_first=True)
    return np.concatenate([moved, turned.as_quat(scalar_first=True)])


def composed(a, b):
    turn = Rotation.from_quat(a[3:], scalar_first=True)
    turned = turn * Rotation.from_quat(b[3:], scalar_first=True)
    return np.concatenate([a[:3] + turn.apply(b[:3]), turned.as_quat(scalar_first=True)])


def noisy(pose, sigma, rng):
    error = rng.normal(size=6) * sigma
    return composed(pose, np.concatenate([error[:3], Rotation.from_rotvec(error[3:]).as_quat(scalar_first=True)]))


def laps(rng, count=120, rounds=3):
    """(true poses, graph): laps on a circle, odometry that drifts, and 60 true closures."""
    angle = np.linspace(0, 2 * np.pi * rounds, count)
    places = np.stack([20 * np.cos(angle), 20 * np.sin(angle), 1.0 + 0.1 * np.sin(3 * angle)], axis=1)
    turns = Rotation.from_rotvec(np.outer(angle + np.pi / 2, [0, 0, 1])).as_quat(scalar_first=True)
    truth = np.hstack([places, turns])
    steps = np.array([noisy(relative(a, b), SIGMA_ODOMETRY, rng) for a, b in pairwise(truth)])
    poses = [truth[0]]
    for step in steps:
        poses.append(composed(poses[-1], step))
    ends = np.stack([np.arange(count - 1), np.arange(1, count)], axis=1)
    information = np.tile(np.diag(SIGMA_ODOMETRY**-2.0), (count - 1, 1, 1))
    graph = PoseGraph(np.arange(count), np.array(poses), ends, steps, information)
    near = [(a, b) for a in range(count) for b in range(a - 8) if np.linalg.norm(places[a] - places[b]) < 5.0]
    pairs = np.array([near[k] for k in rng.permutation(len(near))[:60]])
    seen = np.array([noisy(relative(truth[a], truth[b]), SIGMA_CLOSURE, rng) for a, b in pairs])
    return truth, graph.with_closures(pairs, seen, np.tile(np.diag(SIGMA_CLOSURE**-2.0), (60, 1, 1)))


def wrong_closures(graph, count, rng):
    pairs = rng.integers(0, len(graph.ids), (4 * count, 2))
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 8][:count]
    turns = Rotation.from_rotvec(np.outer(rng.uniform(-3, 3, count), [0, 0, 1])).as_quat(scalar_first=True)
    seen = np.hstack([rng.normal(0, 3, (count, 3)), turns])
    return graph.with_closures(pairs, seen, np.tile(np.diag(SIGMA_CLOSURE**-2.0), (count, 1, 1)))


def ate_m(graph, truth):
    return float(np.sqrt(np.mean(np.sum((graph.poses[:, :3] - truth[:, :3]) ** 2, axis=1))))


@pytest.mark.skipif(not DATA.is_dir(), reason="needs ../shared/data/posegraph_g2o")
@pytest.mark.parametrize("name", PUBLISHED)
def test_public_graphs_reach_the_published_error_and_round_trip(name):
    graph = read_g2o((DATA / f"{name}.g2o").read_text())
    done = optimise(graph, OptimiseConfig())
    assert done.error == pytest.approx(PUBLISHED[name], rel=2e-3)
    assert done.error < done.error_before
    again = read_g2o(write_g2o(done.graph))
    for part in ("ids", "poses", "ends", "measured", "information"):
        assert np.array_equal(getattr(again, part), getattr(done.graph, part)), part


@pytest.mark.parametrize("kernel", ["dcs", "gnc"])
def test_a_hundred_wrong_closures_among_sixty_true_ones_do_no_harm(kernel):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        truth, graph = laps(rng)
        clean = ate_m(optimise(graph, OptimiseConfig()).graph, truth)
        done = optimise(wrong_closures(graph, 100, rng), OptimiseConfig(kernel=kernel))
        assert ate_m(done.graph, truth) < 1.1 * clean + 0.005
        true, wrong = np.arange(119, 179), np.arange(179, 279)
        assert np.isin(wrong, done.refused).all()
        assert np.isin(true, done.refused).sum() <= 3


def test_trusting_every_closure_is_ruined_by_them():
    rng = np.random.default_rng(0)
    truth, graph = laps(rng)
    clean = ate_m(optimise(graph, OptimiseConfig()).graph, truth)
    ruined = ate_m(optimise(wrong_closures(graph, 100, rng), OptimiseConfig()).graph, truth)
    assert clean < 0.5 * ate_m(graph, truth)
    assert ruined > 5 * clean


def test_in_the_plane_without_turning_it_is_linear_least_squares():
    """Headings fixed by strong information: positions must equal the normal equations' solution."""
    rng = np.random.default_rng(5)
    count = 12
    ends = np.array([(k, k + 1) for k in range(count - 1)] + [(0, 6), (3, 11), (2, 9)])
    moved = rng.normal(size=(len(ends), 2)) + (ends[:, 1] - ends[:, 0])[:, None]
    weight = rng.uniform(0.5, 4.0, len(ends))
    information = np.array([np.diag([w, w, 1e9]) for w in weight])
    measured = np.hstack([moved, np.zeros((len(ends), 1))])
    graph = PoseGraph(np.arange(count), np.zeros((count, 3)), ends, measured, information)
    A = np.zeros((len(ends), count))
    A[np.arange(len(ends)), ends[:, 0]], A[np.arange(len(ends)), ends[:, 1]] = -1.0, 1.0
    root = np.sqrt(weight)[:, None]
    places = np.linalg.lstsq((root * A)[:, 1:], root * moved, rcond=None)[0]
    assert np.allclose(optimise(graph, OptimiseConfig()).graph.poses[1:, :2], places, atol=1e-5)


def test_same_graph_gives_the_same_bytes():
    graph = wrong_closures(laps(np.random.default_rng(1))[1], 30, np.random.default_rng(2))
    first, second = (optimise(graph, OptimiseConfig(kernel="dcs")).graph.poses for _ in range(2))
    assert first.tobytes() == second.tobytes()


V, E = "VERTEX_SE2 {} 0 0 0\n", "EDGE_SE2 {} {} 1 0 0 1 0 0 1 0 1\n"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no graph"),
        ("VERTEX_SE2 0 0 0\n", ":1: 3 numbers"),
        (V.format(0) + "VERTEX_SE2 1 a 0 0\n", ":2: could not convert"),
        ("VERTEX_XY 0 0 0\n", "not known"),
        (V.format(0) + "VERTEX_SE3:QUAT 1 0 0 0 0 0 0 1\n", "one kind"),
        (V.format(0) + V.format(0), "twice"),
        (V.format(0) + E.format(0, 7), "pose 7"),
        (V.format(0) + V.format(1) + V.format(2) + E.format(0, 1), "hang on nothing"),
        (V.format(0) + V.format(1) + "EDGE_SE2 0 1 1 0 0 -1 0 0 1 0 1\n", "not positive"),
        (V.format(0) + "VERTEX_SE2 1 nan 0 0\n" + E.format(0, 1), "not finite"),
        ("VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n", "no length"),
    ],
)
def test_bad_files_are_named_in_one_line(tmp_path, text, words):
    file = tmp_path / "bad.g2o"
    file.write_text(text)
    result = CliRunner().invoke(main.build(["graph"]), ["graph", "optimise", str(file)])
    assert isinstance(result.exception, InputError)
    assert words in str(result.exception)
    assert str(file) in str(result.exception)


def test_the_command_writes_a_graph_that_is_at_its_optimum(tmp_path):
    _, graph = laps(np.random.default_rng(4))
    source, out = tmp_path / "laps.g2o", tmp_path / "done.g2o"
    source.write_text(write_g2o(graph))
    words = ["graph", "optimise", str(source), "--out", str(out), "--picture", str(tmp_path / "p.png")]
    result = CliRunner().invoke(main.build(words), words)
    assert result.exit_code == 0, result.output
    again = optimise(read_g2o(out.read_text()), OptimiseConfig())
    assert again.error == pytest.approx(again.error_before, rel=1e-4)
    assert (tmp_path / "p.png").stat().st_size > 10_000
