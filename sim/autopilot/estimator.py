"""The autopilot's own estimator, with PX4's rules of what to fuse, what to reset, what to trust.

It knows the IMU, the barometer, GPS and the companion's ODOMETRY, never the truth. All
stamps here are autopilot time; all arrays are NED/FRD except the IMU's, which are FLU.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from companion.core.messages import Array
from sim.autopilot import ekf
from sim.autopilot.frames import quaternion_from_euler, turn_about_down
from sim.autopilot.params import Parameters
from sim.autopilot.readings import ExternalPose, GpsFix

ALIGN_SAMPLES: Final = 200  # at rest before roll, pitch and gyro bias are set
HPOS, VPOS, VELOCITY, YAW = 1, 2, 4, 8  # bits of EKF2_EV_CTRL; EKF2_GPS_CTRL has the first three
VISION_HEIGHT: Final = 3  # EKF2_HGT_REF
BARO_BIAS_GAIN: Final = 0.01  # per reading
NS: Final = 1_000_000_000
NEVER: Final = -(1 << 62)


class Estimator:
    """Error-state filter at the rate of the IMU; delayed measurements meet the state of their time."""

    def __init__(self, parameters: Parameters, *, boot_heading: float | None) -> None:
        self._parameters = parameters
        self.x = np.zeros(16)
        self.x[0] = 1.0
        self.P = np.diag([0.01, 0.01, 4.0, *[0.25] * 3, *[1.0] * 3, *[1e-4] * 3, *[0.04] * 3])
        self._ring = np.zeros((ekf.RING, ekf.PAST))
        self._stamps = np.full(ekf.RING, NEVER, np.int64)
        self._head = 0
        self._work = np.zeros(ekf.WORK)
        self._noise = np.zeros(7)
        self._align = np.zeros(6)
        self._align_count = 0
        self._boot_heading = boot_heading
        self._past, self._z, self._ratios = np.zeros(ekf.PAST), np.zeros(ekf.ROWS), np.zeros(ekf.ROWS)
        self._aided_ns = [NEVER] * ekf.ROWS  # stamp of the newest fused p, v, yaw
        self._last_counter = -1
        self._baro_bias = math.nan
        self.baro_altitude = math.nan
        self.range_m = math.nan
        self.resets = 0
        self.attitude_valid = False
        self.yaw_aligned = boot_heading is not None
        self.global_position = False
        self.test_ratios = np.full(ekf.ROWS, np.nan)
        self.now_ns = 0
        self._vision_ns = NEVER
        self._cache = -1

    @property
    def q(self) -> Array:
        """q_ned_frd, wxyz, (4,)."""
        return self.x[0:4]

    @property
    def v(self) -> Array:
        """v_ned, m/s, (3,)."""
        return self.x[4:7]

    @property
    def p(self) -> Array:
        """p_ned, m, (3,)."""
        return self.x[7:10]

    @property
    def acceleration(self) -> Array:
        """NED, gravity added, low-passed, m/s2, (3,)."""
        return self._work[ekf.LP_ACC : ekf.LP_ACC + 3]

    @property
    def omega(self) -> Array:
        """FRD, bias removed, rad/s, (3,)."""
        return self._work[ekf.OMEGA : ekf.OMEGA + 3]

    @property
    def force(self) -> Array:
        """Specific force FRD, bias removed, m/s2, (3,)."""
        return self._work[ekf.FORCE : ekf.FORCE + 3]

    @property
    def vibration(self) -> Array:
        """Mean change of the specific force from sample to sample, m/s2, (3,): PX4's measure."""
        return self._work[ekf.SHAKE : ekf.SHAKE + 3]

    @property
    def has_compass(self) -> bool:
        """It knew its heading at boot."""
        return self._boot_heading is not None

    @property
    def xy_valid(self) -> bool:
        """Horizontal position and velocity are usable: something was fused recently enough."""
        return self.attitude_valid and self.yaw_aligned and self._silent_ns(0, 1) < self._no_aid_ns()

    @property
    def z_valid(self) -> bool:
        """Height is usable: from vision, GPS or the barometer."""
        return self.attitude_valid and self._silent_ns(2) < self._no_aid_ns()

    def _silent_ns(self, *rows: int) -> int:
        return self.now_ns - min(self._aided_ns[row] for row in rows)

    def _no_aid_ns(self) -> int:
        """Dead reckoning allowed: EKF2_NOAID_TOUT less the horizon EKF2_DELAY_MAX (PX4: 4.8 s, observed)."""
        return int(self._parameters["EKF2_NOAID_TOUT"] * 1e3 - self._parameters["EKF2_DELAY_MAX"] * 1e6)

    def imu(self, now_ns: int, gyro_flu: Array, accel_flu: Array, dt: float) -> None:
        """One IMU sample: means over the `dt` seconds that end now."""
        self.now_ns = now_ns
        if not (np.isfinite(gyro_flu).all() and np.isfinite(accel_flu).all()):
            return
        if not self.attitude_valid:
            self._align_at_rest(now_ns, gyro_flu, accel_flu)
            return
        if self._cache != self._parameters.version or self._noise[0] != dt:
            self._read_noise(dt)
        self._head = (self._head + 1) % ekf.RING
        ekf.imu_step(
            self.x, self.P, self._ring, self._work, self._head, gyro_flu, accel_flu, self._noise
        )  # fmt: skip
        self._stamps[self._head] = now_ns

    def _read_noise(self, dt: float) -> None:
        p = self._parameters
        smooth = 1.0 - math.exp(-2 * math.pi * p["MPC_VELD_LP"] * dt)
        walk = p["EKF2_GYR_B_NOISE"], p["EKF2_ACC_B_NOISE"]
        self._noise[:] = dt, 0.01, smooth, p["EKF2_GYR_NOISE"], p["EKF2_ACC_NOISE"], *walk
        self._cache = p.version

    def _align_at_rest(self, now_ns: int, gyro_flu: Array, accel_flu: Array) -> None:
        """Roll, pitch and gyro bias from samples without motion; starts anew when it is moved."""
        if np.abs(gyro_flu).max() > 0.5 or abs(np.linalg.norm(accel_flu) - ekf.GRAVITY) > 3.0:
            self._align_count = 0
            self._align[:] = 0.0
            return
        self._align[:3] += gyro_flu
        self._align[3:] += accel_flu
        self._align_count += 1
        if self._align_count < ALIGN_SAMPLES:
            return
        mean = self._align / self._align_count
        fx, fy, fz = mean[3], -mean[4], -mean[5]
        roll, pitch = math.atan2(-fy, -fz), math.atan2(fx, math.hypot(fy, fz))
        self.x[0:4] = quaternion_from_euler(roll, pitch, self._boot_heading or 0.0)
        limit = self._parameters["EKF2_GYR_B_LIM"]
        self.x[10:13] = np.clip(mean[:3] * (1.0, -1.0, -1.0), -limit, limit)
        if self.yaw_aligned:
            self.P[2, 2] = 0.1**2
        self._ring[:, :] = self.x[:10]
        self._stamps[:] = now_ns
        self.attitude_valid = True

    def external_pose(self, pose: ExternalPose) -> None:
        """Fuse an ODOMETRY as EKF2_EV_CTRL allows.

        The state is reset to the first one, at a new reset counter, and after long rejection.
        """
        control = self._parameters.integer("EKF2_EV_CTRL")
        if not self.attitude_valid or pose.quality < self._parameters["EKF2_EV_QMIN"]:
            return
        stamp = min(pose.stamp_ns - int(self._parameters["EKF2_EV_DELAY"] * 1e6), self.now_ns)
        if ekf.past_state(self._ring, self._stamps, stamp, self._past) > 0:
            return  # older than EKF2_DELAY_MAX can hold
        self._measured(pose, control)
        variance = self._variance(pose)
        counter_changed = self._last_counter >= 0 and pose.reset_counter != self._last_counter
        self._last_counter = pose.reset_counter
        if control & YAW and math.isfinite(pose.yaw) and (not self.yaw_aligned or counter_changed):
            self._reset(6, variance)
            self.yaw_aligned = True
            self._measured(pose, control)
        if self.yaw_aligned:
            self._vision_ns = stamp
            for row in range(6):
                if counter_changed or self.now_ns - self._aided_ns[row] > self._parameters["EKF2_NOAID_TOUT"] * 1e3:
                    self._reset(row, variance)
            self._fuse(stamp, variance, self._vision_gates())

    def _measured(self, pose: ExternalPose, control: int) -> None:
        """Rows of the measurement in our frame into `_z`; NaN where not wanted."""
        p, v, yaw = pose.p, pose.v, pose.yaw
        own_yaw = ekf.yaw_of(self._past)
        if not control & YAW and not pose.aligned_with_north and math.isfinite(yaw):
            turn = turn_about_down(own_yaw - yaw)  # the companion's frame stands askew to ours
            p, v = turn @ p, (v if pose.v_in_body else turn @ v)
        if pose.v_in_body:
            v = ekf.rotation_of(self._past) @ v
        z = self._z
        z[0:2] = p[:2] if control & HPOS else np.nan
        z[2] = p[2] if control & VPOS else np.nan
        z[3:6] = v if control & VELOCITY else np.nan
        z[6] = yaw if control & YAW else np.nan

    def _variance(self, pose: ExternalPose) -> Array:
        """The message's variances, not below the parameters'; these alone if EKF2_EV_NOISE_MD is 1."""
        p = self._parameters
        floor = np.array([p["EKF2_EVP_NOISE"]] * 3 + [p["EKF2_EVV_NOISE"]] * 3 + [p["EKF2_EVA_NOISE"]]) ** 2
        if p.integer("EKF2_EV_NOISE_MD") == 1:
            return floor
        larger: Array = np.fmax(pose.variance, floor)
        return larger

    def _vision_gates(self) -> Array:
        p = self._parameters
        return np.array([p["EKF2_EVP_GATE"]] * 3 + [p["EKF2_EVV_GATE"]] * 3 + [p["EKF2_HDG_GATE"]])

    def _reset(self, row: int, variance: Array) -> None:
        if math.isfinite(self._z[row]):
            ekf.reset_row(self.x, self.P, self._ring, self._past, row, self._z[row], variance[row])
            self._aided_ns[row] = self.now_ns
            if row in (0, 2, 6):  # one count per jump, not per axis
                self.resets += 1

    def _fuse(self, stamp_ns: int, variance: Array, gates: Array) -> None:
        ekf.fuse_pose(self.x, self.P, self._ring, self._past, self._z, variance, gates, self._ratios)
        for row, ratio in enumerate(self._ratios.tolist()):
            if ratio == ratio:
                self.test_ratios[row] = ratio
                if ratio < 1.0:
                    self._aided_ns[row] = stamp_ns
        self._limit_biases()

    def _limit_biases(self) -> None:
        gyro, accel = self._parameters["EKF2_GYR_B_LIM"], self._parameters["EKF2_ABL_LIM"]
        np.clip(self.x[10:13], -gyro, gyro, out=self.x[10:13])
        np.clip(self.x[13:16], -accel, accel, out=self.x[13:16])

    def baro(self, altitude_m: float) -> None:
        """Fuse the barometer if it is the height's reference or the only one left, else learn its bias."""
        if not (math.isfinite(altitude_m) and self._has_baro() and self.attitude_valid):
            return
        self.baro_altitude = altitude_m
        if math.isnan(self._baro_bias):
            self._baro_bias = altitude_m + self.p[2]
        reference = self._parameters.integer("EKF2_HGT_REF")
        if reference != 0 and self.now_ns - self._vision_ns < NS and self._silent_ns(2) < NS:
            self._baro_bias += BARO_BIAS_GAIN * (altitude_m + self.p[2] - self._baro_bias)
            return
        sigma = self._parameters["EKF2_BARO_NOISE"]
        self._single(2, self._baro_bias - altitude_m, sigma * sigma, self._parameters["EKF2_BARO_GATE"])

    def _has_baro(self) -> bool:
        return bool(self._parameters.integer("SYS_HAS_BARO") and self._parameters.integer("EKF2_BARO_CTRL"))

    def gps(self, fix: GpsFix) -> None:
        """Fuse a fix if EKF2_GPS_CTRL allows, the heading is known and no vision holds the frame."""
        control = self._parameters.integer("EKF2_GPS_CTRL")
        vision = self.now_ns - self._vision_ns < NS
        if not self._parameters.integer("SYS_HAS_GPS") or fix.fix_type < 3 or not self.yaw_aligned or vision:
            return
        east, north, up = fix.p_enu_m
        v_east, v_north, v_up = fix.v_enu
        p = self._parameters
        h, s = max(fix.horizontal_sigma_m, p["EKF2_GPS_P_NOISE"]), max(fix.speed_sigma, p["EKF2_GPS_V_NOISE"])
        variance = np.array([h, h, max(fix.vertical_sigma_m, 1.5 * h), s, s, s, 1.0]) ** 2
        gates = np.array([p["EKF2_GPS_P_GATE"]] * 3 + [p["EKF2_GPS_V_GATE"]] * 3 + [1.0])
        self._z[:] = north, east, -up, v_north, v_east, -v_up, np.nan
        for bit, rows in ((HPOS, [0, 1]), (VPOS, [2]), (VELOCITY, [3, 4, 5])):
            if not control & bit:
                self._z[rows] = np.nan
        if control & (HPOS | VELOCITY) == 0 or not self.attitude_valid:
            return
        self._past[:] = self.x[:10]
        for row in range(6):
            if not self.global_position or self._silent_ns(row) > self._parameters["EKF2_NOAID_TOUT"] * 1e3:
                self._reset(row, variance)
        self.global_position = True
        self._fuse(self.now_ns, variance, gates)

    def hold(self, *, at_rest: bool) -> None:
        """At 100 Hz: while nothing aids the horizontal, gravity holds the tilt; at rest, zero speed."""
        if not self.attitude_valid or (self.xy_valid and self._silent_ns(0, 1) < NS):
            return
        ekf.fuse_gravity(self.x, self.P, self._ring, self.force, 10.0 * self._parameters["EKF2_GRAV_NOISE"])
        if at_rest:
            self._past[:] = self.x[:10]
            self._z[:] = np.nan
            self._z[3:6] = 0.0
            ekf.fuse_pose(
                self.x, self.P, self._ring, self._past, self._z, np.full(7, 0.25), np.zeros(7), self._ratios
            )  # fmt: skip
            self._limit_biases()

    def _single(self, row: int, value: float, variance: float, gate: float) -> None:
        self._past[:] = self.x[:10]
        self._z[:] = np.nan
        self._z[row] = value
        if self._silent_ns(row) > self._parameters["EKF2_NOAID_TOUT"] * 1e3:
            self._reset(row, np.full(7, variance))
        self._fuse(self.now_ns, np.full(7, variance), np.full(7, gate))

    @property
    def flags(self) -> int:
        """ESTIMATOR_STATUS_FLAGS as PX4 fills them."""
        flags = 1 if self.attitude_valid else 0
        flags |= (2 | 8 | 16 | 256 | 512) if self.xy_valid else 128
        flags |= (4 | 32) if self.z_valid else 0
        return flags | (64 if math.isfinite(self.range_m) else 0)
