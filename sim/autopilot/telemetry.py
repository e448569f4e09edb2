"""What the autopilot says: one function per message, at PX4's onboard default rates.

Values stand in the order of the wire (larger fields first), as `Encoder` takes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from sim.autopilot.codec import BY_NAME, Encoder
from sim.autopilot.commander import Commander
from sim.autopilot.control import Controller
from sim.autopilot.estimator import Estimator
from sim.autopilot.flight import Phase
from sim.autopilot.frames import euler_from_quaternion, geodetic
from sim.autopilot.mission_store import MissionStore
from sim.autopilot.modes import Mode
from sim.autopilot.readings import GpsFix
from sim.autopilot.setpoint import LOCAL_NED

RATES_HZ: Final[dict[str, float]] = {
    "HEARTBEAT": 1, "SYS_STATUS": 5, "SYSTEM_TIME": 1, "GPS_RAW_INT": 8, "SCALED_PRESSURE": 1,
    "ATTITUDE": 100,
    "ATTITUDE_QUATERNION": 50, "LOCAL_POSITION_NED": 30, "GLOBAL_POSITION_INT": 50, "SERVO_OUTPUT_RAW": 10,
    "MISSION_CURRENT": 1, "VFR_HUD": 10, "ATTITUDE_TARGET": 10, "POSITION_TARGET_LOCAL_NED": 10,
    "HIGHRES_IMU": 50, "TIMESYNC": 10, "DISTANCE_SENSOR": 10, "ALTITUDE": 10, "BATTERY_STATUS": 0.5,
    "ESTIMATOR_STATUS": 1, "VIBRATION": 0.5, "HOME_POSITION": 0.5, "EXTENDED_SYS_STATE": 5, "ODOMETRY": 30,
    "CURRENT_MODE": 0.5,
}  # fmt: skip
GYRO, ACCEL, MAG, BARO, GPS, BATTERY, PREARM, VISION = 1, 2, 4, 8, 32, 1 << 25, 1 << 28, 128  # MAV_SYS_STATUS_SENSOR
IMU_FIELDS: Final = 0x3F | 1 << 9 | 1 << 11  # HIGHRES_IMU: accel, gyro, pressure and its altitude
NAN: Final = math.nan


@dataclass(slots=True)
class Readings:
    """The newest raw readings, for telemetry only."""

    battery_v: float = NAN
    gps: GpsFix | None = None


@dataclass(slots=True)
class Clock:
    """Autopilot time, ns since its boot; `us` and `ms` as messages want them."""

    ns: int = 0

    @property
    def us(self) -> int:
        """Microseconds."""
        return self.ns // 1000

    @property
    def ms(self) -> int:
        """Milliseconds, 32 bits."""
        return self.ns // 1_000_000 & 0xFFFFFFFF


class Telemetry:
    """Packs any message of `RATES_HZ` from the state of the parts: `telemetry.pack(msg_id)`."""

    def __init__(
        self, clock: Clock, encoder: Encoder, estimator: Estimator, controller: Controller,
        *, commander: Commander, readings: Readings, missions: MissionStore,
    ) -> None:  # fmt: skip
        self._clock, self._encoder, self._estimator = clock, encoder, estimator
        self._controller, self._commander = controller, commander
        self._readings, self._missions = readings, missions
        self.origin = (0.0, 0.0, 0.0)
        self.origin_known = False
        makers: dict[str, Callable[[], bytes]] = {n: getattr(self, f"_{n.lower()}") for n in RATES_HZ}
        self._makers = {BY_NAME[name].msg_id: make for name, make in makers.items()}
        self._layouts = {name: BY_NAME[name] for name in RATES_HZ}

    @property
    def ids(self) -> dict[int, float]:
        """Message id -> default rate, Hz."""
        return {BY_NAME[name].msg_id: rate for name, rate in RATES_HZ.items()}

    def pack(self, msg_id: int) -> bytes:
        """The frame of one message now; b"" if there is nothing to say yet."""
        return self._makers[msg_id]()

    # --- hot ------------------------------------------------------------------------

    def _attitude(self) -> bytes:
        e = self._estimator
        angles = euler_from_quaternion(e.q.tolist())
        return self._encoder(self._layouts["ATTITUDE"], self._clock.ms, *angles, *e.omega.tolist())

    def _attitude_quaternion(self) -> bytes:
        e = self._estimator
        return self._encoder(
            self._layouts["ATTITUDE_QUATERNION"], self._clock.ms, *e.q.tolist(), *e.omega.tolist(),
            0.0, 0.0, 0.0, 0.0,
        )  # fmt: skip

    def _highres_imu(self) -> bytes:
        e = self._estimator
        altitude = e.baro_altitude if math.isfinite(e.baro_altitude) else 0.0
        return self._encoder(
            self._layouts["HIGHRES_IMU"], self._clock.us, *e.force.tolist(), *e.omega.tolist(), 0.0, 0.0, 0.0,
            _pressure_hpa(altitude), 0.0, altitude, 0.0, IMU_FIELDS, 0,
        )  # fmt: skip

    def _local_position_ned(self) -> bytes:
        e = self._estimator
        if not e.xy_valid:
            return b""
        return self._encoder(
            self._layouts["LOCAL_POSITION_NED"], self._clock.ms, *e.p.tolist(), *e.v.tolist()
        )  # fmt: skip

    def _odometry(self) -> bytes:
        e = self._estimator
        if not e.attitude_valid:
            return b""
        sigma2 = e.P.diagonal().tolist()
        pose, velocity = [0.0] * 21, [0.0] * 21
        for place, k in ((0, 6), (6, 7), (11, 8), (15, 0), (18, 1), (20, 2)):
            pose[place] = sigma2[k]
        for place, k in ((0, 3), (6, 4), (11, 5)):
            velocity[place] = sigma2[k]
        return self._encoder(
            self._layouts["ODOMETRY"], self._clock.us, *e.p.tolist(), *e.q.tolist(), *e.v.tolist(),
            *e.omega.tolist(), *pose, *velocity, LOCAL_NED, LOCAL_NED, e.resets & 0xFF, 8, 0,
        )  # fmt: skip

    def _global_position_int(self) -> bytes:
        e = self._estimator
        if not (self.origin_known and e.xy_valid):
            return b""
        latitude, longitude, altitude = geodetic(self.origin, e.p)
        speed = [max(-32767, min(32767, round(100 * v))) for v in e.v.tolist()]
        heading = round(math.degrees(euler_from_quaternion(e.q.tolist())[2]) % 360 * 100) % 36000
        return self._encoder(
            self._layouts["GLOBAL_POSITION_INT"], self._clock.ms, round(latitude * 1e7),
            round(longitude * 1e7), round(altitude * 1e3), round(1e3 * float(self._commander.home[2] - e.p[2])), *speed,
            heading,
        )  # fmt: skip

    def _timesync(self) -> bytes:
        return self._encoder(self._layouts["TIMESYNC"], 0, self._clock.ns)

    # --- 10 Hz ----------------------------------------------------------------------

    def _attitude_target(self) -> bytes:
        c = self._controller
        return self._encoder(
            self._layouts["ATTITUDE_TARGET"], self._clock.ms, *c.attitude_setpoint, *c.rate_setpoint,
            c.thrust, 0,
        )  # fmt: skip

    def _position_target_local_ned(self) -> bytes:
        sp = self._commander.demand.tolist()
        mask = sum(1 << axis for axis in range(9) if sp[axis] != sp[axis])
        mask |= (1 << 10 if sp[9] != sp[9] else 0) | (1 << 11 if sp[10] != sp[10] else 0)
        return self._encoder(self._layouts["POSITION_TARGET_LOCAL_NED"], self._clock.ms, *sp, mask, LOCAL_NED)

    def _servo_output_raw(self) -> bytes:
        pwm = [round(1000 + 1000 * u) if self._commander.armed else 900 for u in self._controller.motors]
        return self._encoder(
            self._layouts["SERVO_OUTPUT_RAW"], self._clock.us & 0xFFFFFFFF, *pwm, 0, 0, 0, 0, 0, *([0] * 8)
        )  # fmt: skip

    def _vfr_hud(self) -> bytes:
        e = self._estimator
        heading = round(math.degrees(euler_from_quaternion(e.q.tolist())[2]) % 360) % 360
        return self._encoder(
            self._layouts["VFR_HUD"], NAN, math.hypot(e.v[0], e.v[1]), self.origin[2] - e.p[2], -e.v[2],
            heading, round(100 * self._controller.thrust),
        )  # fmt: skip

    def _altitude(self) -> bytes:
        e = self._estimator
        local = -float(e.p[2])
        above_sea = self.origin[2] + local if self.origin_known else NAN
        relative = float(self._commander.home[2]) + local if self._commander.home_set else NAN
        return self._encoder(
            self._layouts["ALTITUDE"], self._clock.us, e.baro_altitude, above_sea, local, relative, NAN,
            e.range_m,
        )  # fmt: skip

    def _distance_sensor(self) -> bytes:
        seen = self._estimator.range_m
        if not math.isfinite(seen):
            return b""
        return self._encoder(
            self._layouts["DISTANCE_SENSOR"], self._clock.ms, 10, 10000, min(round(100 * seen), 65535),
            0, 0, 25, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 100,
        )  # fmt: skip

    # --- state, 5 Hz and slower --------------------------------------------------------

    def heartbeat(self) -> bytes:
        """HEARTBEAT now: PX4 sends one at once when the mode changes."""
        return self._heartbeat()

    def _heartbeat(self) -> bytes:
        c = self._commander
        base = {Mode.OFFBOARD: 0x11, Mode.POSCTL: 0x51}.get(c.mode, 0x1D) | (0x80 if c.armed else 0)
        status = 3 if self._estimator.attitude_valid else 0
        status = (5 if c.failsafe else 4) if c.armed else status
        return self._encoder(self._layouts["HEARTBEAT"], c.mode.custom_mode, 2, 12, base, status, 3)

    def _current_mode(self) -> bytes:
        mode = self._commander.mode.custom_mode
        return self._encoder(self._layouts["CURRENT_MODE"], mode, mode, 0)

    def _extended_sys_state(self) -> bytes:
        c = self._commander
        taking_off = c.flight.phase is Phase.RAMP or c.mode is Mode.TAKEOFF
        landing = c.mode.lands or (c.mode is Mode.MISSION and c.guidance.landing)
        air = 4 if landing else 3 if taking_off else 2
        return self._encoder(self._layouts["EXTENDED_SYS_STATE"], 0, 1 if c.flight.landed else air)

    def _sys_status(self) -> bytes:
        e, c = self._estimator, self._commander
        compass = MAG if e.has_compass else 0
        present = GYRO | ACCEL | BARO | VISION | BATTERY | PREARM | compass | (GPS if self._readings.gps else 0)
        health = GYRO | ACCEL | compass | BATTERY | (BARO if math.isfinite(e.baro_altitude) else 0)
        health |= (VISION if e.xy_valid else 0) | (0 if c.refusals(self._clock.ns) else PREARM)
        health |= GPS if self._readings.gps and self._readings.gps.fix_type >= 3 else 0
        millivolts = _u16(1e3 * self._readings.battery_v)
        return self._encoder(
            self._layouts["SYS_STATUS"], present, present, health, 0, millivolts, -1, 0, 0, 0, 0, 0, 0,
            round(100 * c.battery), 0, 0, 0,
        )  # fmt: skip

    def _battery_status(self) -> bytes:
        cells = [_u16(1e3 * self._readings.battery_v)] + [65535] * 9
        left = self._commander.battery
        state = 1 if left > 0.15 else 2 if left > 0.07 else 3
        return self._encoder(
            self._layouts["BATTERY_STATUS"], 0, -1, 32767, *cells, -1, 0, 1, 1, round(100 * left), 0, state,
            0, 0, 0, 0, 0, 0,
        )  # fmt: skip

    def _estimator_status(self) -> bytes:
        e = self._estimator
        r = e.test_ratios.tolist()
        sigma = np.sqrt(e.P.diagonal()[6:9])
        return self._encoder(
            self._layouts["ESTIMATOR_STATUS"], self._clock.us, max(r[3], r[4]), max(r[0], r[1]), r[2], r[6],
            NAN, NAN, math.hypot(sigma[0], sigma[1]), sigma[2], e.flags,
        )  # fmt: skip

    def _home_position(self) -> bytes:
        c = self._commander
        if not c.home_set:
            return b""
        latitude, longitude, altitude = geodetic(self.origin, c.home)
        return self._encoder(
            self._layouts["HOME_POSITION"], round(latitude * 1e7), round(longitude * 1e7),
            round(altitude * 1e3), *c.home, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, self._clock.us,
        )  # fmt: skip

    def _gps_raw_int(self) -> bytes:
        fix = self._readings.gps
        if fix is None:
            return b""
        east, north, up = fix.p_enu_m
        latitude, longitude, altitude = geodetic(self.origin, np.array([north, east, -up]))
        h, v, s = (round(1e3 * x) for x in (fix.horizontal_sigma_m, fix.vertical_sigma_m, fix.speed_sigma))
        return self._encoder(
            self._layouts["GPS_RAW_INT"], self._clock.us, round(latitude * 1e7), round(longitude * 1e7),
            round(altitude * 1e3), 70, 110, _u16(100 * math.hypot(*fix.v_enu[:2])), 65535, fix.fix_type,
            fix.satellites, round(altitude * 1e3), h, v, s, 0, 0,
        )  # fmt: skip

    def _mission_current(self) -> bytes:
        return self._missions.progress()

    def _scaled_pressure(self) -> bytes:
        altitude = self._estimator.baro_altitude
        if not math.isfinite(altitude):
            return b""
        celsius = round(100 * (15.0 - 0.0065 * altitude))  # of the standard atmosphere
        return self._encoder(self._layouts["SCALED_PRESSURE"], self._clock.ms, _pressure_hpa(altitude), 0.0, celsius, 0)

    def _system_time(self) -> bytes:
        return self._encoder(self._layouts["SYSTEM_TIME"], 0, self._clock.ms)

    def _vibration(self) -> bytes:
        return self._encoder(self._layouts["VIBRATION"], self._clock.us, *self._estimator.vibration, 0, 0, 0)


def _pressure_hpa(altitude_m: float) -> float:
    """International standard atmosphere."""
    return 1013.25 * math.pow(max(1.0 - 2.25577e-5 * altitude_m, 0.1), 5.25588)


def _u16(value: float) -> int:
    return min(max(round(value), 0), 65535) if math.isfinite(value) else 65535
