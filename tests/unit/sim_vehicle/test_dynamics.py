"""Laws that the equations of motion must keep, and the aerodynamic formulas at known points."""

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.core.geometry import rotate
from sim.vehicle.dynamics import STEP_S, battery_volts, derivative, step
from sim.vehicle.params import AIR_DENSITY_KG_M3, GRAVITY_M_S2, VehicleParams, load_params, pack

PARAMS = load_params()
CALM = np.zeros(3)
STILL = np.zeros(4)


def vacuum(params: VehicleParams = PARAMS) -> VehicleParams:
    """The same body without any aerodynamics."""
    return msgspec.structs.replace(
        params,
        airframe=msgspec.structs.replace(params.airframe, drag_area_m2=(0.0, 0.0, 0.0)),
        rotors=msgspec.structs.replace(
            params.rotors,
            thrust_n_s2=0.0,
            axial_n_s2_m=0.0,
            translational_lift_n_s2_m2=0.0,
            drag_n_s2_m=0.0,
        ),
    )


def tumbling(rotors: float = 0.0) -> np.ndarray:
    x = np.zeros(17)
    x[:3], x[3:6], x[6:10], x[10:13] = (1, 2, 500), (3, -1, 4), (0.5, -0.5, 0.1, 0.7), (4.0, -7.0, 2.5)
    x[6:10] /= np.linalg.norm(x[6:10])
    x[13:] = rotors
    return x


def hovering(height_m: float = 50.0) -> np.ndarray:
    x = np.zeros(17)
    x[2], x[6], x[13:] = height_m, 1.0, PARAMS.hover_speed_rad_s
    return x


def energy(x: np.ndarray, params: VehicleParams) -> float:
    J, m = np.array(params.airframe.inertia_kg_m2), params.airframe.mass_kg
    return 0.5 * m * x[3:6] @ x[3:6] + 0.5 * x[10:13] @ J @ x[10:13] + m * GRAVITY_M_S2 * x[2]


def angular_momentum_world(x: np.ndarray, params: VehicleParams) -> np.ndarray:
    H = np.array(params.airframe.inertia_kg_m2) @ x[10:13]
    H[2] += params.rotors.inertia_kg_m2 * np.array(params.rotors.turning) @ x[13:]
    return rotate(x[6:10], H)


def test_free_tumbling_keeps_energy_and_angular_momentum() -> None:
    params, x = vacuum(), tumbling()
    model = pack(params)
    E, H = energy(x, params), angular_momentum_world(x, params)
    for _ in range(4000):  # 5 s
        x = step(model, x, STILL, wind_world=CALM)
    assert energy(x, params) == pytest.approx(E, rel=1e-9)
    np.testing.assert_allclose(angular_momentum_world(x, params), H, atol=1e-6)
    assert np.linalg.norm(x[6:10]) == pytest.approx(1.0, abs=1e-15)


def test_angular_momentum_stays_while_rotors_spin_up() -> None:
    params, x = vacuum(), tumbling()
    model, H = pack(params), angular_momentum_world(tumbling(), params)
    for _ in range(800):
        x = step(model, x, np.array([800.0, 100.0, 0.0, 400.0]), wind_world=CALM)
    assert x[13] > 799
    np.testing.assert_allclose(angular_momentum_world(x, params), H, atol=1e-5)


@given(st.lists(st.floats(-20, 20), min_size=3, max_size=3))
@settings(max_examples=50, deadline=None)
def test_gyroscopic_torque_does_no_work(omega: list[float]) -> None:
    params, x = vacuum(), tumbling(rotors=0.0)
    x[10:13], x[13:] = omega, (100.0, 300.0, 500.0, 700.0)
    torque = np.array(params.airframe.inertia_kg_m2) @ derivative(pack(params), x, x[13:], wind_world=CALM)[10:13]
    assert abs(torque @ x[10:13]) < 1e-9 * (1 + np.linalg.norm(torque) * np.linalg.norm(x[10:13]))


def test_runge_kutta_is_of_fourth_order() -> None:
    model, demand = pack(PARAMS), np.array([600.0, 500.0, 550.0, 580.0])

    def after(count: int) -> np.ndarray:
        x = tumbling(rotors=400.0)
        for _ in range(count):
            x = step(model, x, demand, wind_world=CALM, dt_s=0.2 / count)
        return x

    exact = after(6400)
    coarse, fine = np.abs(after(20) - exact).max(), np.abs(after(40) - exact).max()
    assert 12 < coarse / fine < 20


def test_hover_thrust_is_the_weight() -> None:
    dx = derivative(pack(PARAMS), hovering(), hovering()[13:], wind_world=CALM)
    np.testing.assert_allclose(dx[3:6], 0.0, atol=1e-9)
    np.testing.assert_allclose(dx[10:13], 0.0, atol=1e-9)


@pytest.mark.parametrize(("axis", "rotors", "sign"), [(0, (1, 2), 1), (1, (1, 3), 1), (2, (2, 3), 1)])
def test_each_pair_of_rotors_turns_the_body_its_way(axis: int, rotors: tuple[int, int], sign: int) -> None:
    """Left pair rolls right (+x), rear pair pitches nose down (+y), clockwise pair yaws left (+z)."""
    x = hovering()
    x[[13 + r for r in rotors]] *= 1.05
    x[[13 + r for r in range(4) if r not in rotors]] *= 0.95
    turn = derivative(pack(PARAMS), x, x[13:], wind_world=CALM)[10:13]
    assert np.argmax(np.abs(turn)) == axis
    assert np.sign(turn[axis]) == sign


def test_ground_effect_follows_cheeseman_and_bennett() -> None:
    r, hub = PARAMS.rotors.ground_effect_radius_m, PARAMS.rotors.xyz_m[0][2]
    ground = np.zeros(5)
    for height in (0.2, 0.3, 0.6):
        dx = derivative(pack(PARAMS), hovering(height), hovering()[13:], wind_world=CALM, ground_z=ground)
        gain = 1 + dx[5] / GRAVITY_M_S2
        assert gain == pytest.approx(1 / (1 - (r / (4 * (height + hub))) ** 2), rel=1e-9)
    near, far = (
        derivative(pack(PARAMS), hovering(h), hovering()[13:], wind_world=CALM, ground_z=ground)[5] for h in (0.2, 5.0)
    )
    assert near > far + 0.1


def test_terminal_speed_is_that_of_the_drag_formula() -> None:
    model, x = pack(PARAMS), hovering(5000.0)
    x[13:] = 0.0
    for _ in range(16000):  # 20 s
        x = step(model, x, STILL, wind_world=CALM)
    area = PARAMS.airframe.drag_area_m2[2]
    expected = math.sqrt(2 * PARAMS.weight_n / (AIR_DENSITY_KG_M3 * area))
    assert -x[5] == pytest.approx(expected, rel=1e-3)


def test_moving_with_the_wind_is_rest_in_still_air() -> None:
    wind = np.array([4.0, -2.0, 0.5])
    x = tumbling(rotors=500.0)
    moving = x.copy()
    moving[3:6] += wind
    np.testing.assert_allclose(
        derivative(pack(PARAMS), moving, x[13:], wind_world=wind)[3:],
        derivative(pack(PARAMS), x, x[13:], wind_world=CALM)[3:],
        atol=1e-12,
    )


@pytest.mark.parametrize(("start", "demand"), [(300.0, 600.0), (600.0, 300.0)])
def test_motor_reaches_63_percent_after_its_time_constant(start: float, demand: float) -> None:
    model, x = pack(PARAMS), hovering()
    x[13:] = start
    m = PARAMS.motor
    tau = m.time_constant_up_s if demand > start else m.time_constant_down_s
    for _ in range(round(tau / STEP_S)):
        x = step(model, x, np.full(4, demand), wind_world=CALM)
    np.testing.assert_allclose((x[13:] - start) / (demand - start), 1 - math.exp(-1), atol=1e-4)


def test_battery_sags_with_load_and_with_discharge() -> None:
    model = pack(PARAMS)
    by_load = [battery_volts(model, 0.8, watts) for watts in range(0, 800, 50)]
    by_charge = [battery_volts(model, f, 300.0) for f in np.linspace(1, 0, 41)]
    assert all(a > b for a, b in pairwise(by_load))
    assert all(a > b for a, b in pairwise(by_charge))
    assert by_load[0] == pytest.approx(4 * 4.02)
    volts = battery_volts(model, 1.0, 400.0)
    assert volts == pytest.approx(4 * 4.20 - PARAMS.battery.resistance_ohm * 400.0 / volts)
