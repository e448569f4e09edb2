"""IMU buffer and order of arrival."""

import numpy as np
import pytest

from companion.core.messages import ImuSample
from companion.estimation.imu_buffer import ImuBuffer
from companion.estimation.ordering import Reorder

MS = 1_000_000


def sample(stamp_ms, value=0.0):
    return ImuSample(
        stamp_ns=stamp_ms * MS,
        angular_velocity_body=np.full(3, value),
        specific_force_body=np.full(3, value),
    )


def filled(stamps=range(0, 1000, 5)):
    buffer = ImuBuffer()
    for s in stamps:
        buffer.append(sample(s, float(s)))
    return buffer


@pytest.mark.parametrize(("start", "end"), [(100, 200), (102, 199), (101, 103), (0, 995), (500, 1003)])
def test_pieces_fill_the_time_between_exactly(start, end):
    pieces = filled().between(start * MS, end * MS)
    assert pieces[:, 0].sum() == pytest.approx((end - start) * 1e-3, abs=1e-12)
    assert (pieces[:, 0] > 0).all()
    assert pieces[0, 1] == 5 * (start // 5 + 1)  # the sample whose interval holds the start


def test_pieces_join_without_overlap():
    buffer = filled()
    parts = [buffer.between(a * MS, b * MS) for a, b in ((100, 133), (133, 180), (180, 400))]
    whole = buffer.between(100 * MS, 400 * MS)
    weighted = sum((p[:, :1] * p[:, 1:]).sum(axis=0) for p in parts)
    np.testing.assert_allclose(weighted, (whole[:, :1] * whole[:, 1:]).sum(axis=0), rtol=1e-12)


def test_gaps_are_bridged_in_short_steps_between_the_samples_around_them():
    pieces = filled([0, 5, 10, 110, 115]).between(5 * MS, 115 * MS)
    assert pieces[:, 0].max() <= 0.02
    assert pieces[:, 0].sum() == pytest.approx(0.11)
    np.testing.assert_allclose(pieces[:, 1], [10, 20, 40, 60, 80, 100, 115])


def test_silence_of_all_sensors_may_be_a_clock_that_was_set_forward():
    buffer = filled([*range(0, 105, 5), *range(405, 505, 5)])
    when = (90 * MS, 450 * MS)
    assert buffer.longest_gap_s(*when) == pytest.approx(0.305)
    assert buffer.is_clock_in_doubt(*when, longer_s=0.05)
    assert not buffer.is_clock_in_doubt(150 * MS, 450 * MS, longer_s=0.05)  # another sensor spoke meanwhile
    pieces = buffer.had_the_clock_jumped(*when, longer_s=0.05)
    assert pieces[:, 0].sum() == pytest.approx(0.36 - 0.305)
    np.testing.assert_allclose(pieces[:, 1], [95, 100, *range(410, 455, 5)])


def test_time_that_was_there_twice_is_hidden_and_flown_if_the_clock_went_back():
    buffer = filled([*range(0, 505, 5), *range(200, 605, 5)])
    when = (490 * MS, 520 * MS)
    assert buffer.longest_gap_s(*when) == pytest.approx(0.305)  # from 200 to the first that is new
    assert buffer.newest_gap_s == pytest.approx(0.005)
    assert buffer.is_clock_in_doubt(*when, longer_s=0.05)
    assert not buffer.is_clock_in_doubt(510 * MS, 520 * MS, longer_s=0.05)
    pieces = buffer.had_the_clock_jumped(*when, longer_s=0.05)
    assert pieces[:, 0].sum() == pytest.approx(0.03 + 0.305)
    assert ((pieces[:, 1] >= 495) & (pieces[:, 1] <= 520)).all()


def test_late_samples_between_newer_ones_are_no_clock_that_went_back():
    buffer = ImuBuffer()
    for s in range(0, 500, 5):
        buffer.append(sample(s))
        buffer.append(sample(max(s - 15, 0)))
    assert not buffer.is_clock_in_doubt(0, 495 * MS, longer_s=0.05)
    assert buffer.longest_gap_s(0, 495 * MS) == pytest.approx(0.005)


def test_bad_samples_are_refused():
    buffer = filled([0, 5, 10])
    assert not buffer.append(sample(10))
    assert not buffer.append(sample(3))
    assert not buffer.append(sample(15, np.nan))
    assert buffer.refused == 3
    assert buffer.append(sample(15))
    assert buffer.between(20 * MS, 10 * MS).shape == (0, 7)
    assert ImuBuffer().between(0, MS).shape == (0, 7)


def test_one_wild_stamp_is_refused_but_a_real_leap_is_followed():
    buffer = filled([0, 5])
    assert not buffer.append(sample(900_000))
    assert buffer.append(sample(10))
    assert not buffer.append(sample(50_000))
    assert buffer.append(sample(50_005))


def test_the_buffer_forgets_the_oldest():
    buffer = filled(range(0, 5 * 6000, 5))
    assert len(buffer) <= 4096
    assert buffer.newest_ns == 5 * 5999 * MS
    assert not buffer.covers(0)
    assert buffer.between(29_000 * MS, 29_500 * MS)[:, 0].sum() == pytest.approx(0.5)


def order():
    return Reorder(hold_back_ns=50 * MS, periods_ns={"lidar": 100 * MS, "camera": 66 * MS})


def drain(queue, now_ms):
    out = []
    while (m := queue.take(now_ms * MS)) is not None:
        out.append(m)
    return out


def test_an_image_waits_for_the_scan_before_it():
    queue = order()
    queue.put("lidar", 100 * MS, "L100", now_ns=120 * MS)
    assert drain(queue, 120) == ["L100"]
    queue.put("camera", 202 * MS, "C202", now_ns=217 * MS)
    assert drain(queue, 217) == []  # the scan that ends at 200 is still under way
    queue.put("lidar", 200 * MS, "L200", now_ns=220 * MS)
    assert drain(queue, 220) == ["L200", "C202"]
    assert queue.dropped == 0


def test_waiting_ends_with_the_hold_back_and_a_late_scan_is_dropped():
    queue = order()
    queue.put("lidar", 100 * MS, "L100", now_ns=120 * MS)
    drain(queue, 120)
    queue.put("camera", 210 * MS, "C210", now_ns=225 * MS)
    assert drain(queue, 255) == []
    assert drain(queue, 260) == ["C210"]
    queue.put("lidar", 200 * MS, "L200", now_ns=265 * MS)
    assert queue.dropped == 1


def test_nothing_is_released_before_the_imu_reaches_it_nor_waits_for_a_dead_stream():
    queue = order()
    queue.put("camera", 66 * MS, "C66", now_ns=60 * MS)
    assert drain(queue, 65) == []
    assert drain(queue, 66) == ["C66"]  # no scan was ever heard
    queue.put("lidar", 1000 * MS, "L1000", now_ns=1000 * MS)
    assert drain(queue, 1000) == ["L1000"]  # the camera has been silent for long


def test_duplicates_backward_and_wild_stamps_are_dropped():
    queue = order()
    for stamp in (100, 100, 90, 90_000):
        queue.put("lidar", stamp * MS, f"L{stamp}", now_ns=120 * MS)
    assert queue.dropped == 3
    assert drain(queue, 200) == ["L100"]


def test_jittered_streams_come_out_sorted_and_whole():
    rng = np.random.default_rng(0)
    arrivals = [(k * 100 + rng.uniform(15, 25), "lidar", k * 100) for k in range(1, 100)]
    arrivals += [(k * 1000 / 15 + rng.uniform(10, 20), "camera", round(k * 1000 / 15)) for k in range(1, 150)]
    queue, out = order(), []
    for at, stream, stamp in sorted(arrivals):
        queue.put(stream, stamp * MS, stamp, now_ns=int(at * MS))
        out += drain(queue, at)
    out += drain(queue, 11_000)
    assert out == sorted(out)
    assert len(out) == len(arrivals)
    assert queue.dropped == 0
