"""Parameter files and values: what is written is read again, types are the vehicle's."""

import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core.errors import CompanionError, InputError
from companion.runtime.ports.parameter_file import differences, read_entries, write_text
from companion.runtime.ports.parameters import open_parameters, read_value, same, single, unknown

FLOATS = st.floats(width=32, allow_nan=False, allow_infinity=False)
INTS = st.integers(-(2**31), 2**31 - 1)
NAMES = st.text("ABCDEFGHIJKLMNOPQRSTUVWXYZ_0123456789", min_size=1, max_size=16)
HAVE = {"BAT1_N_CELLS": 4, "MPC_XY_P": 0.65, "MPC_Z_P": 1.0}


@given(FLOATS)
def test_a_float_of_32_bits_survives_as_its_shortest_decimal(value):
    assert np.float32(single(value)) == np.float32(value)
    assert single(single(value)) == single(value)
    assert single(0.6499999761581421) == 0.65


@given(st.dictionaries(NAMES, st.one_of(INTS, FLOATS.map(single)), min_size=1))
def test_a_file_gives_the_same_values_and_types(values):
    text = write_text(values)
    assert differences(read_entries(text, file="f"), values, file="f") == []
    for entry in read_entries(text, file="f"):
        value = read_value(entry.text, values[entry.name], entry.name)
        assert type(value) is type(values[entry.name]) and value == values[entry.name]


def test_both_programs_files_are_read():
    station = "# Onboard parameters\n\n1\t1\tMPC_XY_P\t0.700000\t9\n1\t1\tBAT1_N_CELLS\t6\t6\n"
    proxy = "MPC_XY_P         0.700000\nBAT1_N_CELLS     6.000000\n"
    for text in (station, proxy):
        found = differences(read_entries(text, file="f"), HAVE, file="f")
        assert [(d.name, d.vehicle, d.file) for d in found] == [("MPC_XY_P", 0.65, 0.7), ("BAT1_N_CELLS", 4, 6)]
        assert type(found[1].file) is int


def test_ten_is_not_one():
    assert read_entries("A 10\nB 100.0\n", file="f")[0].text == "10"
    assert differences(read_entries("A 10\nB 100.0\n", file="f"), {"A": 10, "B": 100}, file="f") == []


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("MPC_XY_P 0.7\nMPC_XY_P 0.8\n", 2, "line 1"),
        ("\n\nMPC_XY_P\n", 3, "is no parameter"),
        ("MPC_XY_O 0.7\n", 1, "no such parameter"),
        ("BAT1_N_CELLS 4.5\n", 1, "is no integer"),
        ("MPC_Z_P 1\nMPC_XY_P high\n", 2, "is no number"),
    ],
)
def test_a_wrong_line_is_named(text, line, words):
    with pytest.raises(InputError, match=words) as caught:
        differences(read_entries(text, file="f"), HAVE, file="f")
    assert (caught.value.file, caught.value.line) == ("f", line)


def test_a_file_without_parameters_is_refused():
    with pytest.raises(InputError, match="no parameters"):
        read_entries("# nothing\n", file="f")


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "1e39", "x", ""])
def test_no_float_of_the_vehicle(text):
    with pytest.raises(InputError):
        read_value(text, 1.0, "MPC_Z_P")


@pytest.mark.parametrize("text", ["2147483648", "-2147483649", "1.0", "1e3", "x", ""])
def test_no_integer_of_the_vehicle(text):
    with pytest.raises(InputError):
        read_value(text, 4, "BAT1_N_CELLS")


def test_an_integer_word_for_a_float_is_a_float():
    assert type(read_value("3", 0.65, "MPC_XY_P")) is float


def test_sameness_is_that_of_the_vehicle():
    assert same(0.1 + 0.2, 0.3)  # in 32 bits
    assert same(math.nan, math.nan)
    assert not same(0.65, 0.6500001)
    assert not same(4, 5)


def test_a_typo_is_told_the_nearest_names_whatever_its_case():
    assert unknown("mpc_xy_o", HAVE).valid.startswith("MPC_XY_P")
    assert "param list" in unknown("XXXXXXXX", HAVE).valid


def test_without_mavsdk_the_command_that_helps_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "mavsdk", None)
    with pytest.raises(CompanionError, match=r"pip install 'understory\[mavsdk\]'"):
        open_parameters("udpin://127.0.0.1:14550")


@pytest.mark.parametrize("url", ["14550", "udpin://[::1]:14550", "mavlink://host:1"])
def test_a_wrong_url_is_refused_before_anything_is_opened(url):
    with pytest.raises(InputError, match="--vehicle"):
        open_parameters(url)
