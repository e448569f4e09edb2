"""The flying aircraft: state, battery, wind, contact and history, advanced by one kernel call."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from companion.core.errors import InputError
from companion.core.geometry import quaternion_from_yaw, rotation_from_quaternion
from companion.core.messages import Array
from sim.vehicle.contact import (
    CONTACTS,
    REACH_M,
    Near,
    NearWalls,
    Obstacles,
    _cone_clearance,
    _ground_clearance,
    _walker_clearance,
    _wall_clearance,
)
from sim.vehicle.dynamics import STATE_SIZE, STEP_NS, STEP_S, _power, _rk4, _rotation, _volts
from sim.vehicle.gear import _settle_anchors
from sim.vehicle.history import _record, mean_since, new_ring, poses_at
from sim.vehicle.params import VehicleParams, hull_spheres, pack
from sim.vehicle.wind import WindConfig, _blow, pack_wind
from sim.world.terrain import _height, heights_at

_STREAM = 2  # of the random numbers
# Places in `scalars`, what the kernel keeps between calls besides the state.
_CHARGE_C, _VOLTS, _AMPERES, _CLEARANCE, _GROUND, _CONTACT, _STANDING, _STEPS = range(8)


class Vehicle:
    """One aircraft at time 0, motors at rest, battery full.

    `p_world` is the body's origin, the centre of mass; below its standing height it is lifted
    onto its legs. A contact ends the flight: from then on the aircraft keeps its place, and time runs on.
    """

    def __init__(
        self,
        params: VehicleParams,
        *,
        p_world: Array,
        yaw: float,
        obstacles: Obstacles,
        wind: WindConfig,
        seed: int,
    ) -> None:
        self.params = params
        self._model = pack(params)
        self._spheres = hull_spheres(params)
        self._rng = np.random.default_rng([seed, _STREAM])
        self._wind = pack_wind(wind)
        self._gust = self._rng.standard_normal(3)
        self._near = Near(obstacles)
        self._walls = NearWalls(obstacles.walls).arguments
        self._walkers = obstacles.walkers.tables()
        self._heights: Array = np.ascontiguousarray(obstacles.heights, dtype=np.float64)
        self._field = np.array([obstacles.origin_xy[0], obstacles.origin_xy[1], obstacles.cell_m])
        self._x = np.zeros(STATE_SIZE)
        self._x[6:10] = quaternion_from_yaw(yaw)
        self._x[:3] = p_world
        self._x[2] = max(float(p_world[2]), self._standing_z(obstacles))
        self._anchors = np.full((4, 2), np.nan)
        self._scalars = np.zeros(8)
        self._scalars[[_CHARGE_C, _CLEARANCE, _GROUND]] = self._model["capacity_c"][0], REACH_M, np.inf
        self._scalars[_VOLTS] = self._model["volts"][0, -1]
        self._ring = new_ring(self._x)
        self._work = np.zeros((6, STATE_SIZE))

    def step(self, motor_command: Array, n_steps: int) -> None:
        """Advance n physics steps of 1.25 ms under motor commands (4,), each clipped to [0, 1]."""
        command = np.asarray(motor_command, dtype=np.float64)
        if command.shape != (4,) or not math.isfinite(command.sum()):
            raise InputError(f"{motor_command!r}", field="motor_command", valid="four finite numbers")
        near = self._near
        _advance(
            self._x, self._model, command, self._rng.standard_normal((n_steps, 3)), self._wind, self._gust,
            self._heights, self._field, self._spheres, near.cones, near.kinds, near.frame, near.grid.start,
            near.grid.items, near.list, near.seen, self._walkers, self._walls, self._anchors, self._scalars, self._ring,
            self._work,
        )  # fmt: skip

    def weaken_rotor(self, rotor: int, loss: float) -> None:
        """Fault: a chipped propeller loses this share of its thrust, 0 to 1; 0 mends it."""
        if not (0 <= rotor < 4 and 0.0 <= loss <= 1.0):
            raise InputError(f"{rotor}, {loss}", field="rotor, loss", valid="0..3, 0..1")
        self._model["health"][0, rotor] = 1.0 - loss

    def drop_cells(self, count: int) -> None:
        """Fault: so many of the battery's cells give no voltage any more."""
        b = self.params.battery
        if not 0 <= count < b.cells:
            raise InputError(str(count), field="cells", valid=f"0..{b.cells - 1}")
        self._model["volts"][0] = (b.cells - count) * np.array(b.cell_v)

    def set_wind(self, wind: WindConfig) -> None:
        """Change the weather; gusts go on from where they are."""
        self._wind = pack_wind(wind)

    @property
    def time_ns(self) -> int:
        """Simulated time since the start."""
        return self._steps * STEP_NS

    @property
    def p_world(self) -> Array:
        """Position of the body's origin, m, (3,)."""
        return self._x[:3].copy()

    @property
    def v_world(self) -> Array:
        """Velocity, m/s, (3,)."""
        return self._x[3:6].copy()

    @property
    def q_world_body(self) -> Array:
        """Attitude, wxyz, (4,)."""
        return self._x[6:10].copy()

    @property
    def omega_body(self) -> Array:
        """Angular rate, rad/s, (3,)."""
        return self._x[10:13].copy()

    @property
    def rotor_speed(self) -> Array:
        """Rotor speeds, rad/s, (4,)."""
        return self._x[13:].copy()

    @property
    def battery_fraction(self) -> float:
        """Charge left, 0 to 1."""
        return float(self._scalars[_CHARGE_C] / self._model["capacity_c"][0])

    @property
    def battery_voltage(self) -> float:
        """Volts at the terminals under the present load."""
        return float(self._scalars[_VOLTS])

    @property
    def battery_current(self) -> float:
        """Amperes drawn."""
        return float(self._scalars[_AMPERES])

    @property
    def contact(self) -> str:
        """What the hull hit ("trunk", "branch", "ground", "walker", "wall"), or ""."""
        return CONTACTS[int(self._scalars[_CONTACT])]

    @property
    def on_ground(self) -> bool:
        """At least one leg stands on the ground."""
        return bool(self._scalars[_STANDING] > 0)

    @property
    def ground_clearance(self) -> float:
        """Hull (without legs) above ground at the last step, m."""
        return float(self._scalars[_GROUND])

    def take_min_clearance(self) -> float:
        """Smallest clearance of hull to trunks, branches, walkers and walls since the last call, m, at most REACH_M."""
        smallest = float(self._scalars[_CLEARANCE])
        self._scalars[_CLEARANCE] = REACH_M
        return smallest

    def poses_at(self, stamps_ns: NDArray[np.int64]) -> tuple[Array, Array]:
        """True p_world (N, 3) and q_world_body (N, 4) at stamps of the last 1.27 s."""
        return poses_at(self._ring, self._steps, stamps_ns)

    def mean_since(self, since_ns: int) -> tuple[Array, Array]:
        """Mean specific force (3,) and mean angular rate (3,) at the body's origin from then to now."""
        return mean_since(self._ring, self._steps, since_ns)

    @property
    def _steps(self) -> int:
        return int(self._scalars[_STEPS])

    def _standing_z(self, obstacles: Obstacles) -> float:
        legs = self._model["leg"][0] @ rotation_from_quaternion(self._x[6:10]).T
        under = heights_at(self._heights, self._field[:2], obstacles.cell_m, self._x[:2] + legs[:, :2])
        return float(under.max()) + self.params.standing_height_m


@njit(cache=True, nogil=True)
def _advance(  # type: ignore[no-untyped-def]
    x, model, command, normals, wind, gust, heights, field, spheres,
    cones, kinds, frame, start, items, near, seen, walkers, walls, anchors, scalars, ring, work,
):  # fmt: skip
    """One physics step per row of `normals`."""
    m = model[0]
    demand, air, ground_z = np.empty(4), np.empty(3), np.empty(5)
    before = work[5]
    for n in range(normals.shape[0]):
        scalars[_STEPS] += 1
        stopped = scalars[_CONTACT] > 0
        for i in range(x.shape[0]):
            if stopped and (3 <= i < 6 or i >= 10):
                x[i] = 0.0
            before[i] = x[i]
        if stopped:
            _record(ring, int(scalars[_STEPS]), before, x, STEP_S)
            continue
        _drain(model, x, scalars)
        for i in range(4):
            demand[i] = min(max(command[i], 0.0), 1.0) * m.full_speed * scalars[_VOLTS] / m.full_volts
        _ground_under(m, x, heights, field, ground_z)
        _blow(wind, gust, normals[n], x[2] - ground_z[0], x[3:6], STEP_S, air)
        _rk4(model, x, demand, air, ground_z, anchors, STEP_S, work)
        scalars[_STANDING] = 0
        if x[2] - ground_z[0] < 1.0:
            scalars[_STANDING] = _settle_anchors(m, x, _rotation(x), ground_z, anchors)
        _record(ring, int(scalars[_STEPS]), before, x, STEP_S)
        scalars[_CLEARANCE], kind = _cone_clearance(
            x, spheres, cones, kinds, frame, start, items, near, seen, scalars[_CLEARANCE]
        )
        if kind == 0 and walkers[1].shape[0] > 0:
            time_s = scalars[_STEPS] * STEP_S
            scalars[_CLEARANCE], touched = _walker_clearance(x, spheres, walkers, time_s, scalars[_CLEARANCE])
            kind = 4 if touched else 0
        if kind == 0 and walls[0][0].shape[0] > 0:
            scalars[_CLEARANCE], touched = _wall_clearance(x, spheres, walls, scalars[_CLEARANCE])
            kind = 5 if touched else 0
        scalars[_GROUND] = _ground_clearance(x, spheres, heights, field[:2], field[2])
        crashed = scalars[_GROUND] <= 0.0 or (scalars[_STANDING] > 0 and _too_hard(m, x))
        scalars[_CONTACT] = kind if kind > 0 else 3 if crashed else 0


@njit(cache=True, nogil=True)
def _drain(model, x, scalars):  # type: ignore[no-untyped-def]
    """Battery: draw the present power for one step."""
    m = model[0]
    watts = _power(model, x)
    scalars[_VOLTS] = _volts(model, scalars[_CHARGE_C] / m.capacity_c, watts)
    scalars[_AMPERES] = watts / scalars[_VOLTS]
    scalars[_CHARGE_C] = max(scalars[_CHARGE_C] - scalars[_AMPERES] * STEP_S, 0.0)


@njit(cache=True, nogil=True)
def _ground_under(m, x, heights, field, ground_z):  # type: ignore[no-untyped-def]
    """Ground under the body's origin and, near it, under each leg."""
    ground_z[0] = _height(heights, field[:2], field[2], x[0], x[1])
    ground_z[1:] = ground_z[0]  # a step may begin above 1 m and end below it
    if x[2] - ground_z[0] >= 1.0:
        return
    R = _rotation(x)
    for i in range(4):
        leg = m.leg[i]
        px = x[0] + R[0, 0] * leg[0] + R[0, 1] * leg[1] + R[0, 2] * leg[2]
        py = x[1] + R[1, 0] * leg[0] + R[1, 1] * leg[1] + R[1, 2] * leg[2]
        ground_z[1 + i] = _height(heights, field[:2], field[2], px, py)


@njit(cache=True, nogil=True)
def _too_hard(m, x):  # type: ignore[no-untyped-def]
    """Too fast or too tilted to be a landing."""
    speed2 = x[3] * x[3] + x[4] * x[4] + x[5] * x[5]
    upright = 1.0 - 2.0 * (x[7] * x[7] + x[8] * x[8])
    return speed2 > m.touch_speed * m.touch_speed or upright < m.touch_cosine
