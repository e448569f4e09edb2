"""Compile every kernel before the flight: a first scan must not wait for the compiler."""

from __future__ import annotations

import numpy as np

from companion.core.messages import Array32, CameraImage, ImuSample, LidarScan, LioState, freeze
from companion.core.rig import Rig
from companion.core.topics import CAMERA, IMU, LIDAR, LIO_STATE, ODOMETRY
from companion.estimation.config import EstimationConfig
from companion.estimation.course import Course
from companion.estimation.lio_node import LioNode
from companion.estimation.point_map import PointMap, PointMapConfig
from companion.estimation.propagator_node import PropagatorNode
from companion.estimation.start import start_filter
from companion.estimation.window.joint_window import JointWindow

IMU_PERIOD_NS, SWEEP_NS, FRAME_NS = 5_000_000, 100_000_000, 66_666_667
SECONDS = 3


def warm_up(config: EstimationConfig, rig: Rig) -> int:
    """Stand for 3 s among pillars, with nodes that are thrown away; returns how many states they gave."""
    PointMap(PointMapConfig()).insert(np.zeros((1 << 17, 3), np.float32), np.eye(3), np.zeros(3))  # its table grows
    _rescue(config, rig)
    lio, propagator = LioNode(config, rig), PropagatorNode(config)
    rng = np.random.default_rng(0)
    frame = rng.integers(0, 250, (rig.pinhole.height_px, rig.pinhole.width_px), dtype=np.uint8)
    outputs = []
    for stamp_ns in range(0, SECONDS * 1_000_000_000, IMU_PERIOD_NS):
        sample = freeze(_rest(stamp_ns))
        outputs += list(lio.handle(IMU, sample))
        list(propagator.handle(IMU, sample))
        if stamp_ns % SWEEP_NS == 0 and stamp_ns:
            outputs += list(lio.handle(LIDAR, freeze(_sweep(stamp_ns, rng))))
        if stamp_ns % FRAME_NS < IMU_PERIOD_NS:
            noisy = frame + rng.integers(0, 5, frame.shape, dtype=np.uint8)  # the same again would be a frozen camera's
            outputs += list(lio.handle(CAMERA, freeze(CameraImage(stamp_ns=stamp_ns, pixels=noisy))))
        states = [o.message for o in outputs if o.topic is LIO_STATE]
        for state in states[-1:]:
            _propagate(propagator, state, sample)
    return sum(o.topic is LIO_STATE for o in outputs)


def _rescue(config: EstimationConfig, rig: Rig) -> None:
    """What a rescue would run for the first time in the middle of a flight: a window that some sweeps leave again."""
    lio, rng, rest = config.lio, np.random.default_rng(0), np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 9.80665]])
    start = start_filter(np.repeat(rest, 20, axis=0), lio.start, t_s=0.0)
    window = JointWindow(Course(start), PointMap(lio.map), lio.rescue.window, lio, rig)
    for _ in range(lio.rescue.window.sweeps + 2):
        window.predict(np.repeat(np.column_stack([[0.005], rest]), 20, axis=0))
        sweep = freeze(_sweep(0, rng))
        window.add_sweep(sweep.points_sensor, sweep.point_age_s)


def _propagate(propagator: PropagatorNode, state: LioState, sample: ImuSample) -> None:
    list(propagator.handle(LIO_STATE, freeze(state)))
    assert all(o.topic is ODOMETRY for o in propagator.handle(IMU, sample))


def _rest(stamp_ns: int) -> ImuSample:
    return ImuSample(
        stamp_ns=stamp_ns, angular_velocity_body=np.zeros(3), specific_force_body=np.array([0.0, 0.0, 9.80665])
    )


def _sweep(stamp_ns: int, rng: np.random.Generator) -> LidarScan:
    """Ground and four pillars around the sensor, with some beams that meet nothing."""
    ground = rng.uniform([-12, -12, -0.5], [12, 12, -0.48], (4000, 3))
    ground[2000:, :2] /= 8.0  # dense below the camera, which begins where it knows how far it looks
    turns, centres = rng.uniform(0, 2 * np.pi, 4000), rng.choice([-5.0, 5.0], (4000, 2))
    pillars = np.column_stack(
        [centres + 0.2 * np.column_stack([np.cos(turns), np.sin(turns)]), rng.uniform(0, 6, 4000)]
    )
    points: Array32 = np.concatenate([ground, pillars]).astype(np.float32)
    up = rng.normal((0.0, 0.0, 4.0), 1.0, (500, 3))
    dirs: Array32 = (up / np.linalg.norm(up, axis=1, keepdims=True)).astype(np.float32)
    return LidarScan(
        stamp_ns=stamp_ns,
        points_sensor=points,
        point_age_s=rng.uniform(0, 0.1, len(points)).astype(np.float32),
        miss_dirs_sensor=dirs,
        miss_age_s=rng.uniform(0, 0.1, len(dirs)).astype(np.float32),
    )
