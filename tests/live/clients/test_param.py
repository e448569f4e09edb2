"""`companion param` against a running `companion sim`."""

import json
import os
import signal
import socket
import sys

import pytest

from companion.cli.main import main
from companion.core.errors import LinkError
from companion.runtime.ports.parameters import open_parameters

pytest.importorskip("mavsdk", reason="MAVSDK is an extra: pip install 'understory[mavsdk]'")


@pytest.fixture(scope="module")
def sim(start_sim):
    return start_sim(speed=2.0)  # heartbeats come sooner


@pytest.fixture
def param(sim, monkeypatch, capsys):
    """The command in this process; gives exit code, output and errors."""

    def run(*words, url=f"udpin://127.0.0.1:{sim.gcs}"):
        monkeypatch.setattr(sys, "argv", ["companion", "param", *words, f"--vehicle={url}"])
        with pytest.raises(SystemExit) as ended:
            main()
        out, error = capsys.readouterr()
        return ended.value.code, out.strip(), error.strip()

    return run


def test_a_value_is_got_set_and_read_back_with_its_type(param):
    assert param("get", "MPC_XY_VEL_MAX") == (0, "12.0", "")
    assert param("set", "MPC_XY_VEL_MAX", "11") == (0, "MPC_XY_VEL_MAX: 12.0 -> 11.0", "")
    assert param("set", "BAT1_N_CELLS", "6") == (0, "BAT1_N_CELLS: 4 -> 6", "")
    code, out, _ = param("get", "BAT1_N_CELLS", "--json")
    assert (code, json.loads(out)) == (0, {"name": "BAT1_N_CELLS", "value": 6, "type": "int"})


def test_a_value_that_the_vehicle_does_not_take_is_an_error(param):
    code, out, error = param("set", "MPC_THR_MAX", "5")
    assert (code, out) == (1, "")
    assert "kept 1.0 instead of 5.0" in error
    assert param("get", "MPC_THR_MAX")[1] == "1.0"


def test_a_wrong_type_changes_nothing(param):
    code, _, error = param("set", "COM_LOW_BAT_ACT", "0.5")
    assert code == 2
    assert "no integer" in error
    assert param("get", "COM_LOW_BAT_ACT")[1] == "0"


def test_a_typo_is_told_the_nearest_names(param):
    code, out, error = param("get", "MPC_XY_PP")
    assert (code, out) == (2, "")
    assert "valid: MPC_XY_P, " in error


def test_what_was_saved_is_compared_and_loaded_again(param, tmp_path):
    file = tmp_path / "before.params"
    code, out, _ = param("save", str(file))
    lines = [line.split("\t") for line in file.read_text().splitlines() if not line.startswith("#")]
    assert code == 0
    assert out.endswith(f"{len(lines)} parameters")
    assert {row[4] for row in lines if row[2] in ("BAT1_N_CELLS", "EKF2_EV_CTRL")} == {"6"}
    param("set", "MPC_XY_P", "0.9")
    param("set", "EKF2_EV_DELAY", "20")
    changed = param("list", "--changed", str(file), "--json")[1].splitlines()
    assert [json.loads(row)["name"] for row in changed] == ["EKF2_EV_DELAY", "MPC_XY_P"]
    assert param("load", str(file), "--dry-run", "--json")[1].splitlines() == changed
    assert "set and read back: 2 of" in param("load", str(file))[1]
    assert param("list", "--changed", str(file))[1] == "nothing differs from the file"


def test_a_file_with_one_wrong_name_changes_nothing(param, tmp_path):
    file = tmp_path / "typo.params"
    file.write_text("MPC_Z_P 1.5\nMPC_Z_Q 1.5\n")
    code, _, error = param("load", str(file))
    assert code == 2
    assert f"{file}:2" in error and "MPC_Z_P" in error
    assert param("get", "MPC_Z_P")[1] == "1.0"


def test_a_list_is_sorted_and_a_pattern_chooses(param):
    rows = [json.loads(row) for row in param("list", "ekf2_gps*", "--json")[1].splitlines()]
    names = [row["name"] for row in rows]
    assert names == sorted(names) and all(name.startswith("EKF2_GPS") for name in names)
    assert {row["type"] for row in rows} == {"int", "float"}
    assert param("list", "NOTHING*")[0] == 2


def test_a_port_in_use_and_a_silent_one_are_told_apart(param):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", 0))
        code, _, error = param("get", "MPC_XY_P", url=f"udpin://127.0.0.1:{other.getsockname()[1]}")
    assert code == 3
    assert "another ground station" in error
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    code, _, error = param("get", "MPC_XY_P", "--wait-s=1", url=f"udpin://127.0.0.1:{port}")
    assert code == 3
    assert "no autopilot heard within 1 s" in error


@pytest.mark.slow
def test_a_vehicle_that_falls_silent_ends_it(sim):
    with open_parameters(f"udpin://127.0.0.1:{sim.gcs}") as parameters:
        parameters.set("BAT1_N_CELLS", 6)
        assert parameters.get("BAT1_N_CELLS") == 6
        os.kill(sim.pid, signal.SIGSTOP)
        try:
            with pytest.raises(LinkError, match="does not answer"):
                parameters.set("BAT1_N_CELLS", 4)
            with pytest.raises(LinkError, match="not heard any more"):
                parameters.all()
        finally:
            os.kill(sim.pid, signal.SIGCONT)
