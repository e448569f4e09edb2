"""A bench: the simulated vehicle under the autopilot, and a companion that speaks through pymavlink."""

import math

import numpy as np
import pytest
from pymavlink.dialects.v20 import all as dialect

from sim.autopilot.autopilot import Autopilot
from sim.autopilot.readings import Airframe, AutopilotConfig
from sim.sensors.imu import Imu, ImuConfig
from sim.vehicle import Obstacles, Vehicle, load_params
from sim.vehicle.wind import WindConfig

TICK_NS = 2_500_000
NAN = math.nan
PARAMS = load_params()


def airframe():
    rotors, motor = PARAMS.rotors, PARAMS.motor
    return Airframe(
        mass_kg=PARAMS.airframe.mass_kg,
        inertia_kg_m2=np.diag(np.array(PARAMS.airframe.inertia_kg_m2)),
        rotor_xy_m=np.array(rotors.xyz_m)[:, :2],
        rotor_spin=np.array(rotors.turning),
        max_thrust_n=rotors.thrust_n_s2 * motor.speed_at_full_rad_s**2,
        torque_per_thrust_m=rotors.torque_ratio_m,
        motor_time_s=motor.time_constant_up_s,
    )


def flat_ground():
    return Obstacles(
        cones=np.zeros((0, 9), np.float32),
        kinds=np.zeros(0, np.int8),
        heights=np.zeros((101, 101), np.float32),
        origin_xy=(-250.0, -250.0),
        cell_m=5.0,
    )


class Bench:
    """Lockstep of vehicle, autopilot and companion; positions and velocities in truth are ENU."""

    def __init__(self, *, seed=1, odometry_delay_ms=0, odometry_hz=30, wind=None, **config):
        self.vehicle = Vehicle(
            PARAMS,
            p_world=np.zeros(3),
            yaw=math.pi / 2,  # ENU: north, so yaw 0 in NED
            obstacles=flat_ground(),
            wind=WindConfig() if wind is None else wind,
            seed=seed,
        )
        self.autopilot = Autopilot(AutopilotConfig(**config), airframe=airframe(), seed=seed)
        self.imu = Imu(ImuConfig(rate_hz=400.0), seed=seed, hover_speed_rad_s=PARAMS.hover_speed_rad_s)
        self.rng = np.random.default_rng(seed)
        self.mav = dialect.MAVLink(None, srcSystem=1, srcComponent=191)
        self.reader = dialect.MAVLink(None)
        self.now_ns = 0
        self.tick = 0
        self.motors = np.zeros(4)
        self.messages, self.sent = [], b""
        self.truth, self.estimate = [], []
        self.odometry_on, self.odometry = True, {}
        self.odometry_every = round(400 / odometry_hz)
        self.odometry_delay = odometry_delay_ms * 1_000_000
        self.delayed = []
        self.setpoint = None  # fields of SET_POSITION_TARGET_LOCAL_NED, sent at 50 Hz

    @property
    def own_ns(self):
        return self.now_ns + round(7.25e9)

    def send(self, message):
        self.autopilot.receive(self.now_ns, message.pack(self.mav))

    def command(self, number, *params, **fields):
        """Send a COMMAND_LONG and return the result of its acknowledgement."""
        values = [*params, *[NAN] * (7 - len(params))]
        target = {"target_system": 1, "target_component": 1, **fields}
        self.send(
            dialect.MAVLink_command_long_message(
                target["target_system"], target["target_component"], number, 0, *values
            )
        )
        before = len(self.messages)
        self.run(0.0025)
        acks = [m for m in self.messages[before:] if m.get_type() == "COMMAND_ACK" and m.command == number]
        return acks[0].result if acks else None

    def target(self, *, p=(NAN,) * 3, v=(NAN,) * 3, a=(NAN,) * 3, yaw=NAN, yaw_rate=NAN, frame=1, system=1, mask=None):
        """A SET_POSITION_TARGET_LOCAL_NED whose mask ignores what is NaN."""
        values = [*p, *v, *a, yaw, yaw_rate]
        bits = [*range(9), 10, 11]
        if mask is None:
            mask = sum(1 << bit for bit, value in zip(bits, values, strict=True) if math.isnan(value))
        return dialect.MAVLink_set_position_target_local_ned_message(
            0, system, 1, frame, mask, *[0.0 if math.isnan(x) else x for x in values]
        )

    def send_odometry(self, **changes):
        v = self.vehicle
        w, x, y, z = v.q_world_body
        q = np.array([w + z, x + y, x - y, w - z]) * math.sqrt(0.5)
        R = rotation(v.q_world_body)
        noise = self.rng.normal(0, 1, 7)
        p = v.p_world + 0.01 * noise[:3]
        body = R.T @ v.v_world + 0.02 * noise[3:6]
        fields = dict(
            time_usec=self.now_ns // 1000, frame_id=20, child_frame_id=12, x=p[1], y=p[0], z=-p[2], q=list(q),
            vx=body[0], vy=-body[1], vz=-body[2], rollspeed=0, pitchspeed=0, yawspeed=0,
            pose_covariance=diagonal([1e-4] * 3 + [1e-4] * 3), velocity_covariance=diagonal([4e-4] * 3 + [0] * 3),
            reset_counter=0, estimator_type=3, quality=100,
        )  # fmt: skip
        data = dialect.MAVLink_odometry_message(**{**fields, **self.odometry, **changes}).pack(self.mav)
        self.delayed.append((self.now_ns + self.odometry_delay, data))

    def run(self, seconds):
        for _ in range(round(seconds * 400)):
            self.step()

    def step(self):
        v = self.vehicle
        v.step(self.motors, 2)
        self.now_ns += TICK_NS
        self.tick += 1
        if self.odometry_on and self.tick % self.odometry_every == 0:
            self.send_odometry()
        while self.delayed and self.delayed[0][0] <= self.now_ns:
            self.autopilot.receive(self.now_ns, self.delayed.pop(0)[1])
        if self.setpoint is not None and self.tick % 8 == 0:
            self.send(self.target(**self.setpoint))
        force, rate = v.mean_since(self.now_ns - TICK_NS)
        sample = self.imu.sample(self.now_ns, force, rate, v.rotor_speed)
        baro = float(v.p_world[2]) + self.rng.normal(0, 0.1) if self.tick % 20 == 0 else None
        self.motors = self.autopilot.step(
            self.now_ns,
            imu=(sample.angular_velocity_body, sample.specific_force_body),
            baro_altitude_m=baro,
            gps=None,
            range_m=None,
            battery_voltage=v.battery_voltage,
        )
        data = self.autopilot.transmit(self.now_ns)
        self.sent += data
        if data:
            self.read(data)
        self.truth.append([self.now_ns * 1e-9, *v.p_world, *v.v_world])
        self.estimate.append([*self.autopilot.estimator.p, *self.autopilot.estimator.v])

    def read(self, data):
        for message in self.reader.parse_buffer(data) or []:
            if message.get_type() == "TIMESYNC" and message.tc1 == 0:
                self.send(dialect.MAVLink_timesync_message(self.now_ns + 1, message.ts1))
            self.messages.append(message)

    def texts(self):
        return [m.text for m in self.messages if m.get_type() == "STATUSTEXT"]

    def of(self, name):
        return [m for m in self.messages if m.get_type() == name]

    def wait_ready(self):
        self.run(1.5)
        assert self.autopilot.commander.refusals(self.autopilot.commander.now_ns) == []

    def fly_offboard(self, p=(0.0, 0.0, -5.0)):
        """Armed, in OFFBOARD, hovering at `p` (NED)."""
        self.wait_ready()
        self.setpoint = {"p": p, "yaw": 0.0}
        self.run(0.3)
        assert self.command(176, 1, 6, 0) == 0
        assert self.command(400, 1) == 0
        self.run(7.5)


def rotation(q):
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def diagonal(values):
    triangle = [0.0] * 21
    for place, value in zip((0, 6, 11, 15, 18, 20), values, strict=True):
        triangle[place] = value
    return triangle


@pytest.fixture
def bench():
    return Bench


@pytest.fixture
def quad():
    return airframe()
