"""Estimators on real recordings: dead reckoning through gaps of RTK and GPS, and optical flow without any."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from companion.core.errors import InputError
from companion.core.messages import Array
from companion.estimation.filters.align_in_motion import align_in_motion
from companion.estimation.filters.extended import ExtendedFilter
from companion.estimation.filters.interface import Estimator, make_estimator
from companion.estimation.filters.kalman import Innovation
from companion.estimation.filters.measurements import GroundFlow, PositionFix, RangeBelow
from companion.estimation.filters.unscented import UnscentedFilter
from companion.estimation.propagation import ImuNoise
from companion.estimation.start import StartConfig, start_filter
from companion.estimation.state import State
from companion.runtime.bench.estimator_row import EstimatorRow
from companion.runtime.inertial_recordings import FlowRecording, InertialRecording, rtk_flight
from companion.runtime.trajectory_error import align

SETTLE_S = 10.0  # of each recording, before gaps are tried
CHI2_3 = 14.16  # 99.73 % of a 3-vector: three sigma of one figure


@dataclass(frozen=True, slots=True)
class FixStudy:
    """One kind of recording with fixes, and what its sensors are taken for."""

    name: str
    noise: ImuNoise
    fix_sigma_m: float
    window_s: float  # of the start in motion
    gaps_s: tuple[float, ...]
    start_sigmas: tuple[float, float, float, float, float]  # attitude, position, velocity, gyro bias, accel bias
    gravity_m_s2: float = 9.80665


# Xsens DOT on a DJI: rotors shake it by 3 to 6 m/s2, which its samples at 120 Hz alias.
RTK = FixStudy(
    "rtk",
    ImuNoise(
        gyro_rad_s_sqrt_hz=5e-3, accel_m_s2_sqrt_hz=0.1, gyro_walk_rad_s2_sqrt_hz=1e-4, accel_walk_m_s3_sqrt_hz=5e-3
    ),
    0.05,
    5.0,
    (1.0, 2.0, 3.0, 5.0),
    (0.3, 1.0, 1.0, 0.02, 0.3),
)
# Larger than the file that comes with it says: with those, three sigma cover four gaps of five.
KITTI = FixStudy(
    "kitti",
    ImuNoise(
        gyro_rad_s_sqrt_hz=5e-3, accel_m_s2_sqrt_hz=0.1, gyro_walk_rad_s2_sqrt_hz=3e-6, accel_walk_m_s3_sqrt_hz=1.7e-4
    ),
    0.07,
    10.0,
    (1.0, 2.0, 5.0, 10.0),
    (0.1, 1.0, 2.0, 5e-3, 0.1),
    gravity_m_s2=9.8,
)
FLOW_NOISE = ImuNoise(gyro_rad_s_sqrt_hz=5e-3, accel_m_s2_sqrt_hz=0.2)
FLOW_SIGMA, RANGE_SIGMA_M, FLOW_GATE = 0.1, 0.1, 25.0


@dataclass(slots=True)
class _Gaps:
    errors_m: dict[float, list[float]]
    covered: list[bool]
    innovation_m: list[float]
    nis: list[float]
    cpu_s: float = 0.0
    fixes: int = 0
    fixed_s: float = 0.0


def bench_fixes(
    study: FixStudy, recordings: Sequence[InertialRecording], names: Sequence[str]
) -> Iterator[EstimatorRow]:
    """Each estimator over all recordings: innovations, and error at the end of gaps that begin each second."""
    starts = [(r, _start(study, r)) for r in recordings]
    for name in names:
        found = _Gaps({gap: [] for gap in study.gaps_s}, [], [], [])
        for recording, start in starts:
            _run_fixes(study, recording, start, name, found)
        figures: dict[str, float | None] = {
            f"median error after {gap:g} s, m": float(np.median(e)) for gap, e in found.errors_m.items()
        }
        figures |= {f"95 % after {gap:g} s, m": float(np.percentile(e, 95)) for gap, e in found.errors_m.items()}
        figures |= {
            "gaps": float(len(found.covered)),
            "covered by 3 sigma": float(np.mean(found.covered)),
            "next fix, rms m": float(np.sqrt(np.mean(np.square(found.innovation_m)))),
            "NIS per dof": float(np.mean(found.nis)),
            "CPU ms per s": 1e3 * found.cpu_s / found.fixed_s,
        }
        yield EstimatorRow(study=study.name, case=f"{len(starts)} recordings", estimator=name, figures=figures)


def best_offset(study: FixStudy, recording: InertialRecording, *, reach_s: float = 1.0) -> float:
    """The clock offset of the fixes, s, that makes them most likely to an EKF: by 0.1 s, then by 0.02 s.

    The two clocks of a recording that was put together afterwards may differ by more than a second's tenth.
    """
    coarse = np.arange(-round(reach_s / 0.1), round(reach_s / 0.1) + 1) * 0.1
    centre = max(coarse, key=lambda offset: _likelihood(study, recording.shifted(float(offset))))
    fine = centre + np.arange(-5, 6) * 0.02
    return float(max(fine, key=lambda offset: _likelihood(study, recording.shifted(float(offset)))))


def _likelihood(study: FixStudy, recording: InertialRecording) -> float:
    """Mean log-likelihood of the fixes' innovations."""
    try:
        estimator, t_s = _make(study, recording, _start(study, recording), "ekf")
    except InputError:
        return -np.inf
    total, count = 0.0, 0
    for stamp_s, p in _fixes_after(recording, t_s):
        said = _take(study, estimator, recording, stamp_s, p)
        total -= 0.5 * (said.nis + float(np.linalg.slogdet(said.covariance)[1]))
        count += 1
    return total / max(count, 1)


def _start(study: FixStudy, recording: InertialRecording) -> tuple[float, State]:
    """Time and state of the first fix that has a whole window of IMU behind it."""
    inside = recording.fix_s > recording.imu_s[min(2, len(recording.imu_s) - 1)]
    begin = float(recording.fix_s[inside][0])
    window = inside & (recording.fix_s <= begin + study.window_s)
    imu = recording.pieces(begin, begin + study.window_s)
    found = align_in_motion(
        imu, recording.fix_s[window] - begin, recording.fix_p[window], gravity_m_s2=study.gravity_m_s2
    )
    return begin, found.state


def _make(
    study: FixStudy, recording: InertialRecording, start: tuple[float, State], name: str
) -> tuple[Estimator, float]:
    sigmas = np.repeat([*study.start_sigmas, 1e-6], 3)
    return make_estimator(name, start[1], np.diag(sigmas**2), study.noise, t_s=start[0]), start[0]


def _fixes_after(recording: InertialRecording, t_s: float) -> Iterator[tuple[float, Array]]:
    for stamp_s, p in zip(recording.fix_s, recording.fix_p, strict=True):
        if t_s < stamp_s <= recording.imu_s[-1]:
            yield float(stamp_s), p


def _take(study: FixStudy, estimator: Estimator, recording: InertialRecording, stamp_s: float, p: Array) -> Innovation:
    estimator.predict(recording.pieces(estimator.t_s, stamp_s), study.noise.densities)
    estimator.t_s = stamp_s
    return estimator.correct(PositionFix(p, study.fix_sigma_m**2 * np.eye(3)))


def _run_fixes(
    study: FixStudy, recording: InertialRecording, start: tuple[float, State], name: str, found: _Gaps
) -> None:
    estimator, begin = _make(study, recording, start, name)
    next_gap = begin + SETTLE_S
    for stamp_s, p in _fixes_after(recording, begin):
        before = time.process_time()
        said = _take(study, estimator, recording, stamp_s, p)
        found.cpu_s += time.process_time() - before
        if stamp_s > begin + SETTLE_S:
            found.innovation_m.append(float(np.linalg.norm(said.residual)))
            found.nis.append(said.nis / 3)
        if stamp_s >= next_gap:
            next_gap += 1.0
            _try_gaps(study, recording, estimator, name, found)
    found.fixed_s += estimator.t_s - begin


def _try_gaps(study: FixStudy, recording: InertialRecording, estimator: Estimator, name: str, found: _Gaps) -> None:
    """From the estimate of now through each gap on the IMU alone, to the fix at its end."""
    kind = UnscentedFilter if name == "ukf" else ExtendedFilter
    for gap, errors in found.errors_m.items():
        end_s = estimator.t_s + gap
        k = int(np.argmin(np.abs(recording.fix_s - end_s)))
        if abs(recording.fix_s[k] - end_s) > 0.1 or recording.fix_s[k] > recording.imu_s[-1]:
            continue
        blind = kind(estimator.state.copy(), estimator.P.copy(), estimator.t_s)
        blind.predict(recording.pieces(estimator.t_s, float(recording.fix_s[k])), study.noise.densities)
        off = recording.fix_p[k] - blind.state.p
        covariance = blind.P[3:6, 3:6] + study.fix_sigma_m**2 * np.eye(3)
        errors.append(float(np.linalg.norm(off)))
        found.covered.append(bool(off @ np.linalg.solve(covariance, off) < CHI2_3))


def bench_flow(recording: FlowRecording, names: Sequence[str], *, rest_s: float = 4.0) -> Iterator[EstimatorRow]:
    """Flow, IMU and range finder from rest, without fixes; speed and track against GPS."""
    for name in names:
        before = time.process_time()
        stamps, states = _run_flow(recording, name, rest_s)
        cpu_s = time.process_time() - before
        figures = _against_gps(recording, stamps, states) | {
            "CPU ms per s": float(1e3 * cpu_s / (stamps[-1] - stamps[0]))
        }
        yield EstimatorRow(study="flow", case=recording.inertial.name, estimator=name, figures=figures)


def _run_flow(recording: FlowRecording, name: str, rest_s: float) -> tuple[Array, Array]:
    inertial = recording.inertial
    resting = inertial.imu[(inertial.imu_s > rest_s - 2.0) & (inertial.imu_s <= rest_s)]
    start = start_filter(resting, StartConfig(accel_bias_sigma_m_s2=0.2), t_s=rest_s)
    start.state.gyro_bias[:] = 0.0  # the log's rates are already without it; two shaken seconds know less
    start.state.p[2] = recording.range_m[0]
    start.P[0:6, 0:6] = 1e-4 * np.eye(6)
    start.P[15:, :15], start.P[:15, 15:], start.P[15:, 15:] = 0.0, 0.0, 1e-10 * np.eye(3)
    start.P[0:2, 0:2] = (0.02**2) * np.eye(2)  # tilt by the accelerometer's bias
    estimator = make_estimator(name, start.state, start.P, FLOW_NOISE, t_s=rest_s)
    stamps, states = [], []
    for k, stamp_s in enumerate(recording.flow_s):
        if not rest_s < stamp_s < inertial.imu_s[-1]:
            continue
        estimator.predict(inertial.pieces(estimator.t_s, float(stamp_s)), FLOW_NOISE.densities)
        estimator.t_s = float(stamp_s)
        height = np.array([recording.range_m[k]])
        estimator.correct(RangeBelow(height, np.array([[RANGE_SIGMA_M**2]])), gate_nis=FLOW_GATE)
        if estimator.state.p[2] > 0.4:  # on the ground the camera is out of focus
            estimator.correct(GroundFlow(recording.flow[k], FLOW_SIGMA**2 * np.eye(2)), gate_nis=FLOW_GATE)
        stamps.append(float(stamp_s))
        states.append(estimator.state.x[9:15].copy())
    return np.array(stamps), np.array(states)


def _against_gps(recording: FlowRecording, stamps: Array, states: Array) -> dict[str, float | None]:
    inertial = recording.inertial
    used = (inertial.fix_s > stamps[0]) & (inertial.fix_s < stamps[-1])
    at = inertial.fix_s[used]
    p, v = (np.column_stack([np.interp(at, stamps, states[:, c]) for c in columns]) for columns in ((0, 1), (3, 4)))
    speed, gps_speed = np.linalg.norm(v, axis=1), recording.speed_m_s[used]
    reference = inertial.fix_p[used, :2]
    off = np.linalg.norm(align(p, reference) - reference, axis=1)
    return {
        "seconds": float(at[-1] - at[0]),
        "way by GPS speed, m": float(np.trapezoid(gps_speed, at)),
        "way, m": float(np.trapezoid(speed, at)),
        "speed error, rms m/s": float(np.sqrt(np.mean((speed - gps_speed) ** 2))),
        "track error after alignment, rms m": float(np.sqrt(np.mean(off**2))),
        "largest, m": float(off.max()),
    }


def rtk_recordings(files: Sequence[Path]) -> list[InertialRecording]:
    """Flights whose fixes' clock was put right."""
    return [r.shifted(best_offset(RTK, r)) for r in map(rtk_flight, files)]
