"""The simulated aircraft as a node: samples and MAVLink bytes out, MAVLink bytes in.

At every tick of 2.5 ms the physics advances over the interval that has just passed, under the
motor commands that the autopilot gave at its beginning; then the sensors are read, and the
autopilot decides the next commands.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Final

import msgspec
import numpy as np

from companion.core import topics
from companion.core.messages import Array, GroundTruth, LidarScan, MavlinkBytes, RangeReading
from companion.core.node import Node, Outputs, Pending, every, on
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.readings import Airframe, AutopilotConfig
from sim.autopilot.readings import GpsFix as ReceiverFix
from sim.config import SimConfig
from sim.sensors.baro import Baro
from sim.sensors.gps import Gps, GpsConfig, GpsFix
from sim.sensors.imu import Imu
from sim.sensors.lidar import knot_stamps
from sim.sensors.range_finder import RangeFinder
from sim.sensors.render import JoinedSweep, Renderer
from sim.vehicle import Obstacles, Vehicle, VehicleParams, load_params
from sim.world import World

TICK_NS = 2_500_000  # 400 Hz
PHYSICS_STEPS = 2
PIECES = 5  # of a sweep, so that a render worker keeps pace with it
OPEN_SKY: Final = {"EKF2_GPS_CTRL": 7.0, "SYS_HAS_GPS": 1.0}  # parameters
IMU_TICKS, TRUTH_TICKS, SLOW_TICKS, GPS_TICKS = 2, 8, 20, 80  # 200, 50, 20 and 5 Hz


class SimNode(Node):
    """World, vehicle, sensors and autopilot in one state machine."""

    publishes = (
        topics.IMU, topics.LIDAR, topics.CAMERA, topics.RANGE, topics.BARO, topics.MAVLINK_RX, topics.TRUTH,
    )  # fmt: skip

    def __init__(
        self, config: SimConfig, world: World, renderer: Renderer, *, seed: int, signing_key: bytes | None = None
    ) -> None:
        """`signing_key`: the autopilot's MAVLink key, 32 bytes; None: it neither signs nor checks."""
        self.config, self.world = config, world
        params = load_params()
        self.vehicle = Vehicle(
            params,
            p_world=np.zeros(3),
            yaw=math.radians(config.start_yaw_deg),
            obstacles=_obstacles(world),
            wind=config.wind,
            seed=seed,
        )
        self.autopilot = Autopilot(_autopilot(config), airframe=_airframe(params), seed=seed, signing_key=signing_key)
        self._renderer = renderer
        hover = params.hover_speed_rad_s
        self._imu = Imu(config.imu, seed=seed, hover_speed_rad_s=hover)
        self._autopilot_imu = Imu(config.autopilot_imu, seed=seed, hover_speed_rad_s=hover, stream=1)
        self._baro = Baro(config.baro, seed=seed)
        self._autopilot_baro = Baro(config.baro, seed=seed, stream=1)
        self._gps = Gps(_receiver(config), seed=seed)
        self._range = RangeFinder(config.range_finder, config.rig.range_finder, seed=seed)
        self._ranged = RangeReading(stamp_ns=0, range_m=math.nan)
        self._command: Array = np.zeros(4)
        self._tick = self._sweeps = self._frames = 0
        self._pieces: tuple[Pending[LidarScan], ...] = ()
        self.left_out = {"lidar": 0, "camera": 0}  # sweeps and frames for which the renderer was too busy

    @property
    def imu_bias_body(self) -> Array:
        """Present true biases of the companion's IMU, (6,): gyro rad/s, accelerometer m/s2."""
        return np.concatenate([self._imu.gyro_bias_body, self._imu.accel_bias_body])

    @on(topics.MAVLINK_TX)
    def receive(self, msg: MavlinkBytes) -> None:
        """Bytes from the stack reach the autopilot."""
        self.autopilot.receive(self.vehicle.time_ns, msg.data)

    @every(hz=400)
    def step(self, now_ns: int) -> Outputs:
        """Advance to now, read what is due, let the autopilot decide."""
        if now_ns > 0:
            self.vehicle.step(self._command, PHYSICS_STEPS)
            self._tick += 1
            yield from self._sample(now_ns)
            yield from self._fly(now_ns)
        if self._tick % TRUTH_TICKS == 0:
            yield topics.TRUTH(self._truth(now_ns))

    def _sample(self, now_ns: int) -> Outputs:
        late, v = self.config.latency, self.vehicle
        if self._tick % IMU_TICKS == 0:
            force, rate = v.mean_since(now_ns - IMU_TICKS * TICK_NS)
            sample = self._imu.sample(now_ns, force, rate, v.rotor_speed)
            yield topics.IMU(sample, delay_ns=_ns(late.imu_ms))
        if self._tick % SLOW_TICKS == 0:
            yield topics.BARO(self._baro.sample(now_ns, float(v.p_world[2])), delay_ns=_ns(late.baro_ms))
            to_surface = partial(self.world.range_to_surface, stamp_ns=now_ns)
            self._ranged = self._range.sample(now_ns, v.p_world, v.q_world_body, to_surface)
            yield topics.RANGE(self._ranged, delay_ns=_ns(late.range_ms))
        yield from self._sweep(now_ns, _ns(late.lidar_ms))
        stamp_ns = round((self._frames + 1) * 1e9 / self.config.camera.rate_hz)
        if now_ns >= stamp_ns:
            yield from self._frame(stamp_ns, _ns(late.camera_ms) + stamp_ns - now_ns)

    def _sweep(self, now_ns: int, delay_ns: int) -> Outputs:
        """Submit the piece of the sweep that has just ended; publish the sweep after its last."""
        sweep_ns = round(1e9 / self.config.lidar.rate_hz)
        stamp_ns, part = (self._sweeps + 1) * sweep_ns, len(self._pieces)
        if now_ns < stamp_ns - sweep_ns + (part + 1) * sweep_ns // PIECES:
            return
        if part == 0 and self._renderer.busy:
            self._sweeps += 1
            self.left_out["lidar"] += 1
            return
        knots = knot_stamps(self.config.lidar, stamp_ns, 21, part=part, parts=PIECES)
        p, q = self.vehicle.poses_at(knots)
        piece = self._renderer.submit_lidar(p, q, stamp_ns=stamp_ns, counter=self._sweeps, part=part, parts=PIECES)
        self._pieces += (piece,)
        if len(self._pieces) == PIECES:
            yield topics.LIDAR(JoinedSweep(self._pieces), delay_ns=delay_ns + stamp_ns - now_ns)
            self._sweeps, self._pieces = self._sweeps + 1, ()

    def _frame(self, stamp_ns: int, delay_ns: int) -> Outputs:
        self._frames += 1
        if self._renderer.busy:
            self.left_out["camera"] += 1
            return
        p, q = self.vehicle.poses_at(np.array([stamp_ns]))
        frame = self._renderer.submit_camera(p[0], q[0], stamp_ns=stamp_ns, counter=self._frames - 1)
        yield topics.CAMERA(frame, delay_ns=delay_ns)

    def _fly(self, now_ns: int) -> Outputs:
        v = self.vehicle
        force, rate = v.mean_since(now_ns - TICK_NS)
        own = self._autopilot_imu.sample(now_ns, force, rate, v.rotor_speed)
        slow, gps_due = self._tick % SLOW_TICKS == 0, self._tick % GPS_TICKS == 0
        self._command = self.autopilot.step(
            now_ns,
            imu=(own.angular_velocity_body, own.specific_force_body),
            baro_altitude_m=self._autopilot_baro.sample(now_ns, float(v.p_world[2])).altitude_m if slow else None,
            gps=_fix(self._gps.sample(now_ns, v.p_world, v.v_world)) if gps_due else None,
            range_m=self._ranged.range_m if slow else None,
            battery_voltage=v.battery_voltage,
        )
        if data := self.autopilot.transmit(now_ns):
            link_ns = _ns(self.config.latency.link_ms)
            yield topics.MAVLINK_RX(MavlinkBytes(stamp_ns=now_ns + link_ns, data=data), delay_ns=link_ns)

    def _truth(self, now_ns: int) -> GroundTruth:
        v = self.vehicle
        return GroundTruth(
            stamp_ns=now_ns,
            p_world=v.p_world,
            q_world_body=v.q_world_body,
            v_world=v.v_world,
            clearance_m=v.take_min_clearance(),
            contact=v.contact,
            armed=self.autopilot.armed,
            battery_fraction=v.battery_fraction,
        )


def _ns(milliseconds: float) -> int:
    return round(milliseconds * 1e6)


def _autopilot(config: SimConfig) -> AutopilotConfig:
    """What its owner set; under an open sky the compass gave it the heading, and it fuses GPS."""
    own = config.autopilot
    if not config.open_sky:
        return own
    heading = 90.0 - config.start_yaw_deg if own.boot_heading_deg is None else own.boot_heading_deg
    return msgspec.structs.replace(own, boot_heading_deg=heading, parameters={**OPEN_SKY, **own.parameters})


def _receiver(config: SimConfig) -> GpsConfig:
    return msgspec.structs.replace(config.gps, denied=config.gps.denied and not config.open_sky)


def _obstacles(world: World) -> Obstacles:
    return Obstacles(
        cones=world.cones,
        kinds=world.kinds,
        heights=world.heights,
        origin_xy=world.origin_xy,
        cell_m=world.cell_m,
        walkers=world.walkers,
        walls=world.walls,
    )


def _airframe(params: VehicleParams) -> Airframe:
    """What one tells an autopilot of its aircraft: from the data sheet, not from the state."""
    rotors, motor = params.rotors, params.motor
    return Airframe(
        mass_kg=params.airframe.mass_kg,
        inertia_kg_m2=np.diag(np.array(params.airframe.inertia_kg_m2)),
        rotor_xy_m=np.array(rotors.xyz_m)[:, :2],
        rotor_spin=np.array(rotors.turning),
        max_thrust_n=rotors.thrust_n_s2 * motor.speed_at_full_rad_s**2,
        torque_per_thrust_m=rotors.torque_ratio_m,
        motor_time_s=motor.time_constant_up_s,
    )


def _fix(fix: GpsFix | None) -> ReceiverFix | None:
    """What the receiver hands to its autopilot."""
    if fix is None:
        return None
    return ReceiverFix(
        p_enu_m=tuple(fix.p_world),
        v_enu=tuple(fix.v_world),
        horizontal_sigma_m=fix.sigma_horizontal_m,
        vertical_sigma_m=fix.sigma_vertical_m,
    )
