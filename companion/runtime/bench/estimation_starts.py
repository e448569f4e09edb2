"""From a wrong start in a map that is right: which estimator finds back, and how far off it is meanwhile.

for row in wrong_starts(folder, "forest_8_1", "none", config, (0.3, 3.0)):
    print(row.estimator, row.recovered, "of", row.starts)
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np

from companion.config import Config
from companion.core import topics
from companion.core.geometry import exp_so3, log_so3, rotation_from_quaternion
from companion.core.messages import Array, LidarScan, LioState
from companion.estimation.course import Course
from companion.estimation.downsample import Thinner
from companion.estimation.filter import Filter
from companion.estimation.imu_buffer import ImuBuffer
from companion.estimation.imu_doubt import new_buffer
from companion.estimation.lio import Lio, LioConfig
from companion.estimation.node import LioNode
from companion.estimation.point_map import PointMap
from companion.estimation.window.joint_window import JointWindow
from companion.runtime.bench.estimation_faults import fault
from companion.runtime.bench.estimation_joint import state_of
from companion.runtime.bench.estimation_recording import heard

TRIES = 4  # directions of the offset, at each place
_PLACES_S = (15.0, 22.0, 29.0)
_BLIND_S, _FOR_S = 0.5, 3.5  # sweeps come after it, as after a gap; then so long
_FOUND_M, _FOUND_RAD = 0.05, np.radians(0.5)


class StartRow(msgspec.Struct, frozen=True, kw_only=True):
    """One estimator from wrong starts whose covariance it knows; errors against the filter that was never off."""

    flight: str
    fault: str
    estimator: str
    offset_m: float
    offset_deg: float
    starts: int
    recovered: int  # within 5 cm and 0.5 degrees after 3 s of sweeps
    first_m: float  # after the first sweep, median
    last_m: float  # after 3 s, median
    worst_m: float  # after 3 s


@dataclass(slots=True)
class _Begin:
    """State and map at one time of a flight, and the IMU from there on: a buffer keeps 10 s only."""

    state: LioState
    map: PointMap
    imu: ImuBuffer


@dataclass(slots=True)
class _Flight:
    """What a replay of it needs."""

    scans: list[LidarScan] = field(default_factory=list)
    states: dict[int, LioState] = field(default_factory=dict)
    begins: list[_Begin] = field(default_factory=list)


Step = Callable[[Array, float, LidarScan | None], Filter]


def wrong_starts(
    folder: Path, flight: str, fault_text: str, config: Config, offset: tuple[float, float]
) -> Iterator[StartRow]:
    """One row per estimator, `offset` in m and degrees, in `TRIES` directions at each of three places."""
    flown = _fly(folder, fault_text, config)
    lio = config.estimation.lio
    standing = msgspec.structs.replace(lio.standing, enabled=False)
    off = msgspec.structs.replace(lio.rescue, enabled=False)
    alone = msgspec.structs.replace(lio, standing=standing, rescue=off)
    makers: dict[str, Callable[[Filter, PointMap], Step]] = {
        "filter": lambda start, known: _filter(start, known, alone, config),
        "filter with rescue": lambda start, known: _filter(
            start, known, msgspec.structs.replace(alone, rescue=lio.rescue), config
        ),
        "joint window": lambda start, known: _window(start, known, lio, config),
    }
    for name, make in makers.items():
        errors = [e for begin in flown.begins for e in _errors(begin, flown, make, offset)]
        yield _row(flight, fault_text, name, offset, errors)


def _fly(folder: Path, fault_text: str, config: Config) -> _Flight:
    """The filter's own flight, with a map of the sweeps that it registered."""
    lio, spoil, doubt = LioNode(config.estimation, config.rig), fault(fault_text), config.estimation.lio.imu_doubt
    flown, known, thinner = _Flight(), PointMap(config.estimation.lio.map), Thinner()
    for time_ns, topic, message in heard(folder):
        if time_ns > (_PLACES_S[-1] + _FOR_S + 1.0) * 1e9:
            break
        message = spoil(topic, message)
        if message is None or topic in (topics.TRUTH, topics.CAMERA):
            continue
        if topic is topics.IMU:
            for begin in flown.begins:
                if message.stamp_ns < begin.state.stamp_ns + (_FOR_S + 1.0) * 1e9:
                    begin.imu.append(message)
        if topic is topics.LIDAR:
            flown.scans.append(message)
        for output in lio.handle(topic, message):
            said = output.message
            if output.topic is topics.LIO_STATE and said.source == "lidar":
                flown.states[said.stamp_ns] = said
                if len(flown.begins) < len(_PLACES_S) and said.stamp_ns > _PLACES_S[len(flown.begins)] * 1e9:
                    flown.begins.append(_Begin(said, copy.deepcopy(known), new_buffer(doubt)))
            if output.topic is topics.REGISTERED:
                spaced = thinner.firsts(said.points_body, known.config.spacing_m)
                known.insert(spaced, rotation_from_quaternion(said.q_odom_body), said.p_odom)
    return flown


def _filter(start: Filter, known: PointMap, lio: LioConfig, config: Config) -> Step:
    estimator = Lio(start, lio, config.rig)
    estimator.map = known

    def step(imu: Array, t_s: float, scan: LidarScan | None) -> Filter:
        estimator.predict(imu)
        estimator.filter.t_s = t_s
        if scan is not None:
            estimator.update_lidar(scan.points_sensor, scan.point_age_s)
        return estimator.filter

    return step


def _window(start: Filter, known: PointMap, lio: LioConfig, config: Config) -> Step:
    estimator = JointWindow(Course(start), known, lio.rescue.window, lio, config.rig)

    def step(imu: Array, t_s: float, scan: LidarScan | None) -> Filter:
        estimator.predict(imu)
        estimator.filter.t_s = t_s
        if scan is not None:
            estimator.add_sweep(scan.points_sensor, scan.point_age_s)
        return estimator.filter

    return step


def _errors(
    begin: _Begin, flown: _Flight, make: Callable[[Filter, PointMap], Step], offset: tuple[float, float]
) -> Iterator[Array]:
    """Of each try: errors (N, 2) in m and rad after each sweep."""
    rng = np.random.default_rng(begin.state.stamp_ns)
    for _ in range(TRIES):
        shift, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)) * [[1.0, 1.0, 0.3], [1.0, 1.0, 1.0]])
        state, P = state_of(begin.state), np.array(begin.state.covariance)
        state.R[:] = state.R @ exp_so3(turn * np.radians(offset[1]))
        state.p[:] += shift * offset[0]
        P[:6, :6] += np.diag(np.repeat([np.radians(offset[1]), offset[0]], 3) ** 2)
        yield _run(begin, flown, make(Filter(state, P, 0.0), copy.deepcopy(begin.map)))


def _run(begin: _Begin, flown: _Flight, step: Step) -> Array:
    first_ns, errors = begin.state.stamp_ns, []
    last_ns = first_ns
    for scan in flown.scans:
        after_s = (scan.stamp_ns - first_ns) * 1e-9
        if not 0.0 < after_s <= _FOR_S or scan.stamp_ns not in flown.states:
            continue
        found = step(begin.imu.between(last_ns, scan.stamp_ns), after_s, scan if after_s > _BLIND_S else None).state
        last_ns, right = scan.stamp_ns, flown.states[scan.stamp_ns]
        turn = log_so3(rotation_from_quaternion(right.q_odom_body).T @ found.R)
        if after_s > _BLIND_S:
            errors.append((np.linalg.norm(found.p - right.p_odom), np.linalg.norm(turn)))
    return np.array(errors)


def _row(flight: str, fault_text: str, name: str, offset: tuple[float, float], errors: list[Array]) -> StartRow:
    last, first = np.array([e[-1] for e in errors]), np.array([e[0] for e in errors])
    found = (last[:, 0] < _FOUND_M) & (last[:, 1] < _FOUND_RAD)
    return StartRow(
        flight=flight,
        fault=fault_text,
        estimator=name,
        offset_m=offset[0],
        offset_deg=offset[1],
        starts=len(errors),
        recovered=int(found.sum()),
        first_m=float(np.median(first[:, 0])),
        last_m=float(np.median(last[:, 0])),
        worst_m=float(last[:, 0].max()),
    )
