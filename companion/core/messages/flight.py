"""What leads the flight: mission, plans, setpoints, guards; what the autopilot says; and the truth."""

from __future__ import annotations

from typing import Literal

from companion.core.messages.kind import Array, message


@message
class Limits:
    """What a step allows; the unit is in the comment since messages carry no options."""

    speed: float  # m/s
    climb: float  # m/s
    accel: float  # m/s2
    jerk: float  # m/s3
    yaw_rate: float  # rad/s
    clearance: float  # hull to obstacle, m
    unknown: Literal["blocked", "stop_before", "optimistic"]
    agl_min: float  # m
    agl_max: float  # m


@message
class Goal:
    """Where to fly next. A new id replaces the old; `hold` stops in known-free space, `land` over a free column."""

    stamp_ns: int
    id: int
    kind: Literal["takeoff", "fly", "hold", "land"]
    p_odom: Array  # (3,)
    agl_m: float  # height above ground asked for; NaN: p_odom[2] holds
    radius_m: float  # reached within
    fly_through: bool  # do not stop there
    next_p_odom: Array  # (K, 3), goals that follow, for looking ahead
    yaw: float  # rad in odom; NaN: along the path
    if_blocked: Literal["nearest_free", "fail"]
    limits: Limits


@message
class VehicleCommand:
    """What the mission asks of the autopilot."""

    stamp_ns: int
    kind: Literal["arm", "disarm", "offboard", "hold", "land", "return"]


@message
class MissionStatus:
    stamp_ns: int
    step_id: str
    step_index: int
    step_count: int
    state: Literal["waiting", "running", "failing", "done", "failed"]
    reason: str


@message
class Why:
    """One decision: what was done, because of which input."""

    stamp_ns: int
    node: str
    what: str
    because: str


@message
class Trajectory:
    """A path to track; the last point has speed 0 and lies in known-free space."""

    stamp_ns: int
    goal_id: int
    p_odom: Array  # (N, 3), spaced evenly
    speed: Array  # m/s, (N,)
    accel_limit: float  # m/s2
    yaw: float  # rad; NaN: along the path
    yaw_rate_limit: float  # rad/s


PROVEN = "no way"  # begins PlanStatus.reason when the planner has proven it on the present map


@message
class PlanStatus:
    stamp_ns: int
    goal_id: int
    state: Literal["idle", "flying", "reached", "blocked"]
    distance_m: float  # along the plan, to the goal
    plan_p_odom: Array  # the geometric plan, (N, 3)
    cost_m: float
    iterations: int
    reason: str = ""  # why it is blocked; PROVEN begins the words of a proof that there is no way
    checked: int = 0  # ways that were traversed voxel by voxel before they were published
    refused: int = 0  # of them, those that met something seen: braked on before it


@message
class Setpoint:
    """Demand for the autopilot; NaN components are not controlled."""

    stamp_ns: int
    p_odom: Array  # (3,)
    v_odom: Array  # (3,)
    a_odom: Array  # (3,)
    yaw: float  # rad
    yaw_rate: float  # rad/s


@message
class SafetyStatus:
    """The guards' verdict; `speed_scale` bounds the tracker, `hold` brakes on the path."""

    stamp_ns: int
    action: Literal["ok", "slow", "hold", "land"]
    speed_scale: float
    reason: str


@message
class NodeHealth:
    """Whether a node of a live stack runs; said by who started it, when that changes."""

    stamp_ns: int
    node: str
    alive: bool
    reason: str  # why it is down


@message
class MavlinkBytes:
    """Raw bytes as read from or written to the link."""

    stamp_ns: int
    data: bytes


@message
class VehicleStatus:
    """What the autopilot says of itself, in our frames."""

    stamp_ns: int
    connected: bool
    armed: bool
    mode: str  # OFFBOARD, HOLD, TAKEOFF, LAND, RETURN, MANUAL, ...
    landed: bool
    ready: bool  # would accept to arm
    battery_fraction: float
    p_odom: Array  # the autopilot's own estimate, (3,)
    v_odom: Array  # (3,)
    text: str  # newest STATUSTEXT


@message
class CommandResult:
    stamp_ns: int
    kind: str  # of VehicleCommand
    accepted: bool
    reason: str


@message
class GroundTruth:
    """The simulator's own state; no stage subscribes to it."""

    stamp_ns: int
    p_world: Array  # (3,)
    q_world_body: Array  # (4,)
    v_world: Array  # (3,)
    clearance_m: float  # smallest hull clearance since the last message
    contact: str  # "" or what was touched
    armed: bool
    battery_fraction: float
