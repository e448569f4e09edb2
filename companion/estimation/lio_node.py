"""Front-end node: IMU, scans and images in stamp order to states, registered scans, likelihoods."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

from companion.core.geometry import quaternion_from_rotation
from companion.core.messages import (
    CameraImage,
    ImuSample,
    LidarScan,
    LioState,
    PoseLikelihood,
    RegisteredScan,
    Why,
)
from companion.core.node import Node, Output, on
from companion.core.rig import Rig
from companion.core.topics import CAMERA, IMU, LIDAR, LIKELIHOOD, LIO_STATE, REGISTERED, WHY
from companion.estimation.config import EstimationConfig
from companion.estimation.imu_doubt import new_buffer
from companion.estimation.lio import Lio
from companion.estimation.normal import Normal
from companion.estimation.ordering import Reorder
from companion.estimation.scan_result import ScanResult
from companion.estimation.start import is_at_rest

_START_CHECK_NS = 100_000_000


class LioNode(Node):
    """Waits until the vehicle has stood still, then follows it; never stops for bad input.

    Work is done when the message that completes it arrives: mostly the scan or the image
    itself, and an IMU sample if a measurement was held back for an earlier one.
    """

    publishes = (LIO_STATE, REGISTERED, LIKELIHOOD, WHY)

    def __init__(self, config: EstimationConfig, rig: Rig) -> None:
        self._config, self._rig = config, rig
        self._imu = new_buffer(config.lio.imu_doubt)
        self._lio: Lio | None = None
        self._checked_ns = -(2**62)
        self._zero_ns = self._time_ns = 0
        self._trouble = self._weak = ""
        self._order = self._new_order()

    @property
    def dropped(self) -> int:
        """Scans and images that came too late or twice."""
        return self._order.dropped

    @on(IMU)
    def imu(self, sample: ImuSample) -> Iterator[Output]:
        """Buffer; start when at rest; release what waited for this time."""
        if not self._imu.append(sample):
            return
        if self._lio is None:
            yield from self._start_if_at_rest()
        else:
            yield from self._work_off(self._lio)

    @on(LIDAR)
    def lidar(self, scan: LidarScan) -> Iterator[Output]:
        """Queue a sweep."""
        yield from self._queue("lidar", scan)

    @on(CAMERA)
    def camera(self, image: CameraImage) -> Iterator[Output]:
        """Queue an image."""
        if self._config.camera.enabled:
            yield from self._queue("camera", image)

    def _queue(self, stream: str, measurement: LidarScan | CameraImage) -> Iterator[Output]:
        if self._lio is not None:
            self._order.put(stream, measurement.stamp_ns, measurement, now_ns=self._imu.newest_ns)
            yield from self._work_off(self._lio)

    def _start_if_at_rest(self) -> Iterator[Output]:
        now_ns, config = self._imu.newest_ns, self._config.lio.start
        if now_ns - self._checked_ns < _START_CHECK_NS:
            return
        self._checked_ns = now_ns
        begin_ns = now_ns - round(config.rest_s * 1e9)
        samples = self._imu.since(begin_ns)
        if not self._imu.covers(begin_ns) or len(samples) < 20 or not is_at_rest(samples, config):
            return
        self._lio = Lio.at_rest(samples, self._config.lio, self._rig, self._config.camera)
        self._zero_ns = self._time_ns = now_ns
        self._order = self._new_order()
        yield LIO_STATE(self._state(self._lio, "start", None))

    def _work_off(self, lio: Lio) -> Iterator[Output]:
        while self._lio is lio and (measurement := self._order.take(self._imu.newest_ns)) is not None:
            if measurement.stamp_ns < self._time_ns:
                continue  # from before the start
            self._advance(lio, measurement.stamp_ns)
            if isinstance(measurement, LidarScan):
                yield from self._take_scan(lio, measurement)
            else:
                yield from self._take_image(lio, measurement)
            if not lio.filter.is_sound:
                self._lio = None
                yield self._why("start again", "the filter's numbers are no longer finite")

    def _advance(self, lio: Lio, stamp_ns: int) -> None:
        when, longer_s = (self._time_ns, stamp_ns), self._config.lio.imu_doubt.clock_s
        gap_s, otherwise = self._imu.longest_gap_s(*when), None
        if gap_s > longer_s and self._imu.is_clock_in_doubt(*when, longer_s=longer_s):
            otherwise = self._imu.had_the_clock_jumped(*when, longer_s=longer_s)
        lio.predict(self._imu.between(*when), gap_s=gap_s, otherwise=otherwise)
        self._time_ns = stamp_ns
        lio.filter.t_s = (stamp_ns - self._zero_ns) * 1e-9  # no rounding adds up

    def _take_scan(self, lio: Lio, scan: LidarScan) -> Iterator[Output]:
        result = lio.update_lidar(scan.points_sensor, scan.point_age_s)
        used = result.normal is None or (result.agrees and result.normal.used >= self._config.lio.min_planes)
        if result.normal is not None and used:
            yield LIO_STATE(self._state(lio, "lidar", result.normal))
            yield LIKELIHOOD(self._likelihood("lidar", result.normal))
        if used and len(result.points_body):
            yield REGISTERED(self._registered(lio, scan, result))
        yield from self._tell_trouble(result)

    def _take_image(self, lio: Lio, image: CameraImage) -> Iterator[Output]:
        normal = lio.update_camera(image.pixels)
        if normal is not None:
            yield LIO_STATE(self._state(lio, "camera", normal))
            yield LIKELIHOOD(self._likelihood("camera", normal))

    def _state(self, lio: Lio, source: Literal["start", "lidar", "camera"], normal: Normal | None) -> LioState:
        state = lio.filter.state
        return LioState(
            stamp_ns=self._time_ns,
            p_odom=state.p.copy(),
            q_odom_body=quaternion_from_rotation(state.R),
            v_odom=state.v.copy(),
            gyro_bias_body=state.gyro_bias.copy(),
            accel_bias_body=state.accel_bias.copy(),
            gravity_odom=state.g.copy(),
            covariance=lio.covariance,
            source=source,
            inlier_fraction=normal.used / normal.offered if normal else 0.0,
            weakest_direction=normal.weakest if normal else 0.0,
            doubts=self._doubts(lio, source, normal),
        )

    def _doubts(self, lio: Lio, source: str, normal: Normal | None) -> str:
        """Weak axes of the newest sweep, and what is wrong with the sensors."""
        if source == "lidar" and normal is not None:
            self._weak = ", ".join(normal.weak_axes(self._config.lio.weak_below))
        doubts = [f"LiDAR blind in {self._weak}" if self._weak else "", lio.objection]
        return "; ".join(d for d in doubts if d)

    def _likelihood(self, source: Literal["lidar", "camera"], normal: Normal) -> PoseLikelihood:
        return PoseLikelihood(
            stamp_ns=self._time_ns,
            p_odom=normal.p,
            q_odom_body=quaternion_from_rotation(normal.R),
            information=normal.H,
            gradient=normal.g,
            source=source,
        )

    def _registered(self, lio: Lio, scan: LidarScan, result: ScanResult) -> RegisteredScan:
        state = lio.filter.state
        return RegisteredScan(
            stamp_ns=scan.stamp_ns,
            points_body=result.points_body,
            miss_dirs_body=lio.turn_directions(scan.miss_dirs_sensor, scan.miss_age_s),
            origin_body=self._rig.lidar.p_body,
            p_odom=state.p.copy(),
            q_odom_body=quaternion_from_rotation(state.R),
        )

    def _tell_trouble(self, result: ScanResult) -> Iterator[Output]:
        """Say once when scans stop being of use, and once when they are again."""
        trouble = ""
        if not len(result.points_body):
            trouble = "no return in range"
        elif result.normal is not None and result.normal.used < self._config.lio.min_planes:
            trouble = "hardly a point fits the map"
        elif not result.agrees:
            trouble = "after a gap, they do not agree with the map yet"
        if trouble != self._trouble:
            yield self._why("leave scans out" if trouble else "use scans again", trouble or "they fit the map")
        self._trouble = trouble

    def _why(self, what: str, because: str) -> Output:
        return WHY(Why(stamp_ns=self._time_ns, node="LioNode", what=what, because=because))

    def _new_order(self) -> Reorder[LidarScan | CameraImage]:
        c = self._config.order
        periods = {"lidar": round(c.lidar_period_s * 1e9), "camera": round(c.camera_period_s * 1e9)}
        return Reorder(hold_back_ns=round(c.hold_back_s * 1e9), periods_ns=periods)
