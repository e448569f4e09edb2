"""Figures of the tracking bench on flights whose errors are known."""

import numpy as np
import pytest

from companion.core.errors import InputError
from companion.runtime.bench.tracking import target_rmse_m
from companion.runtime.bench.tracking_courses import ACCEL, slalom
from companion.runtime.bench.tracking_flight import Flown
from companion.runtime.bench.tracking_lookahead import LookaheadRow, best_of, course_of, course_of_file
from companion.runtime.bench.tracking_score import Score, along_and_across, score


def flown_along(course, offset, *, past_m=0.0):
    """A flight that follows a course exactly, moved by `offset` (3,), at its speeds, 50 Hz."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course.points, axis=0), axis=1))])
    s, places = 0.01, []
    while s < along[-1] - 0.01:
        places.append([np.interp(s, along, course.points[:, k]) for k in range(3)])
        s += 0.02 * max(float(np.interp(s, along, course.speeds)), 0.05)
    end = course.points[-1] + past_m * np.array([1.0, 0.0, 0.0])
    p = np.vstack([places, end]) + offset
    t = 0.02 * np.arange(len(p))
    return Flown(
        course=course, time_s=t, p_true=p, v_true=np.gradient(p, t, axis=0), setpoint_s=t, setpoint_p=p,
        setpoint_v=np.gradient(p, t, axis=0), setpoint_a=0 * p, p_map=p - offset, clearance_m=1.0, contact="",
        ended=True,
    )  # fmt: skip


def figures(**changes):
    known = score(flown_along(slalom(top_m_s=4.0), np.zeros(3)))
    return Score(**{name: changes.get(name, getattr(known, name)) for name in known.__struct_fields__})


def test_an_exact_flight_scores_zero_and_a_shift_upwards_its_size():
    course = slalom(top_m_s=4.0)
    exact, shifted = (score(flown_along(course, np.array([0.0, 0.0, up]))) for up in (0.0, 0.1))
    assert exact.rmse_m == pytest.approx(0.0, abs=1e-3) and exact.past_end_m == 0.0
    assert abs(exact.late_s) < 0.1 and exact.mean_m_s == pytest.approx(3.8, abs=0.3)
    assert shifted.rmse_m == pytest.approx(0.1, abs=1e-3) and shifted.worst_m == pytest.approx(0.1, abs=1e-3)
    assert shifted.rmse_estimate_m == pytest.approx(0.0, abs=1e-3)


def test_the_overshoot_is_what_lies_beyond_the_end():
    assert score(flown_along(slalom(top_m_s=4.0), np.zeros(3), past_m=0.3)).past_end_m == pytest.approx(0.3, abs=0.01)


def test_the_nearest_place_stays_on_its_lane_and_knows_the_side():
    x = np.arange(0.0, 20.0, 0.1)
    points = np.vstack([np.column_stack([x, 0 * x, 0 * x]), np.column_stack([x[::-1], 0 * x + 1.0, 0 * x])])
    s, off, side = along_and_across(points, np.column_stack([x[:150], 0 * x[:150] + 0.6, 0 * x[:150]]))
    assert np.allclose(s, x[:150]) and np.allclose(off, 0.6) and np.all(side > 0)


@pytest.mark.parametrize("top", [2.0, 8.0])
def test_courses_keep_their_limits(top):
    course = slalom(top_m_s=top)
    steps = np.linalg.norm(np.diff(course.points, axis=0), axis=1)
    assert course.speeds.max() <= top + 1e-9 and course.speeds[-1] == 0.0
    assert np.abs(np.diff(0.5 * course.speeds**2) / steps).max() <= ACCEL + 1e-6
    assert np.ptp(steps) < 1e-3


def test_targets():
    assert [target_rmse_m(v) for v in (2.0, 4.0, 6.0, 8.0, 12.0)] == [0.06, 0.06, 0.08, 0.1, 0.1]


def test_the_best_lookahead_is_smooth_before_it_is_near():
    def row(ahead, **changes):
        return LookaheadRow(
            course="c", method="preview", lookahead_s=ahead, lookahead_m=ahead, score=figures(**changes)
        )

    rows = [
        row(0.1, rmse_m=0.01, jerk_m_s3=9.0),
        row(0.2, rmse_m=0.03, jerk_m_s3=4.0),
        row(0.3, rmse_m=0.05, jerk_m_s3=3.5),
        row(0.4, rmse_m=0.001, jerk_m_s3=1.0, ended=False),
    ]
    assert best_of(rows).lookahead_s == 0.2


def test_a_file_becomes_a_course_over_the_start(tmp_path):
    file = tmp_path / "way.csv"
    file.write_text("x,y,z\n10,5,1\n20,5,1\n20,15,1\n")
    course = course_of_file(file, top_m_s=3.0)
    assert np.allclose(course.points[0], [0.0, 0.0, 3.0], atol=1e-6)
    assert np.allclose(course.points[-1], [10.0, 10.0, 3.0], atol=1e-6)


@pytest.mark.parametrize("text", ["", "a,b,c\n", "1,2\n3,4\n", "0,0,1\n1,0,1\n"])
def test_files_that_are_no_ways_are_refused(tmp_path, text):
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(InputError):
        course_of_file(file, top_m_s=3.0)


def test_a_recorded_way_is_rounded():
    square = np.array([[0, 0, 2], [8, 0, 2], [8, 8, 2], [0, 8, 2]], float)
    course = course_of("square", square, top_m_s=3.0)
    turn = np.diff(np.unwrap(np.arctan2(*np.diff(course.points[:, :2], axis=0).T[::-1])))
    assert np.abs(turn).max() < 0.5
