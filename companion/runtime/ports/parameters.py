"""Reads and sets an autopilot's parameters, by MAVSDK, on an endpoint of its own.

    with open_parameters("udpin://127.0.0.1:14550") as parameters:
        parameters.get("MPC_XY_P")         # 0.65
        parameters.set("MPC_XY_P", 0.7)    # 0.7, read back; Refused if the vehicle kept another value
        parameters.all()                   # {"BAT1_N_CELLS": 4, ...}

Transfers are requests that wait for answers, beside the flight and never in it; MAVSDK does them for PX4 and
ArduPilot.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from contextlib import suppress
from difflib import get_close_matches
from types import TracebackType
from typing import Final

import numpy as np

from companion.core.errors import CompanionError, InputError, LinkError
from companion.runtime.ports.ground_station import FIRST_HEARTBEAT_S, GroundStation

Value = int | float
INT_MIN, INT_MAX = -(2**31), 2**31 - 1
NEAREST: Final = 5


class Refused(CompanionError):
    """The vehicle kept another value than it was told."""

    def __init__(self, name: str, wanted: Value, kept: Value) -> None:
        self.name, self.wanted, self.kept = name, wanted, kept
        super().__init__(f"{name}: the vehicle kept {shown(kept)} instead of {shown(wanted)}")


def open_parameters(url: str, *, wait_s: float = FIRST_HEARTBEAT_S) -> Parameters:
    """Connect, and wait for an autopilot's heartbeat; raises what `GroundStation` raises."""
    return Parameters(url, wait_s=wait_s)


class Parameters:
    """See `open_parameters`; a context manager. Every call ends within some seconds, answered or not."""

    def __init__(self, url: str, *, wait_s: float) -> None:
        self._station = GroundStation(url, "param", wait_s=wait_s)
        self._plugin = self._station.plugin
        self._parameters = self._plugin.Param(self._station.system)
        self._lost = False

    def all(self) -> dict[str, Value]:
        """Every parameter by name, sorted; raises LinkError if the list does not come whole."""
        self._check_link()
        found = self._parameters.get_all_params()
        values: dict[str, Value] = {p.name: int(p.value) for p in found.int_params}
        values |= {p.name: single(p.value) for p in found.float_params}
        if not values:
            self._lost = True  # MAVSDK 4.1 aborts the process at the next request after a list that never came
            raise self._station.silent("the list of parameters")
        return dict(sorted(values.items()))

    def get(self, name: str) -> Value:
        """One value: an int, or the shortest float that is the same in 32 bits.

        Raises InputError with the nearest names if there is no such parameter, LinkError if nobody answers.
        """
        self._check_link()
        value = self._read(name)
        if value is not None:
            return value
        values = self.all()  # an unknown name has no answer: only the list tells it from a lost one
        if name not in values:
            raise unknown(name, values)
        return values[name]

    def set(self, name: str, value: Value) -> Value:
        """Set, read back, and return what the vehicle keeps; Refused if that is another value.

        An int for an integer parameter, a float for a float one: `read_value` makes them of text.
        """
        self._check_link()
        code, send = self._plugin.ParamError, self._parameters
        with suppress(code):  # "timeout" also stands for a refusal: what counts is the value that is there now
            (send.set_param_int if isinstance(value, int) else send.set_param_float)(name, value)
        kept = self._read(name)
        if kept is None:
            raise self._station.silent(name)
        if not same(kept, value):
            raise Refused(name, value, kept)
        return kept

    def _read(self, name: str) -> Value | None:
        """The value, or None if there was no answer."""
        result = self._plugin.ParamResult
        try:
            return int(self._parameters.get_param_int(name))
        except self._plugin.ParamError as error:
            if error.result != result.WRONG_TYPE:
                return None
        try:
            return single(self._parameters.get_param_float(name))
        except self._plugin.ParamError:
            return None

    def _check_link(self) -> None:
        if self._lost:
            raise LinkError(f"{self._station.endpoint}: the autopilot is not heard any more")
        self._station.check_link()

    def close(self) -> None:
        """End MAVSDK's threads and close the connection."""
        self._station.close()

    def __enter__(self) -> Parameters:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def single(value: float) -> float:
    """The shortest decimal that is the same float of 32 bits: 0.65, not 0.6499999761581421."""
    return float(str(np.float32(value)))


def same(one: Value, other: Value) -> bool:
    """Whether two values are one and the same on the vehicle."""
    if isinstance(one, int) or isinstance(other, int):
        return one == other
    return np.float32(one) == np.float32(other) or (math.isnan(one) and math.isnan(other))


def shown(value: Value) -> str:
    """As text; a float always has a point or an exponent."""
    return str(value)


def read_value(text: str, like: Value, name: str, *, file: str = "", line: int = 0) -> Value:
    """A value of the type that the vehicle has for `name`; raises InputError."""

    def wrong(problem: str, valid: str) -> InputError:
        return InputError(problem, field=name, valid=valid, file=file, line=line)

    if isinstance(like, int):
        try:
            number = int(text)
        except ValueError:
            raise wrong(f"{text!r} is no integer, and the vehicle has one here", f"such as {like}") from None
        if not INT_MIN <= number <= INT_MAX:
            raise wrong(f"{text} does not fit into 32 bits", f"{INT_MIN}..{INT_MAX}")
        return number
    try:
        value = float(text)
    except ValueError:
        raise wrong(f"{text!r} is no number", f"such as {shown(like)}") from None
    with np.errstate(over="ignore"):
        short = single(value)
    if not math.isfinite(short):
        raise wrong(f"{text} is no finite number of 32 bits", f"such as {shown(like)}")
    return short


def unknown(name: str, known: Collection[str], *, file: str = "", line: int = 0) -> InputError:
    """What to say about a name that the vehicle does not have."""
    near = ", ".join(get_close_matches(name.upper(), known, n=NEAREST))
    return InputError(
        "the vehicle has no such parameter", field=name, valid=near or "companion param list", file=file, line=line
    )
