"""Rows of `companion bench estimation`: our estimator, and peers, on recorded flights with and without faults.

for row in bench_flight(folder, "forest 4 m/s", ["none", "range_12"], config):
    print(row.ate_m, row.nees.position)
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np

from companion.config import Config
from companion.core.geometry import rotation_from_quaternion
from companion.core.messages import Array
from companion.core.rig import Rig
from companion.runtime.bench.estimation_faults import fault
from companion.runtime.bench.estimation_gaps import Gap, gaps_of, returns_of
from companion.runtime.bench.estimation_peers import Peer, peers
from companion.runtime.bench.estimation_recording import heard, true_biases
from companion.runtime.bench.estimation_replay import Run, feed
from companion.runtime.bench.estimation_score import (
    Nees,
    Truth,
    accuracy,
    estimates_of,
    nees_of,
    rank_correlation,
    relative_m,
    truth_at,
)

OWN, GRAPH, JOINT = "understory", "graph", "joint window"
PEER_RANGE_M = 60.0
_OFFSETS_NS = (0, -50_000_000, -100_000_000)  # a peer may mean any part of a sweep; the best counts


class EstimationRow(msgspec.Struct, frozen=True, kw_only=True, omit_defaults=True):
    """One estimator on one flight; null: does not apply."""

    flight: str
    fault: str
    estimator: str
    ate_m: float
    worst_m: float
    drift_percent: float
    length_m: float
    front_ms: float  # CPU per sweep: filter with all sensors
    all_ms: float  # propagator and graph, too
    relative_m: float | None = None  # rms error of the motion over 1 s
    back_m: tuple[tuple[float, float], ...] = ()  # gaps: error at the first sweep after, and 3 s later
    nees: Nees | None = None
    covered: float | None = None  # share of the time in which the position error is within three published sigmas
    quality_rank: float | None = None  # Spearman's, of published quality and accuracy
    gaps: tuple[Gap, ...] = ()  # where the LiDAR was out
    why: tuple[str, ...] = ()  # what the nodes said


def bench_flight(
    folder: Path, flight: str, faults: Sequence[str], config: Config, *, peers_until_s: float, joint: bool = False
) -> Iterator[EstimationRow]:
    """One row per fault, and one per peer on the flight without faults, up to `peers_until_s`; 0: no peers.

    `joint`: rows of the graph and of a joint window that ran beside the filter, too.
    """
    for text in faults:
        others = peers(max_range_m=PEER_RANGE_M) if peers_until_s > 0.0 and text == "none" else {}
        run = feed(
            heard(folder),
            config.estimation,
            config.rig,
            spoil=fault(text),
            with_joint=joint,
            others=list(others.values()),
            others_until_s=peers_until_s,
        )
        yield own_row(run, flight, text, true_biases(folder))
        if joint:
            yield graph_row(run, flight, text)
            yield joint_row(run, flight, text, true_biases(folder))
        for name, peer in others.items():
            yield peer_row(name, peer, run, flight, config.rig)


def own_row(run: Run, flight: str, fault_text: str, biases: tuple[Array, Array] | None) -> EstimationRow:
    """Figures of our run."""
    e = estimates_of(run.states)
    true = truth_at(run.truth, e.stamps_ns, R_first=e.R[0], p_first=e.p[0])
    found = accuracy(e.stamps_ns, e.R, e.p, run.truth)
    stamps_ns = np.array([o.stamp_ns for o in run.odometry])
    published = truth_at(run.truth, stamps_ns, R_first=e.R[0], p_first=e.p[0])
    covered, rank = _published(run, published)
    return EstimationRow(
        flight=flight,
        fault=fault_text,
        estimator=OWN,
        **msgspec.structs.asdict(found),
        front_ms=run.cpu_ms_per_scan("LioNode"),
        all_ms=run.cpu_ms_per_scan("LioNode", "PropagatorNode", "GraphNode"),
        relative_m=relative_m(e.stamps_ns, e.R, e.p, true),
        back_m=returns_of(e.stamps_ns, true.p - e.p),
        nees=nees_of(e, true, biases),
        covered=covered,
        quality_rank=rank,
        gaps=gaps_of(run, published),
        why=tuple(f"{w.stamp_ns * 1e-9:.1f} s: {w.what}: {w.because}" for w in run.why),
    )


def graph_row(run: Run, flight: str, fault_text: str) -> EstimationRow:
    """Figures of the newest node of the graph, in `map`; its covariance is that of a pose alone."""
    stamps_ns = np.array([s.stamp_ns for s in run.smoothed])
    R, p = (
        np.array([rotation_from_quaternion(s.q_map_body) for s in run.smoothed]),
        np.array([s.p_map for s in run.smoothed]),
    )
    true = truth_at(run.truth, stamps_ns, R_first=R[0], p_first=p[0])
    own_ms = run.cpu_ms_per_scan("GraphNode")
    return EstimationRow(
        flight=flight,
        fault=fault_text,
        estimator=GRAPH,
        **msgspec.structs.asdict(accuracy(stamps_ns, R, p, run.truth)),
        front_ms=own_ms,
        all_ms=own_ms,
        relative_m=relative_m(stamps_ns, R, p, true),
        back_m=returns_of(stamps_ns, true.p - p),
    )


def joint_row(run: Run, flight: str, fault_text: str, biases: tuple[Array, Array] | None) -> EstimationRow:
    """Figures of the joint window's newest state; it has the filter's start, and so its `odom`."""
    e = estimates_of([run.states[0], *run.joint])
    true = truth_at(run.truth, e.stamps_ns, R_first=e.R[0], p_first=e.p[0])
    own_ms = run.cpu_ms_per_scan("JointWindowNode")
    return EstimationRow(
        flight=flight,
        fault=fault_text,
        estimator=JOINT,
        **msgspec.structs.asdict(accuracy(e.stamps_ns, e.R, e.p, run.truth)),
        front_ms=own_ms,
        all_ms=own_ms,
        relative_m=relative_m(e.stamps_ns, e.R, e.p, true),
        back_m=returns_of(e.stamps_ns, true.p - e.p),
        nees=nees_of(e, true, biases),
    )


def peer_row(name: str, peer: Peer, run: Run, flight: str, rig: Rig) -> EstimationRow:
    """Figures of a peer; its poses of the sensor become poses of the body."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rig.lidar.R_body_sensor, rig.lidar.p_body
    body = np.array([T @ pose @ np.linalg.inv(T) for pose in peer.poses])
    stamps = np.array(peer.stamps_ns)
    tries = [accuracy(stamps + offset, body[:, :3, :3], body[:, :3, 3], run.truth) for offset in _OFFSETS_NS]
    best = min(tries, key=lambda found: found.ate_m)
    cpu_ms = 1e3 * peer.cpu_s / len(stamps)
    return EstimationRow(
        flight=flight,
        fault="none",
        estimator=name,
        **msgspec.structs.asdict(best),
        front_ms=cpu_ms,
        all_ms=cpu_ms,
    )


def _published(run: Run, true: Truth) -> tuple[float, float]:
    """Of the odometry: share within three sigmas on every axis, and the rank of its quality."""
    off = np.array([o.p_odom for o in run.odometry]) - true.p
    sigma = np.sqrt([o.pose_variance[3:] for o in run.odometry])
    quality = np.array([o.quality for o in run.odometry])
    within = (np.abs(off) <= 3.0 * sigma).all(axis=1)
    return float(within.mean()), rank_correlation(quality, np.linalg.norm(off, axis=1))
