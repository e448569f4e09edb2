"""PX4's parameters that this autopilot uses, and the protocol that lists, reads and sets them.

Names, types and defaults are PX4's (read off a PX4 1.18 by PARAM_REQUEST_LIST). Some
defaults differ, as an airframe's start-up script does on a real one: see `airframe_defaults`.
Values travel "bytewise": the bits of an INT32 in the float field.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Final

import numpy as np

from companion.core.errors import InputError
from sim.autopilot.allocation import allocation
from sim.autopilot.codec import BY_NAME, Encoder, Frame
from sim.autopilot.readings import Airframe

INT32: Final = 6
REAL32: Final = 9

DEFAULTS: Final[dict[str, float | int]] = {
    "BAT1_N_CELLS": 4,
    "BAT1_V_CHARGED": 4.05,
    "BAT1_V_EMPTY": 3.6,
    "BAT_CRIT_THR": 0.07,
    "BAT_LOW_THR": 0.15,
    "COM_DISARM_LAND": 2.0,
    "COM_DISARM_PRFLT": 10.0,
    "COM_LOW_BAT_ACT": 0,
    "COM_OBL_RC_ACT": 5,
    "COM_OF_LOSS_T": 1.0,
    "COM_RC_LOSS_T": 1.0,
    "COM_SPOOLUP_TIME": 1.0,
    "EKF2_ABL_LIM": 0.4,
    "EKF2_ACC_B_NOISE": 0.003,
    "EKF2_ACC_NOISE": 0.35,
    "EKF2_BARO_CTRL": 1,
    "EKF2_BARO_GATE": 5.0,
    "EKF2_BARO_NOISE": 3.5,
    "EKF2_DELAY_MAX": 200.0,
    "EKF2_EVA_NOISE": 0.1,
    "EKF2_EVP_GATE": 5.0,
    "EKF2_EVP_NOISE": 0.1,
    "EKF2_EVV_GATE": 3.0,
    "EKF2_EVV_NOISE": 0.1,
    "EKF2_EV_CTRL": 15,
    "EKF2_EV_DELAY": 0.0,
    "EKF2_EV_NOISE_MD": 0,
    "EKF2_EV_QMIN": 0,
    "EKF2_GPS_CTRL": 0,
    "EKF2_GPS_P_GATE": 5.0,
    "EKF2_GPS_P_NOISE": 0.5,
    "EKF2_GPS_V_GATE": 5.0,
    "EKF2_GPS_V_NOISE": 0.3,
    "EKF2_GRAV_NOISE": 1.0,
    "EKF2_GYR_B_LIM": 0.15,
    "EKF2_GYR_B_NOISE": 0.001,
    "EKF2_GYR_NOISE": 0.015,
    "EKF2_HDG_GATE": 2.6,
    "EKF2_HGT_REF": 3,
    "EKF2_NOAID_TOUT": 5_000_000,
    "IMU_DGYRO_CUTOFF": 30.0,
    "IMU_GYRO_CUTOFF": 40.0,
    "LNDMC_ROT_MAX": 20.0,
    "LNDMC_XY_VEL_MAX": 1.5,
    "LNDMC_Z_VEL_MAX": 0.25,
    "MAV_SYS_ID": 1,
    "MC_PITCHRATE_D": 0.003,
    "MC_PITCHRATE_I": 0.2,
    "MC_PITCHRATE_MAX": 220.0,
    "MC_PITCHRATE_P": 0.15,
    "MC_PITCH_P": 6.5,
    "MC_PR_INT_LIM": 0.3,
    "MC_ROLLRATE_D": 0.003,
    "MC_ROLLRATE_I": 0.2,
    "MC_ROLLRATE_MAX": 220.0,
    "MC_ROLLRATE_P": 0.15,
    "MC_ROLL_P": 6.5,
    "MC_RR_INT_LIM": 0.3,
    "MC_YAWRATE_D": 0.0,
    "MC_YAWRATE_I": 0.1,
    "MC_YAWRATE_MAX": 200.0,
    "MC_YAWRATE_P": 0.2,
    "MC_YAW_P": 2.8,
    "MC_YAW_WEIGHT": 0.4,
    "MC_YR_INT_LIM": 0.3,
    "MIS_TAKEOFF_ALT": 2.5,
    "MPC_ACC_DECOUPLE": 1,
    "MPC_ACC_DOWN_MAX": 3.0,
    "MPC_ACC_HOR": 3.0,
    "MPC_ACC_UP_MAX": 4.0,
    "MPC_LAND_ALT1": 10.0,
    "MPC_LAND_ALT2": 5.0,
    "MPC_LAND_ALT3": 1.0,
    "MPC_LAND_CRWL": 0.3,
    "MPC_LAND_SPEED": 0.7,
    "MPC_MAN_Y_MAX": 150.0,
    "MPC_THR_HOVER": 0.5,
    "MPC_THR_MAX": 1.0,
    "MPC_THR_MIN": 0.12,
    "MPC_THR_XY_MARG": 0.3,
    "MPC_TILTMAX_AIR": 45.0,
    "MPC_TILTMAX_LND": 12.0,
    "MPC_TKO_RAMP_T": 3.0,
    "MPC_TKO_SPEED": 1.5,
    "MPC_USE_HTE": 1,
    "MPC_VELD_LP": 5.0,
    "MPC_VEL_MANUAL": 10.0,
    "MPC_XY_CRUISE": 5.0,
    "MPC_XY_ERR_MAX": 2.0,
    "MPC_XY_P": 0.95,
    "MPC_XY_VEL_D_ACC": 0.2,
    "MPC_XY_VEL_I_ACC": 0.4,
    "MPC_XY_VEL_MAX": 12.0,
    "MPC_XY_VEL_P_ACC": 1.8,
    "MPC_YAWRAUTO_MAX": 60.0,
    "MPC_Z_P": 1.0,
    "MPC_Z_VEL_D_ACC": 0.0,
    "MPC_Z_VEL_I_ACC": 2.0,
    "MPC_Z_VEL_MAX_DN": 1.5,
    "MPC_Z_VEL_MAX_UP": 3.0,
    "MPC_Z_VEL_P_ACC": 4.0,
    "MPC_Z_V_AUTO_DN": 1.5,
    "MPC_Z_V_AUTO_UP": 3.0,
    "NAV_MC_ALT_RAD": 0.8,
    "RTL_MIN_DIST": 10.0,
    "RTL_RETURN_ALT": 30.0,
    "SYS_HAS_BARO": 1,
    "SYS_HAS_GPS": 0,
    "THR_MDL_FAC": 0.0,
}
"""An int default makes an INT32 parameter. Vision-only defaults: EV_CTRL 15, HGT_REF 3, no GPS."""

RANGES: Final[dict[str, tuple[float, float]]] = {
    "BAT1_N_CELLS": (1, 16),
    "IMU_DGYRO_CUTOFF": (1.0, 1000.0),
    "IMU_GYRO_CUTOFF": (1.0, 1000.0),
    "MPC_THR_HOVER": (0.1, 0.8),
    "MPC_THR_MAX": (0.1, 1.0),
    "MPC_THR_MIN": (0.0, 0.5),
    "MPC_TILTMAX_AIR": (10.0, 80.0),
    "MPC_TILTMAX_LND": (5.0, 80.0),
    "MPC_VELD_LP": (0.1, 1000.0),
    "MPC_XY_VEL_P_ACC": (0.2, 15.0),
    "MPC_Z_VEL_P_ACC": (0.2, 15.0),
    "THR_MDL_FAC": (0.0, 1.0),
    **{name: (1e-4, 20.0) for name in DEFAULTS if name.startswith("EKF2_") and name.endswith("_NOISE")},
}
"""Values that control laws and filter cannot do without; all others: not negative, below 1e9."""


def airframe_defaults(airframe: Airframe) -> dict[str, float]:
    """What the set-up script of this airframe sets: hover thrust, thrust curve, gains.

    Softer position gains than PX4's 0.95 and 0.4: with those a step of 5 m takes 1.9 s to 90 %
    and overshoots by 0.6 m; with these 2.7 s and 0.15 m, as the flown autopilots did.

    The rate loops get the bandwidth 0.4/motor time, which with the motor's lag is a damping
    of 0.8; their gains are per unit of torque, so they depend on arm, thrust and inertia.
    """
    hover = airframe.mass_kg * 9.80665 / (4 * airframe.max_thrust_n)
    _, torque_n_m = allocation(airframe)
    bandwidth = min(0.4 / airframe.motor_time_s, 20.0)
    gain = bandwidth * airframe.inertia_kg_m2 / torque_n_m
    yaw = 0.4 * gain[2]
    return {
        "MPC_XY_P": 0.65,
        "MPC_XY_VEL_I_ACC": 0.2,
        "MPC_THR_HOVER": hover,
        "THR_MDL_FAC": airframe.thrust_curve,
        "MC_ROLLRATE_P": gain[0],
        "MC_ROLLRATE_I": gain[0] * 1.3,
        "MC_ROLLRATE_D": gain[0] * 0.02,
        "MC_PITCHRATE_P": gain[1],
        "MC_PITCHRATE_I": gain[1] * 1.3,
        "MC_PITCHRATE_D": gain[1] * 0.02,
        "MC_YAWRATE_P": yaw,
        "MC_YAWRATE_I": yaw * 0.5,
    }


class Parameters:
    """The store: `parameters["MPC_XY_P"]`; `version` counts changes, so readers may cache."""

    def __init__(self, *overrides: Mapping[str, float]) -> None:
        self._values: dict[str, float | int] = dict(DEFAULTS)
        self.names = sorted(DEFAULTS)
        self.version = 0
        for changes in overrides:
            for name, value in changes.items():
                self._override(name, value)

    def __getitem__(self, name: str) -> float:
        return self._values[name]

    def __len__(self) -> int:
        return len(self.names)

    def integer(self, name: str) -> int:
        """The value of an INT32 parameter."""
        return int(self._values[name])

    def is_integer(self, name: str) -> bool:
        """Whether the parameter is an INT32."""
        return isinstance(DEFAULTS[name], int)

    def set(self, name: str, value: float) -> bool:
        """Set a value as PARAM_SET does; False if there is no such parameter or the value is out of range."""
        low, high = RANGES.get(name, (0.0, 1e9))
        if name not in self._values or not low <= value <= high:
            return False
        self._values[name] = int(value) if self.is_integer(name) else float(np.float32(value))
        self.version += 1
        return True

    def _override(self, name: str, value: float) -> None:
        if not self.set(name, value):
            near = ", ".join(get_close_matches(name, self.names)) or "see sim/autopilot/params.py"
            raise InputError(f"no such parameter, or {value} is out of its range", field=name, valid=near)

    def wire_value(self, name: str) -> tuple[float, int]:
        """Value bytewise in a float, and its MAV_PARAM_TYPE."""
        if self.is_integer(name):
            return struct.unpack("<f", struct.pack("<i", self.integer(name)))[0], INT32
        return self[name], REAL32


class ParameterService:
    """Answers PARAM_REQUEST_LIST, PARAM_REQUEST_READ and PARAM_SET; lists at a pace."""

    PER_CALL = 4  # values sent at one call, so that a list does not choke the link

    def __init__(self, parameters: Parameters, encoder: Encoder) -> None:
        self._parameters, self._encoder = parameters, encoder
        self._next = len(parameters)

    def handle(self, frame: Frame) -> bytes:
        """The answer to one frame, b"" if it is none of this service's."""
        name = frame.layout.name
        if name == "PARAM_REQUEST_LIST":
            self._next = 0
            return b""
        if name == "PARAM_REQUEST_READ":
            index, _, _, raw = frame.values
            known = self._parameters.names
            wanted = _text(raw) if index < 0 else known[index] if index < len(known) else ""
            return self._value(wanted) if wanted in known else b""
        if name == "PARAM_SET":
            return self._set(frame)
        return b""

    def due(self) -> bytes:
        """The next piece of a list that was asked for."""
        first = self._next
        if first >= len(self._parameters):
            return b""
        self._next = min(first + self.PER_CALL, len(self._parameters))
        return b"".join(self._value(name) for name in self._parameters.names[first : self._next])

    def _set(self, frame: Frame) -> bytes:
        value, _, _, raw, kind = frame.values
        name = _text(raw)
        if name not in self._parameters.names:
            return b""
        if kind == INT32:
            value = struct.unpack("<i", struct.pack("<f", value))[0] if self._parameters.is_integer(name) else value
        if kind == (INT32 if self._parameters.is_integer(name) else REAL32):
            self._parameters.set(name, value)
        return self._value(name)

    def _value(self, name: str) -> bytes:
        value, kind = self._parameters.wire_value(name)
        index = self._parameters.names.index(name)
        return self._encoder(BY_NAME["PARAM_VALUE"], value, len(self._parameters), index, name.encode(), kind)


def _text(raw: bytes) -> str:
    return raw.split(b"\0")[0].decode("ascii", "replace")
