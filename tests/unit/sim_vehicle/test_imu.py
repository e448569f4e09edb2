"""The IMU against its own figures: Allan deviation, bias walk, vibration, limits."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from companion.core.errors import InputError
from sim.sensors.fit_vibration import fit
from sim.sensors.imu import Imu, ImuConfig, load_vibration

REST = np.array([0.0, 0.0, 9.80665])
QUIET = msgspec.structs.replace(load_vibration(), isolation=0.0)
DATA = Path(__file__).resolve().parents[4] / "shared" / "data" / "imu_rtk_quadrotor_ansfl"


def record(config: ImuConfig, count: int, *, rotor: float = 0.0, seed: int = 1, stream: int = 0) -> np.ndarray:
    """(N, 6): specific force and rate at rest."""
    imu = Imu(config, seed=seed, hover_speed_rad_s=566.0, stream=stream)
    speeds, zero = rotor + np.array([0.0, 7.0, -4.0, -3.0]) * (rotor > 0), np.zeros(3)
    rows = [imu.sample(k * 5_000_000, REST, zero, speeds) for k in range(count)]
    return np.array([np.r_[s.specific_force_body, s.angular_velocity_body] for s in rows])


def allan_deviation(y: np.ndarray, size: int) -> np.ndarray:
    """Overlapping not needed: means of neighbouring clusters of `size` samples."""
    means = y[: len(y) // size * size].reshape(-1, size, y.shape[1]).mean(axis=1)
    return np.sqrt(0.5 * np.mean(np.diff(means, axis=0) ** 2, axis=0))


def test_allan_deviation_shows_the_white_noise() -> None:
    config = ImuConfig(vibration=QUIET)
    y = record(config, 60_000)  # 300 s
    density = np.repeat([config.accel_noise_m_s2_sqrt_hz, config.gyro_noise_rad_s_sqrt_hz], 3)
    for size in (1, 10, 40):
        tau = size / config.rate_hz
        np.testing.assert_allclose(allan_deviation(y, size), density / np.sqrt(tau), rtol=0.1)


def test_allan_deviation_shows_the_bias_walk() -> None:
    config = ImuConfig(vibration=QUIET, accel_noise_m_s2_sqrt_hz=0.0, gyro_noise_rad_s_sqrt_hz=0.0)
    y = record(config, 100_000)
    walk = np.repeat([config.accel_bias_walk_m_s2_sqrt_s, config.gyro_bias_walk_rad_s_sqrt_s], 3)
    for size in (200, 1000):
        ratio = allan_deviation(y, size) / (walk * np.sqrt(size / config.rate_hz / 3))
        assert np.all((ratio > 0.7) & (ratio < 1.4))


def test_initial_bias_has_its_deviation() -> None:
    config = ImuConfig()
    imus = [Imu(config, seed=s, hover_speed_rad_s=566.0) for s in range(300)]
    assert np.std([i.accel_bias_body for i in imus]) == pytest.approx(config.accel_bias_m_s2, rel=0.1)
    assert np.std([i.gyro_bias_body for i in imus]) == pytest.approx(config.gyro_bias_rad_s, rel=0.1)


def silent(**vibration: float) -> ImuConfig:
    return ImuConfig(
        accel_noise_m_s2_sqrt_hz=0.0,
        gyro_noise_rad_s_sqrt_hz=0.0,
        accel_bias_m_s2=0.0,
        gyro_bias_rad_s=0.0,
        accel_bias_walk_m_s2_sqrt_s=0.0,
        gyro_bias_walk_rad_s_sqrt_s=0.0,
        vibration=msgspec.structs.replace(load_vibration(), **vibration),
    )


def test_vibration_has_the_strength_of_the_file() -> None:
    v = load_vibration()
    shake = record(silent(), 20_000, rotor=566.0).std(axis=0)
    frame = [v.accel_lateral_m_s2] * 2 + [v.accel_vertical_m_s2]
    frame += [v.gyro_lateral_rad_s] * 2 + [v.gyro_vertical_rad_s]
    np.testing.assert_allclose(shake, v.isolation * np.array(frame), rtol=0.05)
    assert 0.3 < np.linalg.norm(shake[:3]) < 0.5  # m/s2


def test_vibration_dies_with_the_rotors() -> None:
    np.testing.assert_array_equal(record(silent(), 50), np.tile(np.r_[REST, 0, 0, 0], (50, 1)))
    slow, slower = (record(silent(), 4000, rotor=w).std(axis=0)[2] for w in (280.0, 140.0))
    assert slow / slower == pytest.approx(4.0, rel=0.1)


def test_tone_lies_at_the_aliased_blade_passing_frequency() -> None:
    pure = silent(tone_share_gyro_vertical=1.0)
    w = 566.0
    y = record(pure, 4000, rotor=w)[:, 5]
    spectrum = np.abs(np.fft.rfft(y * np.hanning(len(y))))
    peak = np.fft.rfftfreq(len(y), 1 / 200.0)[np.argmax(spectrum)]
    blade = 2 * w / (2 * np.pi)  # 180.2 Hz
    assert peak == pytest.approx(abs(blade - 200.0), abs=3.0)


def test_saturates_and_offsets_its_clock() -> None:
    imu = Imu(ImuConfig(clock_offset_us=150.0), seed=1, hover_speed_rad_s=566.0)
    s = imu.sample(1_000_000, np.array([0, 0, 1e4]), np.array([0, -1e3, 0.0]), np.zeros(4))
    assert s.specific_force_body[2] == imu.config.accel_max_m_s2
    assert s.angular_velocity_body[1] == -imu.config.gyro_max_rad_s
    assert s.stamp_ns == 1_150_000


def test_bias_step_moves_the_readings() -> None:
    imu, zero = Imu(silent(isolation=0.0), seed=1, hover_speed_rad_s=566.0), np.zeros(3)
    imu.step_bias(np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, 0.02]))
    s = imu.sample(0, REST, zero, np.zeros(4))
    np.testing.assert_allclose(s.specific_force_body, [0.5, 0.0, 9.80665])
    np.testing.assert_allclose(s.angular_velocity_body, [0, 0, 0.02])


def test_same_seed_same_bytes_and_streams_differ() -> None:
    a, b, c = (record(ImuConfig(), 600, rotor=566.0, stream=s) for s in (0, 0, 1))
    assert a.tobytes() == b.tobytes() != c.tobytes()


def test_unknown_key_in_the_vibration_file(tmp_path: Path) -> None:
    path = tmp_path / "imu.toml"
    path.write_text("accel_lateral_m_s2 = 1.0\nwobble = 2.0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"imu\.toml"):
        load_vibration(path)


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not on this machine")
def test_file_holds_what_the_real_flights_give() -> None:
    v, real = load_vibration(), fit(DATA)
    assert (v.accel_lateral_m_s2, v.accel_vertical_m_s2) == pytest.approx(real.accel_rms_m_s2, rel=0.01)
    assert (v.gyro_lateral_rad_s, v.gyro_vertical_rad_s) == pytest.approx(real.gyro_rms_rad_s, rel=0.01)
    assert v.speed_exponent == pytest.approx(real.speed_exponent, abs=0.01)
    shares = (
        v.tone_share_accel_lateral, v.tone_share_accel_vertical,
        v.tone_share_gyro_lateral, v.tone_share_gyro_vertical,
    )  # fmt: skip
    assert shares == pytest.approx(real.tone_share, abs=0.01)
    assert v.colour == real.colour
