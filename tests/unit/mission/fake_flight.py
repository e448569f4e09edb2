"""A vehicle, a planner and a tracker of a few lines each, to fly a MissionNode without a simulator."""

from dataclasses import dataclass, field

import numpy as np

from companion.core import messages as m
from companion.core import topics
from companion.core.geometry import quaternion_from_yaw
from companion.mission.config import MissionConfig
from companion.mission.model import parse_mission
from companion.mission.node import MissionNode

TICK_NS = 100_000_000
SPEED_M_S = 2.0


@dataclass
class FakeFlight:
    text: str
    config: MissionConfig = field(default_factory=MissionConfig)
    refuse: tuple[str, ...] = ()  # commands that the autopilot refuses
    blocked: frozenset[int] = frozenset()  # goal ids without a way
    reason: str = ""  # the planner's, of those
    frozen: frozenset[int] = frozenset()  # goal ids at which nothing moves
    ready_ns: int = 0
    p_map_odom: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw_map_odom: float = 0.0

    def __post_init__(self):
        self.node = MissionNode(parse_mission(self.text, file="t.yaml"), self.config)
        self.now_ns = 0
        self.p, self.yaw = np.zeros(3), 0.0
        self.mode, self.armed, self.landed = "HOLD", False, True
        self.battery, self.safety = 1.0, "ok"
        self.goal, self.reached = None, False
        self.said = []  # (now_s, topic name, message)

    def of(self, topic):
        return [message for _, name, message in self.said if name == topic.name]

    @property
    def commands(self):
        return [c.kind for c in self.of(topics.VEHICLE_COMMAND)]

    @property
    def status(self):
        return self.of(topics.MISSION)[-1]

    @property
    def goals(self):
        return self.of(topics.GOAL)

    @property
    def whys(self):
        return [f"{w.what} <- {w.because}" for w in self.of(topics.WHY)]

    def until_over(self, limit_s=600.0):
        while self.now_ns < limit_s * 1e9 and not self.over:
            self.tick()
        return self.status

    @property
    def over(self):
        return bool(self.of(topics.MISSION)) and self.status.state in ("done", "failed")

    def run(self, seconds):
        end_ns = self.now_ns + round(seconds * 1e9)
        while self.now_ns < end_ns:
            self.tick()

    def tick(self):
        self._feed()
        outputs = list(self.node.tick("decide", self.now_ns))
        for out in outputs:
            self.said.append((self.now_ns * 1e-9, out.topic.name, out.message))
            if out.topic is topics.GOAL:
                self.goal, self.reached = out.message, False
        for out in outputs:
            if out.topic is topics.VEHICLE_COMMAND:
                self._command(out.message)
        self._move()
        self.now_ns += TICK_NS

    def _feed(self):
        now, zero = self.now_ns, np.zeros(3)
        q = quaternion_from_yaw(self.yaw)
        v = zero if self.goal is None or self.reached else np.array([SPEED_M_S, 0, 0])
        self._handle(
            topics.ODOMETRY,
            m.Odometry(
                stamp_ns=now, p_odom=self.p.copy(), q_odom_body=q, v_odom=v, omega_body=zero,
                pose_variance=np.full(6, 1e-4), velocity_variance=np.full(3, 1e-4), measured_ns=now,
                quality=0.9, reset_counter=0,
            ),
        )  # fmt: skip
        self._handle(
            topics.SMOOTHED,
            m.SmoothedState(
                stamp_ns=now, p_map=zero, q_map_body=q, v_map=zero, gyro_bias_body=zero, accel_bias_body=zero,
                p_map_odom=np.array(self.p_map_odom), q_map_odom=quaternion_from_yaw(self.yaw_map_odom),
                pose_variance=np.full(6, 1e-4), factors=1,
            ),
        )  # fmt: skip
        self._handle(
            topics.VEHICLE,
            m.VehicleStatus(
                stamp_ns=now, connected=True, armed=self.armed, mode=self.mode, landed=self.landed,
                ready=now >= self.ready_ns, battery_fraction=self.battery, p_odom=self.p, v_odom=zero,
                text="",
            ),
        )  # fmt: skip
        scale = {"ok": 1.0, "slow": 0.5}.get(self.safety, 0.0)
        self._handle(topics.SAFETY, m.SafetyStatus(stamp_ns=now, action=self.safety, speed_scale=scale, reason="test"))
        if self.goal is not None:
            state = "blocked" if self.goal.id in self.blocked else "reached" if self.reached else "flying"
            self._handle(
                topics.PLAN,
                m.PlanStatus(
                    stamp_ns=now, goal_id=self.goal.id, state=state, distance_m=0.0,
                    plan_p_odom=np.zeros((0, 3)), cost_m=0.0, iterations=0,
                    reason=self.reason if state == "blocked" else "",
                ),
            )  # fmt: skip

    def _handle(self, topic, message):
        assert list(self.node.handle(topic, message)) == []

    def _command(self, command):
        accepted = command.kind not in self.refuse
        if accepted:
            self.armed = {"arm": True, "disarm": False}.get(command.kind, self.armed)
            self.mode = {"offboard": "OFFBOARD", "land": "LAND"}.get(command.kind, self.mode)
        result = m.CommandResult(
            stamp_ns=self.now_ns, kind=command.kind, accepted=accepted, reason="" if accepted else "denied"
        )
        self._handle(topics.COMMAND_RESULT, result)

    def _move(self):
        step = SPEED_M_S * TICK_NS * 1e-9
        if self.armed and self.mode == "LAND":
            self.p = self.p - [0, 0, min(step, self.p[2])]
            self.landed = self.p[2] < 0.01
            self.armed = not self.landed
        elif self.armed and self.mode == "OFFBOARD" and self.goal is not None and self.safety in ("ok", "slow"):
            self.reached = self.reached or self.goal.kind == "hold"
            if self.reached or self.goal.id in self.frozen | self.blocked:
                return
            way = self.goal.p_odom - self.p
            far = float(np.linalg.norm(way))
            self.p = self.p + way * min(1.0, step / max(far, 1e-9))
            self.landed = self.landed and self.p[2] < 0.1
            self.reached = far <= max(step, self.goal.radius_m)
