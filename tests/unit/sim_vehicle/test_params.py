"""The vehicle file: what it holds, and that mistakes are named."""

from pathlib import Path

import numpy as np
import pytest

from companion.core.errors import InputError
from sim.vehicle.params import DEFAULT_FILE, hull_spheres, load_params


def edited(tmp_path: Path, old: str, new: str) -> Path:
    path = tmp_path / "quad.toml"
    text = DEFAULT_FILE.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("mass_kg = 2.0", "mass_kg = 2.0\nmas_kg = 1", "mas_kg"),
        ("mass_kg = 2.0", "mass_kg = -2.0", "airframe.mass_kg"),
        ("capacity_ah = 5.2", "", "capacity_ah"),
        ("[0.0, 0.0226, 0.0]", "[0.1, 0.0226, 0.0]", "inertia"),
        ("[motor]", "[moto", "quad.toml"),
    ],
)
def test_mistakes_in_the_file_are_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        load_params(edited(tmp_path, old, new))


def test_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"nowhere\.toml"):
        load_params(tmp_path / "nowhere.toml")


def test_default_is_a_quad_of_2_kg_and_45_cm_that_can_fly() -> None:
    params = load_params()
    hubs = np.array(params.rotors.xyz_m)
    assert params.airframe.mass_kg == 2.0
    assert np.linalg.norm(hubs[0] - hubs[1]) == pytest.approx(0.45, abs=0.001)
    assert sum(params.rotors.turning) == 0
    np.testing.assert_allclose(hubs[:, :2].sum(axis=0), 0.0, atol=1e-12)
    assert 2.0 < 4 * params.max_rotor_thrust_n / params.weight_n < 3.0
    hover_thrust_n = params.max_rotor_thrust_n * params.hover_command**2
    assert 4 * hover_thrust_n == pytest.approx(params.weight_n)
    moments = np.linalg.eigvalsh(np.array(params.airframe.inertia_kg_m2))
    assert moments[2] < moments[0] + moments[1]  # a body of real mass


def test_hull_holds_the_rotor_discs_and_the_body() -> None:
    spheres = hull_spheres(load_params())
    assert spheres.shape == (6, 5)
    assert list(spheres[:, 4]) == [1, 1, 1, 1, 0, 0]
    assert np.all(spheres[:4, 3] == 0.127)
