"""Rotor vibration from real flights: reproduces the figures of `imu.toml`.

    python -m sim.sensors.fit_vibration DIRECTORY_OF_imu_rtk_quadrotor_ansfl

Data: DJI Phantom 4 RTK with up to four Xsens DOT, 120 Hz (Hurwitz and Klein, "Quadrotor Dead
Reckoning with Multiple Inertial Sensors", 2023, CC BY 4.0; 31 flights of it). The sensors were
taped hard to the frame, so the figures are those of the frame.

Read from them, above 8 Hz, in windows of 0.5 s (amplitude) and 2 s (spectrum):
- rms per axis at a specific force near 1 g;
- how the rms goes with rotor speed, taken as the square root of the specific force over that
  of hover: log-linear fit, exponent;
- the share of power in a narrow line, from the power in the strongest four of the spectrum's bins,
  less what four of as many bins of noise would hold. The line lies at 57 Hz: the blade passing
  of two blades at 88.5 turns/s, 177 Hz, seen at 120 Hz;
- the colour of the rest: coefficient of a moving average of order one from the correlation of
  neighbouring samples.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import butter, periodogram, sosfiltfilt

from companion.core.errors import InputError
from companion.core.messages import Array
from sim.vehicle.params import GRAVITY_M_S2

RATE_HZ = 120.0
CORNER_HZ = 8.0
SENSORS = ("imu1", "imu2", "imu3", "imu4")
EDGE = 120  # samples left out at both ends: the filters settle


@dataclass(frozen=True)
class Fit:
    """Figures of the frame; lateral: body x and y together."""

    windows: int
    accel_rms_m_s2: tuple[float, float]  # lateral, vertical
    gyro_rms_rad_s: tuple[float, float]  # about lateral axes, about the vertical
    speed_exponent: float
    scatter: float  # of log rms about the fit
    tone_share: tuple[float, float, float, float]  # accel lateral, vertical, gyro lateral, vertical
    colour: float


def fit(directory: Path) -> Fit:
    """Figures from every flight in the directory; raises InputError if there is none."""
    recordings = [r for path in sorted(directory.glob("*.npz")) for r in _recordings(path)]
    if not recordings:
        raise InputError("holds no recording", file=str(directory), valid="*.npz of imu_rtk_quadrotor_ansfl")
    windows = np.concatenate([_windows(r) for r in recordings])
    force, rms = windows[:, 0], windows[:, 1:]
    hover = np.abs(force / GRAVITY_M_S2 - 1.0) < 0.1
    level = np.sqrt(np.mean(rms[hover] ** 2, axis=0))
    exponent, scatter = _speed_exponent(force, np.linalg.norm(rms[:, :3], axis=1))
    share = np.mean(np.concatenate([_tone_share(r) for r in recordings]), axis=0)
    return Fit(
        windows=len(windows),
        accel_rms_m_s2=(_lateral(level[:3]), float(level[2])),
        gyro_rms_rad_s=(_lateral(level[3:]), float(level[5])),
        speed_exponent=exponent,
        scatter=scatter,
        tone_share=(
            float(share[:2].mean()),
            float(share[2]),
            float(share[3:5].mean()),
            float(share[5]),
        ),
        colour=_colour(float(np.mean([_neighbour_correlation(r) for r in recordings]))),
    )


def _recordings(path: Path) -> list[Array]:
    """Accelerations, m/s2, and rates, rad/s, (N, 6), of each sensor that ran for 5 s."""
    found = []
    with np.load(path) as data:
        for name in SENSORS:
            if name in data and len(data[name]) > 5 * RATE_HZ:
                samples = data[name][:, 4:10].astype(np.float64)
                samples[:, 3:] = np.radians(samples[:, 3:])
                found.append(samples)
    return found


def _high(samples: Array) -> Array:
    filtered: Array = sosfiltfilt(butter(4, CORNER_HZ, "high", fs=RATE_HZ, output="sos"), samples, axis=0)
    return filtered[EDGE:-EDGE]


def _windows(samples: Array, size: int = 60) -> Array:
    """Rows of mean specific force and six rms values."""
    slow = sosfiltfilt(butter(2, 3.0, "low", fs=RATE_HZ, output="sos"), samples[:, :3], axis=0)
    force = np.linalg.norm(slow, axis=1)[EDGE:-EDGE]
    count = len(force) // size
    fast = _high(samples)[: count * size].reshape(count, size, 6)
    return np.column_stack([force[: count * size].reshape(count, size).mean(axis=1), fast.std(axis=1)])


def _speed_exponent(force: Array, rms: Array) -> tuple[float, float]:
    """Exponent on rotor speed and scatter; thrust goes with the square of the speed."""
    use = (force > 6.0) & (force < 16.0)
    speed = 0.5 * np.log(force[use] / GRAVITY_M_S2)
    slope, offset = np.polyfit(speed, np.log(rms[use]), 1)
    return float(slope), float(np.std(np.log(rms[use]) - slope * speed - offset))


def _tone_share(samples: Array, size: int = 240, lines: int = 4) -> Array:
    """Per window and axis: excess share of power in the strongest bins above the corner."""
    fast = _high(samples)
    windows = fast[: len(fast) // size * size].reshape(-1, size, 6)
    frequency, power = periodogram(windows, RATE_HZ, window="hann", axis=1)
    power = np.sort(power[:, frequency > CORNER_HZ], axis=1)
    noise = _share_of_noise(power.shape[1], lines)
    share = power[:, -lines:].sum(axis=1) / power.sum(axis=1)
    excess: Array = np.maximum((share - noise) / (1.0 - noise), 0.0)
    return excess


def _share_of_noise(bins: int, lines: int) -> float:
    """What the strongest bins of white noise hold under the same window, from a fixed seed."""
    noise = np.random.default_rng(0).standard_normal((500, 240))
    _, power = periodogram(noise, RATE_HZ, window="hann", axis=1)
    power = np.sort(power[:, -bins:], axis=1)
    return float(np.mean(power[:, -lines:].sum(axis=1) / power.sum(axis=1)))


def _neighbour_correlation(samples: Array) -> float:
    """Correlation of neighbours in the vertical acceleration, which holds the least tone."""
    fast = _high(samples)[:, 2]
    return float(fast[1:] @ fast[:-1] / (fast @ fast))


def _colour(correlation: float) -> float:
    """c of y[k] = w[k] - c w[k-1], from r = -c / (1 + c^2); at most 1."""
    r = min(max(-correlation, 0.0), 0.5)
    return 0.0 if r == 0.0 else (1.0 - math.sqrt(1.0 - 4.0 * r * r)) / (2.0 * r)


def _lateral(axes: Array) -> float:
    return float(np.sqrt(np.mean(axes[:2] ** 2)))


if __name__ == "__main__":
    print(fit(Path(sys.argv[1])))
