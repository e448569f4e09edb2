"""The whole aircraft: stands, flies, lands, hits; history and determinism."""

import math
from itertools import pairwise

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.core.geometry import (
    exp_so3,
    quaternion_from_rotation,
    quaternion_from_yaw,
    rotation_from_quaternion,
)
from sim.vehicle import Obstacles, Vehicle, WindConfig, flat_ground, load_params
from sim.vehicle.dynamics import STEP_NS
from sim.vehicle.history import _record, new_ring, poses_at
from sim.vehicle.params import GRAVITY_M_S2
from sim.vehicle.wind import _blow, pack_wind, wind_profile

PARAMS = load_params()
IDLE = np.zeros(4)


def vehicle(
    z: float = 0.0,
    obstacles: Obstacles | None = None,
    wind: WindConfig | None = None,
    seed: int = 1,
    x: float = 0.0,
) -> Vehicle:
    return Vehicle(
        PARAMS,
        p_world=np.array([x, 0.0, z]),
        yaw=0.3,
        obstacles=obstacles or flat_ground(),
        wind=wind or WindConfig(),
        seed=seed,
    )


def hover_command(v: Vehicle) -> np.ndarray:
    """Against the sag of the battery; the attitude needs no help in still air."""
    return np.full(4, PARAMS.hover_command * 16.8 / v.battery_voltage)


def fly(v: Vehicle, seconds: float, climb_m_s: float = 0.0) -> None:
    """Hold a climb speed; open loop in attitude, so only in calm air."""
    for _ in range(round(seconds * 400)):
        push = 0.15 * (climb_m_s - v.v_world[2])
        v.step(hover_command(v) * math.sqrt(max(1.0 + push, 0.0)), 2)


def test_stands_still_in_wind() -> None:
    v = vehicle(wind=WindConfig(mean_m_s=5.0, gust_m_s=2.0))
    v.step(IDLE, 800)
    before = v.p_world
    v.step(IDLE, 8000)
    assert np.linalg.norm(v.p_world - before) < 1e-3
    assert np.linalg.norm(v.v_world) < 1e-3
    assert (v.on_ground, v.contact) == (True, "")
    force, _ = v.mean_since(v.time_ns - 1_000_000_000)
    assert np.linalg.norm(force) == pytest.approx(GRAVITY_M_S2, rel=1e-3)


def test_stands_on_a_slope() -> None:
    rise = math.tan(math.radians(15))
    heights = rise * np.arange(-50, 51.0)[:, None] * np.ones((1, 101))
    v = vehicle(obstacles=Obstacles(np.zeros((0, 9)), np.zeros(0, np.int8), heights, np.full(2, -50.0), 1.0))
    v.step(IDLE, 1600)
    before = v.p_world
    v.step(IDLE, 4000)
    assert np.linalg.norm(v.p_world - before) < 1e-3
    up = rotation_from_quaternion(v.q_world_body)[:, 2]
    assert math.degrees(math.acos(up[2])) == pytest.approx(15.0, abs=1.0)
    assert v.contact == ""


def test_takes_off_and_lands_softly() -> None:
    v = vehicle()
    fly(v, 3.0, climb_m_s=1.0)
    assert v.p_world[2] > 1.0
    assert not v.on_ground
    fly(v, 8.0, climb_m_s=-0.6)
    v.step(IDLE, 800)
    assert (v.on_ground, v.contact) == (True, "")
    assert v.p_world[2] == pytest.approx(PARAMS.standing_height_m, abs=1e-3)


def test_hard_landing_is_a_contact() -> None:
    v = vehicle(z=1.0)
    v.step(IDLE, 800)  # falls from 0.86 m: 4 m/s
    assert v.contact == "ground"
    before = v.p_world
    v.step(np.ones(4), 800)
    np.testing.assert_array_equal(v.p_world, before)
    assert v.time_ns == 1600 * STEP_NS


def test_tipping_over_is_a_contact() -> None:
    v = vehicle()
    for _ in range(400):
        v.step(np.array([0.0, 0.75, 0.75, 0.0]), 2)  # left rotors alone
    assert v.contact == "ground"


@pytest.mark.parametrize(("kind", "name"), [(0, "trunk"), (1, "branch")])
def test_flying_into_a_tree_is_a_contact(kind: int, name: str) -> None:
    cone = np.array([[0.0, 0, 0, 0, 0, 1, 30, 0.15, 0.15]])
    tree = Obstacles(cone, np.array([kind], np.int8), np.zeros((2, 2)), np.array([-100.0, -100.0]), 200.0)
    v = vehicle(z=20.0, x=-1.0, obstacles=tree, wind=WindConfig(mean_m_s=8.0))
    reach = 0.159 * math.sqrt(2) * math.cos(math.radians(45 - math.degrees(0.3))) + 0.127
    assert v.take_min_clearance() == 4.0  # nothing was measured yet
    v.step(hover_command(v), 1)
    assert v.take_min_clearance() == pytest.approx(1.0 - 0.15 - reach, abs=0.01)
    for _ in range(1600):
        v.step(hover_command(v), 2)  # carried by the wind
    assert v.contact == name
    assert -0.01 < v.take_min_clearance() <= 0.0


def test_minimum_clearance_is_since_the_last_call() -> None:
    cone = np.array([[0.0, 0, 0, 0, 0, 1, 60, 0.1, 0.1]])
    tree = Obstacles(cone, np.zeros(1, np.int8), np.zeros((2, 2)), np.array([-100.0, -100.0]), 200.0)
    v = vehicle(z=30.0, x=1.0, obstacles=tree, wind=WindConfig(mean_m_s=6.0))
    smallest = []
    for _ in range(8):
        v.step(hover_command(v), 200)
        smallest.append(v.take_min_clearance())
    assert all(b > a for a, b in pairwise(smallest))  # it drifts away


def test_poses_at_is_exact_for_constant_velocity_and_rate() -> None:
    x = np.zeros(17)
    x[6] = 1.0
    ring, v, w = new_ring(x), np.array([3.0, -2.0, 1.0]), np.array([0.4, -0.3, 2.0])
    for k in range(1, 700):
        before, x = x, x.copy()
        t = k * STEP_NS * 1e-9
        x[:3], x[3:6], x[10:13] = v * t, v, w
        x[6:10] = quaternion_from_rotation(exp_so3(w * t))
        _record(ring, k, before, x, STEP_NS * 1e-9)
    now = 699 * STEP_NS
    stamps = np.random.default_rng(0).integers(now - 500_000_000, now, 200)
    p, q = poses_at(ring, 699, stamps)
    np.testing.assert_allclose(p, v * stamps[:, None] * 1e-9, atol=1e-12)
    for stamp, attitude in zip(stamps, q, strict=True):
        exact = quaternion_from_rotation(exp_so3(w * stamp * 1e-9))
        assert abs(exact @ attitude) == pytest.approx(1.0, abs=1e-12)


def test_history_ends_match_the_state_and_reach_back_before_the_start() -> None:
    v = vehicle(z=10.0)
    start = v.p_world
    v.step(hover_command(v), 100)
    p, q = v.poses_at(np.array([-500_000_000, 0, v.time_ns]))
    np.testing.assert_array_equal(p[[0, 1]], [start, start])
    np.testing.assert_array_equal(p[2], v.p_world)
    np.testing.assert_allclose(q[2], v.q_world_body, atol=1e-15)
    for wrong in (v.time_ns + 1, v.time_ns - 1_400_000_000):
        with pytest.raises(InputError, match="history"):
            v.poses_at(np.array([wrong]))


def test_integrated_imu_truth_returns_to_the_motion() -> None:
    """Strapdown integration of mean force and rate at 800 Hz gives back velocity and attitude."""
    v = vehicle(z=30.0, wind=WindConfig(mean_m_s=3.0, gust_m_s=1.0))
    R, velocity = rotation_from_quaternion(v.q_world_body), v.v_world
    dt = STEP_NS * 1e-9
    for k in range(800):
        v.step(np.array([0.62, 0.63, 0.625, 0.63 + 0.02 * math.sin(k / 30)]), 1)
        force, rate = v.mean_since(v.time_ns - STEP_NS)
        middle = R @ exp_so3(0.5 * dt * rate)
        velocity = velocity + dt * (middle @ force - np.array([0, 0, GRAVITY_M_S2]))
        R = R @ exp_so3(dt * rate)
    np.testing.assert_allclose(velocity, v.v_world, atol=1e-9)
    np.testing.assert_allclose(R, rotation_from_quaternion(v.q_world_body), atol=1e-9)
    assert np.linalg.norm(v.omega_body) > 0.1


def test_imu_truth_before_the_start_is_rest() -> None:
    v = vehicle()
    v.step(IDLE, 4)
    force, rate = v.mean_since(-100_000_000)
    np.testing.assert_allclose(force, [0, 0, GRAVITY_M_S2], atol=0.02)
    np.testing.assert_allclose(rate, 0.0, atol=1e-3)


def test_same_seed_same_bytes_and_call_pattern_does_not_matter() -> None:
    def run(seed: int, steps: int) -> bytes:
        v = vehicle(z=20.0, wind=WindConfig(mean_m_s=4.0, gust_m_s=1.5), seed=seed)
        for _ in range(1200 // steps):
            v.step(np.array([0.62, 0.63, 0.64, 0.61]), steps)
        return v.p_world.tobytes() + v.q_world_body.tobytes() + v.omega_body.tobytes()

    assert run(1, 2) == run(1, 2) == run(1, 8)
    assert run(1, 2) != run(2, 2)


def test_battery_drains_as_power_over_time() -> None:
    v = vehicle(z=1000.0)
    full = v.battery_fraction
    v.step(hover_command(v), 800)
    spent_c = (full - v.battery_fraction) * 3600 * PARAMS.battery.capacity_ah
    assert 12 < spent_c < v.battery_current * 1.05  # about one second of hover at 16 A
    minutes = PARAMS.battery.capacity_ah / v.battery_current * 60
    assert 10 < minutes < 25  # what such an aircraft flies


def test_wrong_motor_commands_are_named() -> None:
    with pytest.raises(InputError, match="motor_command"):
        vehicle().step(np.array([0.1, np.nan, 0.1, 0.1]), 2)
    with pytest.raises(InputError, match="motor_command"):
        vehicle().step(np.zeros(3), 2)


def test_wind_profiles() -> None:
    bare, forest = WindConfig(), WindConfig(canopy_height_m=20.0)
    assert wind_profile(bare, 10.0) == pytest.approx(1.0)
    assert wind_profile(bare, 0.0) == 0.0
    assert wind_profile(forest, 30.0) == pytest.approx(1.0)
    assert wind_profile(forest, 20.0 - 1e-9) == pytest.approx(wind_profile(forest, 20.0), rel=1e-6)
    inside = wind_profile(forest, 2.0) / wind_profile(forest, 20.0)
    assert inside == pytest.approx(math.exp(-2.5 * 0.9))


def test_gusts_have_their_strength_and_length() -> None:
    """Flown through at 5 m/s, a gust of 10 m lasts 2 s; at the reference height the mean is the mean."""
    config = WindConfig(mean_m_s=4.0, heading_deg=90.0, gust_m_s=1.5)
    rng, gust, dt, count = np.random.default_rng(1), np.zeros(3), 0.05, 40_000
    winds, out, velocity = np.empty((count, 3)), np.empty(3), np.array([5.0, 4.0, 0.0])
    for k in range(count):
        _blow(pack_wind(config), gust, rng.standard_normal(3), 10.0, velocity, dt, out)
        winds[k] = out
    np.testing.assert_allclose(winds.mean(axis=0), [0.0, 4.0, 0.0], atol=0.15)
    np.testing.assert_allclose(winds.std(axis=0), [1.5, 1.5, 0.75], rtol=0.1)
    fluctuation = winds - winds.mean(axis=0)
    lag = round(2.0 / dt)
    correlation = (fluctuation[lag:] * fluctuation[:-lag]).mean(axis=0) / fluctuation.var(axis=0)
    np.testing.assert_allclose(correlation, math.exp(-1), atol=0.1)


def test_a_weak_rotor_makes_the_aircraft_fall_to_its_side() -> None:
    v = vehicle(z=50.0)
    v.weaken_rotor(0, 0.2)  # front right
    fly(v, 0.3)
    up = rotation_from_quaternion(v.q_world_body)[:, 2]
    lean_body = rotation_from_quaternion(quaternion_from_yaw(0.3)).T @ up
    assert lean_body[0] > 0.01
    assert lean_body[1] < -0.01
    with pytest.raises(InputError, match="rotor"):
        v.weaken_rotor(4, 0.2)


def test_a_lost_cell_costs_a_quarter_of_voltage_and_of_rotor_speed() -> None:
    v = vehicle(z=500.0)
    v.step(np.full(4, 0.6), 800)
    volts, speed = v.battery_voltage, v.rotor_speed
    v.drop_cells(1)
    v.step(np.full(4, 0.6), 400)
    assert v.battery_voltage / volts == pytest.approx(0.75, abs=0.02)
    np.testing.assert_allclose(v.rotor_speed / speed, v.battery_voltage / volts, atol=0.01)


def test_wind_can_change_in_flight() -> None:
    v = vehicle(z=30.0)
    fly(v, 0.5)
    assert np.linalg.norm(v.v_world[:2]) < 1e-6
    v.set_wind(WindConfig(mean_m_s=10.0))
    fly(v, 0.5)
    assert v.v_world[0] > 0.3
