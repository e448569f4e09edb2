"""Recorded flights of the simulator replayed through the front end: EKF, UKF, EKF with graph, and MCL in the map of it.

A recording is a folder with a `flight.log` that holds IMU, LiDAR, camera and truth (`companion fly --record`).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from companion.config import Config
from companion.core import topics
from companion.core.errors import InputError
from companion.core.geometry import rotation_from_quaternion, yaw_of
from companion.core.messages import Array, Array32, GroundTruth, LioState, SmoothedState
from companion.core.node import Topic
from companion.estimation.mcl.particles import MclConfig, MonteCarlo
from companion.estimation.mcl.prior_map import FieldModel, PriorMap
from companion.estimation.node import GraphNode, LioNode
from companion.estimation.warm_up import warm_up
from companion.runtime.bench.estimator_row import EstimatorRow
from companion.runtime.codec import decode
from companion.runtime.log_file import Message, entries
from companion.runtime.trajectory_error import track_error

HEARD = {t.name: t for t in (topics.IMU, topics.LIDAR, topics.CAMERA, topics.TRUTH)}
MCL = MclConfig(
    model=FieldModel(independent=8.0), climb_sigma_m=0.02, slow_rate=0.0, resample_below=0.5, fewest=1000, most=5000
)
MAP_CELL_M, MAP_REACH_M, VIEW_POINTS = 0.2, 1.0, 200
START_SIGMAS = np.array([0.3, 0.3, 0.1, 0.05])


@dataclass(slots=True)
class Run:
    """What an estimator said, at the scans; the graph's covariances are left out, since its frame is levelled anew."""

    stamps_ns: list[int] = field(default_factory=list)
    p: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    P_p: list[Array] = field(default_factory=list)
    P_v: list[Array] = field(default_factory=list)
    cpu_s: float = 0.0


@dataclass(slots=True)
class Flight:
    """The truth, and what MCL needs of the EKF's run."""

    truth_ns: list[int] = field(default_factory=list)
    truth_p: list[Array] = field(default_factory=list)
    truth_v: list[Array] = field(default_factory=list)
    truth_q: list[Array] = field(default_factory=list)
    views: list[tuple[int, Array32, Array, Array]] = field(default_factory=list)  # stamp, points_body, p, q


def bench_flight(folder: Path, config: Config, *, for_s: float) -> Iterator[EstimatorRow]:
    """The first `for_s` seconds with each estimator; raises InputError if sensors or truth are not recorded."""
    case, flight = folder.name, Flight()
    warm_up(config.estimation, config.rig)
    ekf, graph = _replay(folder, config, "ekf", for_s, flight)
    if not flight.views or not flight.truth_ns:
        raise InputError("holds no scans or no truth", file=str(folder), valid="a folder of companion fly --record")
    yield EstimatorRow(study="flights", case=case, estimator="ekf", figures=_figures(ekf, flight))
    ukf, _ = _replay(folder, config, "ukf", for_s, Flight())
    yield EstimatorRow(study="flights", case=case, estimator="ukf", figures=_figures(ukf, flight))
    yield EstimatorRow(
        study="flights", case=case, estimator="ekf and graph", figures=_figures(graph, flight, level=True)
    )
    yield EstimatorRow(study="flights", case=case, estimator="mcl", figures=_figures(_localise(flight), flight))


def _messages(folder: Path, for_s: float) -> Iterator[tuple[Topic[Any], Any]]:
    log = folder / "flight.log"
    if not log.is_file():
        raise InputError("holds no log", file=str(folder), valid="a folder with flight.log")
    first = None
    for entry in entries(log):
        if not isinstance(entry, Message) or entry.topic not in HEARD or entry.payload is None:
            continue
        first = entry.time_ns if first is None else first
        if entry.time_ns - first > for_s * 1e9:
            return
        topic = HEARD[entry.topic]
        yield topic, decode(entry.payload, topic.type)


def _replay(folder: Path, config: Config, kind: str, for_s: float, flight: Flight) -> tuple[Run, Run]:
    start = msgspec.structs.replace(config.estimation.lio.start, filter=kind)
    front_end = msgspec.structs.replace(config.estimation.lio, start=start)
    chosen = msgspec.structs.replace(config.estimation, lio=front_end)
    lio, graph = LioNode(chosen, config.rig), GraphNode(chosen, config.rig)
    run, smoothed = Run(), Run()
    for topic, message in _messages(folder, for_s):
        if topic is topics.TRUTH:
            _note_truth(message, flight)
            continue
        before = time.process_time()
        told = list(lio.handle(topic, message))
        run.cpu_s += time.process_time() - before
        smoothed.cpu_s += time.process_time() - before
        if kind == "ekf":
            before = time.process_time()
            if topic is topics.IMU:
                list(graph.handle(topic, message))
            outputs = [o for t in told if t.topic in GraphNode.subscribes for o in graph.handle(t.topic, t.message)]
            smoothed.cpu_s += time.process_time() - before
            _note_smoothed([o.message for o in outputs if o.topic is topics.SMOOTHED], smoothed)
        for output in told:
            if output.topic is topics.LIO_STATE and output.message.source == "lidar":
                _note(output.message, run)
            if output.topic is topics.REGISTERED:
                m = output.message
                flight.views.append((m.stamp_ns, m.points_body, m.p_odom, m.q_odom_body))
    return run, smoothed


def _note_truth(message: GroundTruth, flight: Flight) -> None:
    flight.truth_ns.append(message.stamp_ns)
    flight.truth_p.append(message.p_world)
    flight.truth_v.append(message.v_world)
    flight.truth_q.append(message.q_world_body)


def _note(state: LioState, run: Run) -> None:
    run.stamps_ns.append(state.stamp_ns)
    run.p.append(state.p_odom)
    run.v.append(state.v_odom)
    run.P_p.append(state.covariance[3:6, 3:6])
    run.P_v.append(state.covariance[6:9, 6:9])


def _note_smoothed(messages: list[SmoothedState], run: Run) -> None:
    for m in messages:
        run.stamps_ns.append(m.stamp_ns)
        run.p.append(m.p_map)
        run.v.append(m.v_map)


def _localise(flight: Flight) -> Run:
    """MCL in the map that the EKF's run made, with its steps made noisy; it starts near, not at, the truth."""
    rng, run = np.random.default_rng(1), Run()
    known = np.concatenate([pts[::4] @ rotation_from_quaternion(q).T + p for _, pts, p, q in flight.views])
    cells = np.unique(np.floor(known / MAP_CELL_M), axis=0)
    centres: Array = (cells.astype(np.float64) + 0.5) * MAP_CELL_M
    prior = PriorMap(centres, cell_m=MAP_CELL_M, reach_m=MAP_REACH_M)
    pose = np.append(flight.views[0][2], yaw_of(flight.views[0][3]))
    mcl = MonteCarlo(pose + rng.normal(0.0, 1.0, (5000, 4)) * START_SIGMAS, prior, MCL)
    for stamp_ns, points, p, q in flight.views:
        before = time.process_time()
        now = np.append(p, yaw_of(q))
        step, turn = now[:3] - pose[:3], float(np.arctan2(np.sin(now[3] - pose[3]), np.cos(now[3] - pose[3])))
        c, s = np.cos(pose[3]), np.sin(pose[3])
        body = np.array([c * step[0] + s * step[1], -s * step[0] + c * step[1], step[2]])
        noisy = body * (1.0 + rng.normal(0.0, 0.05, 3)) + rng.normal(0.0, 0.01, 3)
        mcl.move(rng, noisy, turn + float(rng.normal(0.0, 0.003)))
        pose = now
        level = _about_vertical(-now[3]) @ rotation_from_quaternion(q)
        few = points[:: max(1, len(points) // VIEW_POINTS)].astype(np.float64)
        mcl.see(few @ level.T)
        found = mcl.estimate()
        mcl.resample(rng)
        run.cpu_s += time.process_time() - before
        run.stamps_ns.append(stamp_ns)
        run.p.append(found.pose[:3])
        run.P_p.append(found.covariance[:3, :3])
    return run


def _figures(run: Run, flight: Flight, *, level: bool = False) -> dict[str, float | None]:
    at = np.array(run.stamps_ns)
    known, truth_p = np.array(flight.truth_ns), np.array(flight.truth_p)
    error = track_error(at, np.array(run.p), known, truth_p, flat=False)
    if error is None:
        return {"scans": float(len(at))}
    truth = (truth_p, np.array(flight.truth_v))
    p, v = (np.column_stack([np.interp(at, known, a[:, k]) for k in range(3)]) for a in truth)
    R = _world_from(flight, int(at[0]), level=level)
    off = np.array(run.p) - np.array(run.p)[0] - (p - p[0]) @ R
    slip = np.array(run.v) - v @ R if run.v else None
    return {
        "scans": float(len(at)),
        "way, m": error.length_m,
        "ATE, m": error.ate_m,
        "drift, %": 100.0 * error.end_m / error.length_m,
        "NEES per dof, position": _nees(off, run.P_p) if run.P_p else None,
        "NEES per dof, velocity": _nees(slip, run.P_v) if slip is not None and run.P_v else None,
        "CPU ms per scan": 1e3 * run.cpu_s / len(at),
    }


def _world_from(flight: Flight, stamp_ns: int, *, level: bool) -> Array:
    """Rotation of the estimate's frame into the world: of `odom`, whose tilt the start fixes, or of the level `map`."""
    k = min(int(np.searchsorted(flight.truth_ns, stamp_ns)), len(flight.truth_q) - 1)
    true, said = flight.truth_q[k], flight.views[0][3]
    if level:
        return _about_vertical(yaw_of(true) - yaw_of(said))
    return rotation_from_quaternion(true) @ rotation_from_quaternion(said).T


def _about_vertical(yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _nees(errors: Array, covariances: list[Array]) -> float:
    """Mean over the second half, per degree of freedom."""
    half = len(errors) // 2
    pairs = zip(errors[half:], covariances[half:], strict=True)
    return float(np.mean([e @ np.linalg.solve(P, e) / 3 for e, P in pairs]))
