"""Edges: extraction on scenes whose edges are known, lines and Jacobians against definitions, motion among poles."""

import msgspec
import numpy as np
import pytest

from companion.core.geometry import exp_so3, log_so3
from companion.core.rig import Mount, Rig
from companion.estimation import edges as edges_module
from companion.estimation import lines
from companion.estimation.config import EstimationConfig
from companion.estimation.edges import EdgeConfig, find_edges
from companion.estimation.features import EdgeMap, EdgesAndPlanes, EdgesConfig
from companion.estimation.lines import LineConfig, LineRegistration, find_lines
from companion.estimation.lio import Lio, LioConfig
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.registration import PlaneConfig, PlaneRegistration
from companion.estimation.search import SearchConfig, search
from companion.estimation.so3 import orthonormal
from companion.estimation.warm_up import warm_up
from sim.sensors.patterns import rosette_pattern, spin_pattern
from tests.unit.estimation.synthetic import cast
from tests.unit.estimation.test_kernels import check_normal_equations

LEVEL = Mount()
WALL_M = 12.0
NO_WALL = 1e9
POLES = np.array([[6.0, 1.0, 0.04], [5.0, -3.0, 0.04], [-4.0, 5.0, 0.04], [-7.0, -2.0, 0.04], [2.0, 8.0, 0.04]])


def directions(pattern, counter=0):
    if pattern == "spin64":
        return spin_pattern(64, 1024, (-22.5, 22.5))[0].astype(float)
    return rosette_pattern(20_000, 0.1, counter, (-7.0, 52.0))[0].astype(float)


def sweep(pattern, poles, *, wall_m=NO_WALL, rng=None, R=None, p=(0.0, 0.0, 6.0), counter=0):
    """Body points (N, 3) of a vehicle at (R, p) among poles of 12 m before a wall x = `wall_m`; no ground."""
    R = np.eye(3) if R is None else R
    dirs = directions(pattern, counter)
    rays = dirs @ R.T
    origin = np.asarray(p, float)
    up = rays.copy()
    up[:, 2] = np.maximum(up[:, 2], 0.0)  # `cast` has ground where a ray goes down
    far = cast(np.tile(origin, (len(rays), 1)), rays, np.asarray(poles, float).reshape(-1, 3))
    far = np.where((rays[:, 2] < 0) & (np.abs(far * rays[:, 2] + origin[2]) < 1e-6), np.inf, far)
    with np.errstate(divide="ignore"):
        wall = np.where(rays[:, 0] > 1e-6, (wall_m - origin[0]) / rays[:, 0], np.inf)
    ranges = np.minimum(far, wall) + (rng.normal(0, 0.02, len(rays)) if rng else 0.0)
    seen = ranges < 40.0
    return (dirs[seen] * ranges[seen, None]).astype(np.float32)


def off_poles(points, poles):
    """Distance (N,) of each point from the nearest axis, in the plane."""
    return np.linalg.norm(points[:, None, :2] - poles[:, :2], axis=2).min(axis=1)


@pytest.mark.parametrize("pattern", ["spin64", "mid360"])
def test_poles_before_a_wall_are_edges_and_the_wall_is_none(pattern):
    rng = np.random.default_rng(0)
    poles = POLES[:2]
    points = sweep(pattern, poles, wall_m=WALL_M, rng=rng)
    edges = find_edges(points[np.abs(points[:, 1]) < WALL_M], LEVEL, EdgeConfig())
    edges = edges[np.abs(edges[:, 1]) < WALL_M - 2.0]  # the ends of the wall are edges
    on_pole = off_poles(edges, poles) < 0.15
    assert on_pole.sum() > 30
    assert on_pole.mean() > 0.9
    for pole in poles:
        assert (off_poles(edges, pole[None]) < 0.15).sum() > 8


@pytest.mark.parametrize("pattern", ["spin64", "mid360"])
def test_a_plain_wall_has_no_edges(pattern):
    rng = np.random.default_rng(1)
    points = sweep(pattern, np.empty((0, 3)), wall_m=WALL_M, rng=rng)
    inner = points[np.abs(points[:, 1]) < WALL_M]
    edges = find_edges(inner, LEVEL, EdgeConfig())
    assert len(inner) > 2000
    assert (np.abs(edges[:, 1]) < WALL_M - 2.0).sum() < 0.002 * len(inner)  # a rosette leaves gaps here and there


def test_the_border_of_what_a_pole_hides_is_no_edge():
    """A board of 1 m before the wall: its two ends are edges, the wall beside it is none."""
    dirs = directions("spin64")
    with np.errstate(divide="ignore", invalid="ignore"):
        board, wall = (np.where(dirs[:, 0] > 1e-6, x / dirs[:, 0], np.inf) for x in (5.0, WALL_M))
    ranges = np.where(np.abs(board * dirs[:, 1]) < 0.5, board, wall)
    inside = (ranges < 40.0) & (np.abs(ranges * dirs[:, 1]) < 4.0)
    edges = find_edges((dirs[inside] * ranges[inside, None]).astype(np.float32), LEVEL, EdgeConfig())
    inner = edges[np.abs(edges[:, 1]) < 3.5]
    np.testing.assert_allclose(inner[:, 0], 5.0, atol=1e-4)
    assert (np.abs(np.abs(inner[:, 1]) - 0.5) < 0.05).mean() > 0.95
    assert len(inner) > 80


@pytest.mark.parametrize("pattern", ["spin64", "mid360"])
def test_ground_that_the_beam_grazes_has_hardly_an_edge(pattern):
    dirs = directions(pattern)
    down = dirs[:, 2] < -0.06
    rng = np.random.default_rng(2)
    ranges = -3.0 / dirs[down, 2] + rng.normal(0, 0.02, down.sum())
    points = (dirs[down] * ranges[:, None]).astype(np.float32)
    assert len(points) > 400
    assert len(find_edges(points, LEVEL, EdgeConfig())) < 0.01 * len(points)


def test_at_most_so_many_per_sector():
    rng = np.random.default_rng(3)
    poles = np.column_stack([5 * np.cos(np.arange(0, 6.2, 0.1)), 5 * np.sin(np.arange(0, 6.2, 0.1)), np.full(62, 0.04)])
    points = sweep("spin64", poles, rng=rng)
    few = find_edges(points, LEVEL, EdgeConfig(sectors=4, per_sector=2))
    many = find_edges(points, LEVEL, EdgeConfig(sectors=8, per_sector=20))
    lines_seen = 45.0 / EdgeConfig().line_deg + 1
    assert len(few) <= lines_seen * 4 * 2
    assert len(many) > 4 * len(few)


def test_the_sensor_s_place_and_turn_are_minded():
    rng = np.random.default_rng(4)
    mount = Rig().lidar
    R, p = mount.R_body_sensor, mount.p_body
    sensor = sweep("spin64", POLES[:2], wall_m=WALL_M, rng=rng)
    body = (sensor @ R.T + p).astype(np.float32)
    found = find_edges(body, mount, EdgeConfig())
    level = find_edges(sensor, LEVEL, EdgeConfig())
    away = np.linalg.norm(((found - p) @ R)[:, None] - level, axis=2).min(axis=1)
    assert abs(len(found) - len(level)) < 0.02 * len(level)
    assert (away < 1e-3).mean() > 0.95  # rounding moves some from one line to the next


def test_line_fit_is_that_of_eigh():
    rng = np.random.default_rng(5)
    agreed = refused = 0
    for _ in range(400):
        d = rng.normal(size=3)
        d /= np.linalg.norm(d)
        across = rng.choice([0.01, 0.03, 0.2])
        near = rng.normal(size=3) + np.outer(rng.uniform(-0.4, 0.4, 5), d) + rng.normal(0, across, (5, 3))
        line = np.empty(6)
        ok = lines._fit_line(near, 0.06**2, 9.0, line)
        values, vectors = np.linalg.eigh((near - near.mean(axis=0)).T @ (near - near.mean(axis=0)))
        off = near - near.mean(axis=0)
        off = np.linalg.norm(off - np.outer(off @ vectors[:, 2], vectors[:, 2]), axis=1).max()
        assert ok == (values[2] >= 9.0 * values[1] and off <= 0.06)
        if ok:
            np.testing.assert_allclose(line[:3], near.mean(axis=0), atol=1e-12)
            assert abs(line[3:] @ vectors[:, 2]) > 1 - 1e-9
        agreed, refused = agreed + ok, refused + (not ok)
    assert min(agreed, refused) > 50


def pole_map(rng, poles=POLES):
    """A map of edges on poles, 12 m high."""
    cloud = [np.column_stack([np.tile(pole[:2], (400, 1)), rng.uniform(0, 12, 400)]) for pole in poles]
    target = PointMap(PointMapConfig(averaged=20))
    noisy = np.concatenate(cloud) + rng.normal(0, 0.01, (400 * len(poles), 3))
    target.insert(noisy.astype(np.float32), np.eye(3), np.zeros(3))
    return target


def test_line_jacobian_is_the_finite_difference():
    rng = np.random.default_rng(6)
    slanted = pole_map(rng)
    R, p = exp_so3(np.array([0.02, -0.03, 0.05])), np.array([0.05, -0.04, 0.06])
    points = (slanted.points()[::4].astype(np.float64) + rng.normal(0, 0.02, (1, 3)) - p) @ R
    scan = LineRegistration(slanted, points, LineConfig(sigma_m=0.05, cauchy=1e12, gate_m=10.0, inflation=1.0))
    normal = scan.linearise(R, p)
    found, valid = np.zeros((len(points), 6)), np.zeros(len(points), np.bool_)
    assert find_lines(slanted, points, R, p, LineConfig(), found, valid) == normal.used > 60

    def cost(dx):
        off = points[valid] @ (R @ exp_so3(dx[:3])).T + p + dx[3:] - found[valid, :3]
        off -= (off * found[valid, 3:]).sum(axis=1)[:, None] * found[valid, 3:]
        return 0.5 * (off**2).sum() / 0.05**2

    check_normal_equations(cost, normal)


def test_points_of_a_plane_have_no_line():
    flat = np.stack(np.meshgrid(np.arange(-1, 1, 0.16), np.arange(-1, 1, 0.16), [0.0]), axis=-1).reshape(-1, 3)
    target = PointMap(PointMapConfig())
    target.insert(flat.astype(np.float32), np.eye(3), np.zeros(3))
    queries = flat[40:60] + 0.02
    found, valid = np.zeros((20, 6)), np.zeros(20, np.bool_)
    assert find_lines(target, queries, np.eye(3), np.zeros(3), LineConfig(), found, valid) == 0


def known_motion(seed=7):
    """Sweeps of the Mid-360 class among thin poles, none of anything else: the map's, and one from a moved pose."""
    rng = np.random.default_rng(seed)
    angle = np.arange(24) * 2.4
    reach = 3.0 + 6.0 * ((np.arange(24) * 0.618) % 1.0)
    poles = np.column_stack([reach * np.cos(angle), reach * np.sin(angle), np.full(24, 0.03)])
    edges, points = EdgeMap(EdgesConfig(), LEVEL), PointMap(PointMapConfig(averaged=20))
    for counter in range(12):
        p = np.array([0.1 * counter - 0.6, 0.05 * counter, 6.0])
        seen = sweep("mid360", poles, rng=rng, p=p, counter=counter)
        edges.insert(edges.find(seen), np.eye(3), p)
        points.insert(seen, np.eye(3), p)
    R, p = exp_so3(np.array([0.01, -0.02, 0.06])), np.array([0.3, 0.2, 6.0])
    return edges, points, sweep("mid360", poles, rng=rng, R=R, p=p, counter=50), (R, p)


def solve(scan, R, p):
    for _ in range(15):
        normal = scan.linearise(R, p)
        step = np.linalg.solve(normal.H + 1e-3 * np.eye(6), normal.g)
        R, p = orthonormal(R @ exp_so3(step[:3])), p + step[3:]
    return R, p, normal


def test_poles_alone_tell_the_motion_by_edges_and_not_by_planes():
    edges, points, seen, (R_true, p_true) = known_motion()
    R, p = np.eye(3), p_true + np.array([0.12, -0.1, 0.0])
    planes = PlaneRegistration(points, seen.astype(np.float64), PlaneConfig(flatness_m=0.03, sigma_m=0.03))
    scan = EdgesAndPlanes(planes, LineRegistration(edges.map, edges.find(seen), LineConfig()))
    found_R, found_p, normal = solve(scan, R, p)
    assert np.linalg.norm((found_p - p_true)[:2]) < 0.02
    assert np.linalg.norm(log_so3(found_R.T @ R_true)) < 0.005
    assert [a.replace("-", "") for a in normal.weak_axes(0.005)] == ["position along (0.0 0.0 1.0)"]  # upright poles
    wrong_R, wrong_p, _ = solve(planes, R, p)
    assert np.linalg.norm((wrong_p - p_true)[:2]) > 0.1 or np.linalg.norm(log_so3(wrong_R.T @ R_true)) > 0.05


def test_the_same_bytes_twice():
    first, again = (known_motion() for _ in range(2))
    assert first[0].map.points().tobytes() == again[0].map.points().tobytes()
    results = []
    for edges, _, seen, (R, p) in (first, again):
        normal = LineRegistration(edges.map, edges.find(seen), LineConfig()).linearise(R, p)
        results.append(normal.H.tobytes() + normal.g.tobytes())
    assert results[0] == results[1]


def test_the_front_end_takes_edges_when_told():
    """Among poles and nothing else: an accelerometer whose bias jumps takes planes astray, and edges do not."""
    off = {f: fly(msgspec.structs.replace(LioConfig(), features=f)) for f in ("planes", "edges_and_planes")}
    assert off["edges_and_planes"] < 0.015
    assert off["planes"] > 3.0 * off["edges_and_planes"]


def fly(config):
    """The last error in m of 3 s along x at up to 1.5 m/s; the accelerometer's bias jumps by 0.3 m/s2 after 1 s."""
    rng = np.random.default_rng(9)
    angle = np.arange(40) * 2.4
    reach = 2.5 + 7.0 * ((np.arange(40) * 0.618) % 1.0)
    poles = np.column_stack([reach * np.cos(angle) + 2.0, reach * np.sin(angle), np.full(40, 0.03)])
    lio = Lio.at_rest(np.tile([0, 0, 0, 0, 0, 9.81], (200, 1)), config, Rig(lidar=LEVEL))
    for k in range(1, 31):
        bias = 0.3 if k > 10 else 0.0
        lio.predict(np.tile([0.005, 0, 0, 0, 0.5 + bias, 0, 9.81], (20, 1)))
        at = np.array([0.25 * (0.1 * k) ** 2, 0.0, 0.0])
        seen = sweep("mid360", poles, rng=rng, p=[at[0], 0.0, 6.0], counter=k)
        lio.update_lidar(seen, np.zeros(len(seen), np.float32))
    return float(np.linalg.norm(lio.filter.state.p[:2] - at[:2]))


def test_a_wrong_choice_is_told():
    with pytest.raises(msgspec.ValidationError, match=r"Invalid enum value 'corners' - at `\$.lio.features`"):
        msgspec.convert({"lio": {"features": "corners"}}, EstimationConfig)
    with pytest.raises(msgspec.ValidationError, match=r"Expected `float` >= 0.2 - at `\$.lio.edges.find.line_deg`"):
        msgspec.convert({"lio": {"edges": {"find": {"line_deg": 0.0}}}}, EstimationConfig)


def test_the_search_after_a_gap_finds_its_way_among_poles():
    edges, _, seen, (R_true, p_true) = known_motion()
    found, config = edges.find(seen), SearchConfig()
    guess = np.eye(3), p_true + np.array([0.9, -0.7, 0.0])
    R, p, share = search(lambda: LineRegistration(edges.map, found, config.line), guess, sigma_m=0.5, config=config)
    assert np.linalg.norm((p - p_true)[:2]) < 0.03
    assert np.linalg.norm(log_so3(R.T @ R_true)) < 0.01
    assert share > 0.8


def test_no_kernel_is_left_to_compile_after_the_warm_up():
    config = msgspec.structs.replace(LioConfig(), features="edges_and_planes")
    warm_up(msgspec.structs.replace(EstimationConfig(), lio=config), Rig())
    kernels = (edges_module._lines, edges_module._edges, lines._find_lines, lines._linearise)
    before = [len(k.signatures) for k in kernels]
    fly(config)
    assert [len(k.signatures) for k in kernels] == before
    assert min(before) > 0
