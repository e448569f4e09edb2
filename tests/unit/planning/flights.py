"""A flight without sensors or autopilot: planning and tracking nodes, a point mass, a map seen by rays."""

import numpy as np

from companion.core import topics
from companion.core.messages import Goal, Limits, Odometry, SafetyStatus, freeze
from companion.planning.config import PlanningConfig
from companion.planning.node import PlanningNode
from companion.tracking.node import TrackingConfig, TrackingNode

HULL_M = 0.35
LIMITS = Limits(
    speed=3.0,
    climb=1.0,
    accel=3.0,
    jerk=20.0,
    yaw_rate=1.5,
    clearance=0.4,
    unknown="stop_before",
    agl_min=1.0,
    agl_max=6.0,
)
STEP_S = 0.01
DELAY_STEPS = 3  # a plan arrives 30 ms late


def goal_at(p, *, goal_id=1, kind="fly", through=False, after=(), agl_m=np.nan, radius_m=0.3, blocked="fail", **limits):
    values = {name: getattr(LIMITS, name) for name in LIMITS.__slots__} | limits
    return Goal(
        stamp_ns=0,
        id=goal_id,
        kind=kind,
        p_odom=np.array(p, float),
        agl_m=agl_m,
        radius_m=radius_m,
        fly_through=through,
        next_p_odom=np.array(after, float).reshape(-1, 3),
        yaw=np.nan,
        if_blocked=blocked,
        limits=Limits(**values),
    )


class PointMass:
    """Position and velocity cascade as PX4's, thrust with a first-order lag, gusts on the acceleration."""

    def __init__(self, p, *, lag_s=0.15, gust=0.0, seed=0):
        self.p, self.v, self.a = np.array(p, float), np.zeros(3), np.zeros(3)
        self.integral, self.gust_a = np.zeros(3), np.zeros(3)
        self.lag_s, self.gust, self.rng = lag_s, gust, np.random.default_rng(seed)

    def step(self, setpoint, dt):
        place = np.where(np.isnan(setpoint.p_odom), self.p, setpoint.p_odom)  # NaN: velocity alone is asked for
        wanted = 0.95 * (place - self.p) + setpoint.v_odom
        off = wanted - self.v
        self.integral = np.clip(self.integral + 0.4 * off * dt, -3.0, 3.0)
        demand = np.clip(1.8 * off + self.integral - 0.2 * self.a + setpoint.a_odom, -6.0, 6.0)
        self.a += (demand - self.a) * dt / self.lag_s
        noise = self.rng.standard_normal(3)
        self.gust_a += -self.gust_a * dt / 1.5 + self.gust * np.sqrt(2 * dt / 1.5) * noise
        self.v = self.v + (self.a + self.gust_a - 0.2 * self.v) * dt
        self.p = self.p + self.v * dt


class Eyes:
    """What rays up to `range_m` have shown of an occupancy grid with its corner at (0, 0, 0)."""

    def __init__(self, occupied, *, resolution_m=0.2, range_m=9.0, known=None):
        self.occupied, self.cell, self.range_m = occupied, resolution_m, range_m
        self.known = np.zeros(occupied.shape, bool) if known is None else known
        azimuth, height = np.meshgrid(np.arange(0, 2 * np.pi, 0.03), np.deg2rad(np.arange(-38, 52, 2.0)))
        self.rays = np.stack(
            [np.cos(height) * np.cos(azimuth), np.cos(height) * np.sin(azimuth), np.sin(height)], axis=-1
        ).reshape(-1, 3)

    def look(self, p):
        live = self.rays[: 0 if self.known.all() else None]
        for reach in np.arange(0.0, self.range_m, 0.5 * self.cell):
            cells = np.floor((p + reach * live) / self.cell).astype(int)
            inside = np.all((cells >= 0) & (cells < self.occupied.shape), axis=1)
            live, cells = live[inside], cells[inside]
            index = tuple(cells.T)
            self.known[index] = True
            live = live[~self.occupied[index]]

    def window(self, p, half_m):
        """(slices, origin) of the part around p, in whole blocks of 8 cells."""
        cells = np.floor(np.asarray(p) / self.cell / 8).astype(int)[:2] * 8
        half = round(half_m / self.cell / 8) * 8
        low, high = np.maximum(cells - half, 0), np.minimum(cells + half, self.occupied.shape[:2])
        return (slice(low[0], high[0]), slice(low[1], high[1]), slice(None)), np.array([*low * self.cell, 0.0])


class Flight:
    """Steps everything; read `vehicle`, `status`, `trace` (N, 3) and `clearance_m` (hull, true)."""

    def __init__(self, local_map, occupied, start, *, gust=0.3, half_m=6.4, seed=1, known=None, config=None):
        self.make_map, self.half_m = local_map, half_m
        self.eyes = Eyes(occupied, known=known)
        self.vehicle = PointMass(start, gust=gust, seed=seed)
        self.planning = PlanningNode(config or PlanningConfig(), hull_radius_m=HULL_M, seed=seed)
        self.tracking = TrackingNode(TrackingConfig())
        self.setpoint, self.status, self.trajectory = None, None, None
        self.states, self.trace, self.speeds, self.late = [], [], [], []
        self.step_count = 0
        self.verdict = ("ok", 1.0)  # of the guards
        self.obstacles = np.argwhere(occupied) * 0.2 + 0.1
        self.clearance_m = np.inf

    @property
    def now_ns(self):
        return round(self.step_count * STEP_S * 1e9)

    def send(self, goal):
        self._later(self.planning.handle(topics.GOAL, goal))

    def run(self, seconds, *, until=None):
        for _ in range(round(seconds / STEP_S)):
            self._step()
            if until is not None and self.status is not None and until(self):
                return True
        return False

    def _step(self):
        n, vehicle = self.step_count, self.vehicle
        odometry = freeze(
            Odometry(
                stamp_ns=self.now_ns,
                p_odom=vehicle.p.copy(),
                q_odom_body=np.array([1.0, 0, 0, 0]),
                v_odom=vehicle.v.copy(),
                omega_body=np.zeros(3),
                pose_variance=np.zeros(6),
                velocity_variance=np.zeros(3),
                measured_ns=self.now_ns,
                quality=1.0,
                reset_counter=0,
            )
        )
        for node in (self.planning, self.tracking):
            list(node.handle(topics.ODOMETRY, odometry))
        if n % 5 == 0:
            action, scale = self.verdict
            word = SafetyStatus(stamp_ns=self.now_ns, action=action, speed_scale=scale, reason="")
            list(self.tracking.handle(topics.SAFETY, word))
        if n % 20 == 0:
            self._later(self.planning.handle(topics.LOCAL_MAP, self._map()))
        if n % 10 == 0:
            self._later(self.planning.tick("watch", self.now_ns))
        while self.late and self.late[0][0] <= n:
            self._deliver(self.late.pop(0)[1])
        if n % 2 == 0:
            for output in self.tracking.tick("control", self.now_ns):
                self.setpoint = output.message
        vehicle.step(self.setpoint, STEP_S)
        self.trace.append(vehicle.p.copy())
        self.speeds.append(float(np.linalg.norm(vehicle.v)))
        if n % 5 == 0 and len(self.obstacles):
            gap = np.maximum(np.abs(self.obstacles - vehicle.p) - 0.1, 0.0)
            self.clearance_m = min(self.clearance_m, float(np.sqrt((gap**2).sum(axis=1).min())) - HULL_M)
        self.step_count += 1

    def _later(self, outputs):
        self.late.extend((self.step_count + DELAY_STEPS, freeze_output(output)) for output in outputs)

    def _deliver(self, output):
        if output.topic is topics.TRAJECTORY:
            self.trajectory = output.message
            list(self.tracking.handle(topics.TRAJECTORY, output.message))
        elif output.topic is topics.PLAN:
            self.status = output.message
            self.states.append((self.now_ns, output.message.goal_id, output.message.state))

    def _map(self):
        self.eyes.look(self.vehicle.p)
        part, origin = self.eyes.window(self.vehicle.p, self.half_m)
        return self.make_map(
            self.eyes.occupied[part], known=self.eyes.known[part], origin=origin, ground_z=0.1, stamp_ns=self.now_ns
        )


def freeze_output(output):
    freeze(output.message)
    return output
