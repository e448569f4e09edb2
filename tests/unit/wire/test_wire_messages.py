"""Every topic's message through CDR and back: bit for bit where the ROS type can hold it."""

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.core import messages as m
from companion.core import topics
from companion.core.errors import InputError
from companion.core.node import Topic
from companion.runtime.wire import Codec, WireError, codec_of, wire_type

STAMP = 1_764_000_000_123_456_789
OWN = [t for t in topics.ALL if t.ros_type.startswith("understory_msgs/")]


def same(a: Any, b: Any) -> None:
    """Bit for bit, and of the same types."""
    assert type(a) is type(b)
    if dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            same(getattr(a, field.name), getattr(b, field.name))
    elif isinstance(a, np.ndarray):
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        assert b.flags.c_contiguous and b.flags.aligned and not b.flags.writeable
    elif isinstance(a, float):
        assert math.copysign(1, a) == math.copysign(1, b) and (a == b or (math.isnan(a) and math.isnan(b)))
    else:
        assert a == b


@pytest.mark.parametrize("topic", OWN, ids=lambda t: t.name)
def test_own_messages_round_trip(topic: Topic[Any], random_message: Any) -> None:
    codec, rng = codec_of(topic), np.random.default_rng(3)
    for _ in range(5):
        message = random_message(topic.type, rng)
        payload = codec.encode(message)
        same(message, codec.decode(payload))
        same(message, codec.decode(memoryview(bytearray(payload))))
        assert codec.encode(codec.decode(payload)) == payload


@pytest.mark.parametrize("topic", OWN, ids=lambda t: t.name)
def test_text_and_class_have_the_same_fields(topic: Topic[Any]) -> None:
    named = [f.name for f in dataclasses.fields(topic.type)]
    wire = [n for n in wire_type(topic.ros_type).field_names if n != "shape"]
    assert wire == ["header", *named[1:]] and named[0] == "stamp_ns"


def test_quaternions_are_xyzw_on_the_wire_and_frames_are_named(random_message: Any) -> None:
    message = random_message(m.GroundTruth, np.random.default_rng(1))
    value = codec_of(topics.TRUTH).type.decode(codec_of(topics.TRUTH).encode(message))
    q = value["q_world_body"]
    np.testing.assert_array_equal([q["w"], q["x"], q["y"], q["z"]], message.q_world_body)
    assert value["header"]["frame_id"] == "world"
    assert value["header"]["stamp"] == dict(zip(("sec", "nanosec"), divmod(message.stamp_ns, 10**9), strict=True))


def test_a_word_that_is_no_choice_is_refused() -> None:
    codec = codec_of(topics.SAFETY)
    with pytest.raises(WireError, match=r"action: 'run' .valid: ok, slow, hold, land"):
        codec.decode(codec.type.encode({"action": "run"}))


def test_grids_must_have_their_shape() -> None:
    codec = codec_of(topics.LOCAL_MAP)
    with pytest.raises(WireError, match="cannot reshape"):
        codec.decode(codec.type.encode({"shape": [1, 2, 3], "state": bytes(5)}))


def test_a_stamp_beyond_2038_is_a_clear_error() -> None:
    message = m.RangeReading(stamp_ns=2**31 * 10**9, range_m=1.0)
    with pytest.raises(InputError, match=r"header\.stamp\.sec: 2147483648 is no int32"):
        codec_of(topics.RANGE).encode(message)


def test_a_type_that_nothing_carries() -> None:
    with pytest.raises(InputError, match=r"nothing carries Setpoint as sensor_msgs/msg/Imu .*ImuSample"):
        codec_of(Topic("x", m.Setpoint, 1.0, ros_type="sensor_msgs/msg/Imu"))


def there_and_back(topic: Topic[Any], message: Any) -> Any:
    codec = codec_of(topic)
    return codec.decode(codec.encode(message))


def test_imu_says_that_it_has_no_orientation() -> None:
    rng = np.random.default_rng(0)
    sample = m.ImuSample(
        stamp_ns=STAMP, angular_velocity_body=rng.normal(size=3), specific_force_body=rng.normal(size=3)
    )
    same(m.freeze(sample), there_and_back(topics.IMU, sample))
    value = codec_of(topics.IMU).type.decode(codec_of(topics.IMU).encode(sample))
    assert value["orientation_covariance"][0] == -1 and value["header"]["frame_id"] == "base_link"


@pytest.mark.parametrize("shape", [(3, 5), (0, 0), (240, 320)])
def test_image_round_trip(shape: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    image = m.freeze(m.CameraImage(stamp_ns=STAMP, pixels=pixels))
    same(image, there_and_back(topics.CAMERA, image))
    same(image, there_and_back(topics.CAMERA, m.CameraImage(stamp_ns=STAMP, pixels=np.asfortranarray(pixels))))


@pytest.mark.parametrize("order", ["rgb", "bgr", "rgba", "bgra"])
def test_colour_images_become_grey(order: str) -> None:
    rng = np.random.default_rng(0)
    colour = {c: rng.integers(0, 256, (4, 6)) for c in "rgba"}
    packed = np.stack([colour[c] for c in order], axis=-1).astype(np.uint8)
    padded = np.zeros((4, 6 * len(order) + 3), np.uint8)
    padded[:, :-3] = packed.reshape(4, -1)
    grey = _decode_image(encoding=f"{order}8", height=4, width=6, step=padded.shape[1], data=padded.ravel())
    expected = 0.299 * colour["r"] + 0.587 * colour["g"] + 0.114 * colour["b"]
    assert np.abs(grey.pixels - expected).max() <= 1.5


def _decode_image(**value: Any) -> m.CameraImage:
    codec: Codec = codec_of(topics.CAMERA)
    image: m.CameraImage = codec.decode(codec.type.encode(value))
    return image


def test_images_that_are_none() -> None:
    with pytest.raises(WireError, match=r"encoding 'yuv422' .valid: mono8, 8UC1, rgb8"):
        _decode_image(encoding="yuv422")
    with pytest.raises(WireError, match="5 bytes are no image of 2 rows of 3 bytes"):
        _decode_image(encoding="mono8", height=2, width=3, step=3, data=bytes(5))
    with pytest.raises(WireError, match="are no image"):
        _decode_image(encoding="mono8", height=1, width=2**32 - 1, step=4, data=bytes(5))


@given(st.floats(width=32, min_value=0, allow_infinity=False) | st.just(math.nan))
def test_range_round_trip(range_m: float) -> None:
    reading = m.RangeReading(stamp_ns=STAMP, range_m=range_m)
    same(reading, there_and_back(topics.RANGE, reading))


@pytest.mark.parametrize(
    ("range_m", "expected"), [(0.1, math.nan), (5.0, 5.0), (41.0, math.nan), (-math.inf, math.nan)]
)
def test_foreign_range_outside_its_limits_is_none(range_m: float, expected: float) -> None:
    codec = codec_of(topics.RANGE)
    for limits, valid in (({"min_range": 0.25, "max_range": 40.0}, expected), ({}, range_m)):
        found = codec.decode(codec.type.encode({"range": range_m, **limits})).range_m
        wanted = valid if math.isfinite(valid) else math.nan
        np.testing.assert_allclose(found, wanted, rtol=1e-6)


def test_no_return_is_plus_infinity_on_the_wire() -> None:
    codec = codec_of(topics.RANGE)
    payload = codec.encode(m.RangeReading(stamp_ns=0, range_m=math.nan))
    assert codec.type.decode(payload)["range"] == math.inf


@given(st.floats(-500, 11_000))
def test_baro_round_trip_within_a_micrometre(altitude_m: float) -> None:
    found = there_and_back(topics.BARO, m.BaroReading(stamp_ns=STAMP, altitude_m=altitude_m))
    assert abs(found.altitude_m - altitude_m) < 1e-6


def test_baro_of_the_standard_atmosphere() -> None:
    """ISO 2533: 101325 Pa at 0 m, 89874.6 Pa at 1000 m, 54019.9 Pa at 5000 m (geopotential)."""
    codec = codec_of(topics.BARO)
    for altitude_m, pressure_pa in ((0.0, 101325.0), (1000.0, 89874.6), (5000.0, 54019.9)):
        payload = codec.encode(m.BaroReading(stamp_ns=0, altitude_m=altitude_m))
        assert codec.type.decode(payload)["fluid_pressure"] == pytest.approx(pressure_pa, rel=2e-6)
    for odd in (-1.0, math.nan, math.inf):
        assert math.isnan(codec.decode(codec.type.encode({"fluid_pressure": odd})).altitude_m)
    assert math.isnan(there_and_back(topics.BARO, m.BaroReading(stamp_ns=0, altitude_m=math.nan)).altitude_m)
    assert there_and_back(topics.BARO, m.BaroReading(stamp_ns=0, altitude_m=1e6)).altitude_m == pytest.approx(44330.77)
