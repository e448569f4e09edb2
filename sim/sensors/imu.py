"""Inertial sensor: mean specific force and rate over the sample interval, and what spoils them.

White noise, bias that starts off and walks, rotor vibration, saturation, clock offset. Not
modelled: scale factors, misalignment, temperature, dependence of the gyro on acceleration.

Vibration = a blade-passing tone (twice the rotor's turns for two blades, four rotors beating
against each other, aliased by the sample rate as in a real IMU) and a coloured band. Its strength
is what real IMUs reported after their own filters (`imu.toml`, `fit_vibration.py`), so no
second averaging is applied to it.
"""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
from numba import njit

from companion.core.errors import InputError
from companion.core.messages import Array, ImuSample, freeze

NotNegative = Annotated[float, msgspec.Meta(ge=0)]
Positive = Annotated[float, msgspec.Meta(gt=0)]
Fraction = Annotated[float, msgspec.Meta(ge=0, le=1)]

VIBRATION_FILE = Path(__file__).with_name("imu.toml")
_FITTED_FROM = 0.75  # of hover speed; slower, unbalance rules: square of the speed, 0 at rest
_BLOCK = 512  # random numbers are drawn for so many samples at once


class Vibration(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Rotor vibration of the frame; rms per axis at hover speed."""

    accel_lateral_m_s2: NotNegative
    accel_vertical_m_s2: NotNegative
    gyro_lateral_rad_s: NotNegative
    gyro_vertical_rad_s: NotNegative
    speed_exponent: float  # of rms on rotor speed over hover speed
    tone_share_accel_lateral: Fraction  # share of power
    tone_share_accel_vertical: Fraction
    tone_share_gyro_lateral: Fraction
    tone_share_gyro_vertical: Fraction
    colour: Fraction  # c of y[k] = w[k] - c w[k-1]
    isolation: NotNegative  # how much of the frame's motion reaches the sensor


def load_vibration(path: Path = VIBRATION_FILE) -> Vibration:
    """Read fitted figures; raises InputError with file and key."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text(encoding="utf-8")), Vibration)
    except (OSError, tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise InputError(str(error), file=str(path), valid=", ".join(Vibration.__struct_fields__)) from None


class ImuConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A MEMS IMU in flight.

    BMI088 data sheet: gyro 0.014 deg/s/sqrt(Hz) = 2.4e-4 rad/s/sqrt(Hz), offset 1 deg/s, bias
    instability 2 deg/h; accelerometer 190 ug/sqrt(Hz) = 1.9e-3 m/s2/sqrt(Hz), offset 20 mg. The
    white noise here is 4 and 10 times that, the usual inflation for what rigid-body models
    leave out; offsets are those that remain after calibration at rest.
    """

    rate_hz: Positive = 200.0
    accel_noise_m_s2_sqrt_hz: NotNegative = 2e-2
    gyro_noise_rad_s_sqrt_hz: NotNegative = 1e-3
    accel_bias_m_s2: NotNegative = 0.05  # standard deviation at the start, per axis
    gyro_bias_rad_s: NotNegative = 0.003
    accel_bias_walk_m_s2_sqrt_s: NotNegative = 5e-4  # growth of the bias per square root of a second
    gyro_bias_walk_rad_s_sqrt_s: NotNegative = 2e-5
    accel_max_m_s2: Positive = 24 * 9.80665  # BMI088, +-24 g
    gyro_max_rad_s: Positive = math.radians(2000.0)
    clock_offset_us: float = 0.0  # added to every stamp
    vibration: Vibration = load_vibration()


class Imu:
    """One sensor; `stream` tells several of one seed apart."""

    def __init__(self, config: ImuConfig, *, seed: int, hover_speed_rad_s: float, stream: int = 0) -> None:
        self.config = config
        self._rng = np.random.default_rng([seed, 3, stream])
        self._bias: Array = self._rng.standard_normal(6) * np.repeat(
            [config.accel_bias_m_s2, config.gyro_bias_rad_s], 3
        )
        rate = config.rate_hz
        self._white = math.sqrt(rate) * np.repeat([config.accel_noise_m_s2_sqrt_hz, config.gyro_noise_rad_s_sqrt_hz], 3)
        self._walk = np.repeat([config.accel_bias_walk_m_s2_sqrt_s, config.gyro_bias_walk_rad_s_sqrt_s], 3) / math.sqrt(
            rate
        )
        self._limit = np.repeat([config.accel_max_m_s2, config.gyro_max_rad_s], 3)
        self._tone, self._band = _amplitudes(config.vibration)
        v = config.vibration
        self._figures = np.array([hover_speed_rad_s, v.speed_exponent, v.colour, 1.0 / rate])
        self._angles = self._rng.uniform(0.0, 2 * math.pi, (4, 6))  # of the tone, per rotor and axis
        self._turned = self._rng.uniform(0.0, 2 * math.pi, 4)  # of each rotor
        self._last = self._rng.standard_normal(6)  # the band's previous drive
        self._normals: Array = np.zeros((0, 18))
        self._next = 0

    @property
    def accel_bias_body(self) -> Array:
        """Present bias, m/s2, (3,)."""
        return self._bias[:3].copy()

    @property
    def gyro_bias_body(self) -> Array:
        """Present bias, rad/s, (3,)."""
        return self._bias[3:].copy()

    def step_bias(self, accel_m_s2: Array, gyro_rad_s: Array) -> None:
        """Fault: both biases jump by (3,) each."""
        self._bias[:3] += accel_m_s2
        self._bias[3:] += gyro_rad_s

    def sample(
        self, stamp_ns: int, specific_force_body: Array, angular_velocity_body: Array, rotor_speed: Array
    ) -> ImuSample:
        """Spoil true means over the interval that ends at the stamp; rotor speeds (4,) in rad/s."""
        if self._next >= len(self._normals):
            self._normals, self._next = self._rng.standard_normal((_BLOCK, 18)), 0
        out = np.empty(6)
        out[:3], out[3:] = specific_force_body, angular_velocity_body
        _spoil(
            out, self._normals[self._next], self._bias, self._walk, self._white, self._limit, self._tone,
            self._band, self._figures, self._angles, self._turned, self._last, rotor_speed,
        )  # fmt: skip
        self._next += 1
        reading = ImuSample(
            stamp_ns=stamp_ns + round(self.config.clock_offset_us * 1e3),
            specific_force_body=out[:3],
            angular_velocity_body=out[3:],
        )
        freeze(reading)
        return reading


def _amplitudes(v: Vibration) -> tuple[Array, Array]:
    """Per axis (6,): amplitude of each rotor's tone and deviation of the band's drive."""
    rms = v.isolation * np.array(
        [v.accel_lateral_m_s2] * 2 + [v.accel_vertical_m_s2] + [v.gyro_lateral_rad_s] * 2 + [v.gyro_vertical_rad_s]
    )
    share = np.array(
        [v.tone_share_accel_lateral] * 2
        + [v.tone_share_accel_vertical]
        + [v.tone_share_gyro_lateral] * 2
        + [v.tone_share_gyro_vertical]
    )
    tone = rms * np.sqrt(share / 2.0)  # four independent sines of amplitude a have rms a sqrt(2)
    return tone, rms * np.sqrt((1.0 - share) / (1.0 + v.colour**2))


@njit(cache=True, nogil=True)
def _spoil(  # type: ignore[no-untyped-def]
    out, normals, bias, walk, white, limit, tone, band, figures, angles, turned, last, rotor_speed
):
    hover, exponent, colour, interval = figures[0], figures[1], figures[2], figures[3]
    ratio = 0.0
    for r in range(4):
        turned[r] = (turned[r] + rotor_speed[r] * interval) % (2.0 * math.pi)
        ratio += 0.25 * rotor_speed[r] / hover
    strength = max(ratio, _FITTED_FROM) ** exponent * min(ratio / _FITTED_FROM, 1.0) ** 2
    for i in range(6):
        drive = normals[12 + i]
        shake = band[i] * (drive - colour * last[i])
        last[i] = drive
        for r in range(4):
            shake += tone[i] * math.sin(2.0 * turned[r] + angles[r, i])
        bias[i] += walk[i] * normals[6 + i]
        value = out[i] + bias[i] + white[i] * normals[i] + strength * shake
        out[i] = min(max(value, -limit[i]), limit[i])
