import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

sys.path.insert(0, str(Path(__file__).parent))  # importlib mode keeps helpers off the path
from fake_flight import FakeFlight

from companion.core import topics
from companion.core.geometry import quaternion_from_yaw, rotate
from companion.core.messages import PROVEN
from companion.mission.config import MissionConfig

HEAD = "version: 1\nname: test\n"


def mission(*steps, head=HEAD, land="{do: land}"):
    lines = ["{do: takeoff, alt: 2, id: up}", *steps, land]
    return head + "steps:\n" + "".join(f"  - {line}\n" for line in lines)


GO = "{do: goto, at: [8, 0, 2], id: go}"
SURVEY = "{do: survey, id: lanes, area: [[-9, -6], [9, -6], [9, 6], [-9, 6]], spacing: 4}"


def test_a_flight_is_offboard_arm_takeoff_steps_land():
    flight = FakeFlight(mission(GO))
    assert flight.until_over().state == "done"
    assert flight.commands == ["offboard", "arm", "land"]
    assert [g.kind for g in flight.goals] == ["takeoff", "fly", "land"]
    np.testing.assert_allclose(flight.goals[0].p_odom, [0, 0, 2])
    np.testing.assert_allclose(flight.goals[1].p_odom, [8, 0, 2])
    assert not flight.armed and flight.landed
    steps = [s.step_id for s in flight.of(topics.MISSION)]
    assert list(dict.fromkeys(steps)) == ["up", "go", "land_2"]
    assert [g.id for g in flight.goals] == [1, 2, 3]


@pytest.mark.parametrize("heading", [0.0, 2.0, -3.1])
def test_a_takeoff_turns_about_unless_told_not_to(heading):
    for step, turns in (("{do: takeoff, alt: 2}", True), ("{do: takeoff, alt: 2, turn: false}", False)):
        flight = FakeFlight(f"{HEAD}steps:\n  - {step}\n  - {{do: land}}\n")
        flight.yaw = heading
        while not flight.goals:
            flight.tick()
        turn = (flight.goals[0].yaw - heading + np.pi) % (2 * np.pi) - np.pi
        assert turn == pytest.approx(3.0) if turns else np.isnan(turn)


def test_it_waits_until_the_vehicle_is_ready_and_says_why():
    flight = FakeFlight(mission(GO), ready_ns=5_000_000_000)
    flight.run(4.9)
    assert flight.commands == [] and flight.status.state == "waiting"
    assert "not ready" in flight.status.reason
    assert flight.until_over().state == "done"


def test_waiting_has_an_end():
    flight = FakeFlight(mission(GO), ready_ns=10**18)
    assert flight.until_over().state == "failed"
    assert "not ready after 60 s" in flight.status.reason and flight.commands == []


@pytest.mark.parametrize("kind", ["offboard", "arm"])
def test_a_refusal_is_repeated_a_bounded_number_of_times(kind):
    flight = FakeFlight(mission(GO), refuse=(kind,), config=MissionConfig(command_attempts=4))
    assert flight.until_over().state == "failed"
    assert flight.commands.count(kind) == 4
    assert flight.status.reason == f"the autopilot refuses to {kind}: denied"
    assert flight.goals == []


def test_status_comes_at_two_hertz_even_after_the_end():
    flight = FakeFlight(mission(GO))
    flight.until_over()
    before = len(flight.of(topics.MISSION))
    flight.run(10.0)
    assert 19 <= len(flight.of(topics.MISSION)) - before <= 21
    assert flight.status.state == "done"


@pytest.mark.parametrize("at_s", [1.0, 4.0])
def test_the_pilot_is_never_overruled(at_s):
    flight = FakeFlight(mission(GO, SURVEY))
    flight.run(at_s)
    commands = len(flight.commands)
    flight.mode = "POSCTL"
    flight.run(5.0)
    flight.mode = "OFFBOARD"  # the pilot gives it back: still nothing
    flight.run(30.0)
    assert len(flight.commands) == commands
    assert flight.status.state == "failed" and "pilot took over: mode POSCTL" in flight.status.reason
    assert flight.goals[-1].kind == "hold"


def test_the_pilot_may_take_over_the_landing():
    flight = FakeFlight(mission(GO))
    while "land" not in flight.commands:
        flight.tick()
    flight.tick()
    flight.mode = "MANUAL"
    flight.run(20.0)
    assert flight.commands.count("land") == 1
    assert "pilot took over: mode MANUAL, not LAND" in flight.status.reason


def test_motors_off_in_the_air_is_a_failure():
    flight = FakeFlight(mission(GO))
    flight.run(3.0)
    flight.armed = False
    flight.run(1.0)
    assert flight.status.state == "failed" and flight.status.reason == "disarmed in flight"


def test_map_goals_follow_the_newest_correction():
    """p_map = R p_odom + t must hold for each goal with the correction of its time."""
    flight = FakeFlight(mission("{do: goto, at: [5, 1, 2]}", "{do: goto, at: [5, 1, 3]}"))
    while len(flight.goals) < 2:
        flight.tick()
    np.testing.assert_allclose(flight.goals[1].p_odom, [5, 1, 2])
    flight.p_map_odom, flight.yaw_map_odom = (1.0, -2.0, 0.5), 0.3
    while len(flight.goals) < 3:
        flight.tick()
    back = rotate(quaternion_from_yaw(0.3), flight.goals[2].p_odom)
    np.testing.assert_allclose(back, np.array([5, 1, 3]) - [1.0, -2.0, 0.5], atol=1e-12)


def test_a_body_goal_is_ahead_of_the_vehicle():
    flight = FakeFlight(mission("{do: goto, at: [3, 0, 0], frame: body, yaw: hold}"))
    flight.yaw = np.pi / 2
    flight.until_over()
    np.testing.assert_allclose(flight.goals[1].p_odom - flight.goals[0].p_odom, [0, 3, 0], atol=0.4)
    assert flight.goals[1].yaw == pytest.approx(np.pi / 2)


def test_home_is_where_it_armed_and_return_home_goes_there():
    flight = FakeFlight(mission(GO, land="{do: return_home}"))
    flight.p = np.array([3.0, 4.0, 0.0])
    assert flight.until_over().state == "done"
    np.testing.assert_allclose(flight.goals[1].p_odom, [11, 4, 2])
    np.testing.assert_allclose(flight.p, [3, 4, 0], atol=0.5)
    assert flight.goals[2].agl_m == 2.0


def test_survey_goals_look_ahead_and_stop_only_at_turns():
    flight = FakeFlight(mission(SURVEY))
    assert flight.until_over().state == "done"
    goals = [g for g in flight.goals if g.kind == "fly"]
    assert len(goals) == 3 * 3  # each lane of 18 m in two stretches: start, middle, end
    assert [g.fly_through for g in goals] == [False, True, False] * 3
    for k, goal in enumerate(goals[:-3]):
        np.testing.assert_allclose(goal.next_p_odom, [g.p_odom for g in goals[k + 1 : k + 4]])
    assert all(g.agl_m == 2.0 for g in goals)


def test_blocked_survey_goals_are_skipped():
    flight = FakeFlight(mission(SURVEY), blocked=frozenset({3, 4}))
    assert flight.until_over().state == "done"
    assert sum(w.startswith("skip goal") for w in flight.whys) == 2


def test_a_survey_without_any_reachable_goal_fails():
    flight = FakeFlight(mission(SURVEY), blocked=frozenset(range(2, 11)))
    assert flight.until_over().state == "failed"
    assert "no goal could be reached" in flight.status.reason
    assert flight.landed and not flight.armed


@pytest.mark.parametrize(
    ("rule", "state", "what"),
    [
        ("{do: retry, retries: 2, then: skip}", "done", "retry 2"),
        ("{do: retry, retries: 2, then: land_here}", "failed", "land here"),
        ("{do: skip}", "done", "skip go"),
        ("{do: hold}", "failed", "no pilot within"),
        ("{do: return_home}", "failed", "return home"),
        ("{do: land_here}", "failed", "land here"),
        ("{do: abort}", "failed", "abort"),
    ],
)
def test_on_fail_does_what_it_says_and_ends_on_the_ground(rule, state, what):
    text = mission(f"{{do: goto, at: [8, 0, 2], id: go, on_fail: {rule}}}")
    flight = FakeFlight(text, blocked=frozenset({2, 3, 4}) if "retry" in rule else frozenset({2}))
    assert flight.until_over().state == state
    assert any(what in w for w in flight.whys), flight.whys
    assert flight.landed and not flight.armed
    retries = sum(w.startswith("retry") for w in flight.whys)
    assert retries == (2 if "retry" in rule else 0)


def test_a_proof_that_there_is_no_way_is_acted_on_at_once():
    text = mission("{do: goto, at: [8, 0, 2], id: go, on_fail: {do: land_here}}")
    spent = []
    for reason in (f"{PROVEN}: no free cells lead to the goal", "no route found 5 times in a row"):
        flight = FakeFlight(text, blocked=frozenset({2}), reason=reason)
        assert flight.until_over().state == "failed"
        (asked,) = (now_s for now_s, name, sent in flight.said if name == topics.GOAL.name and sent.id == 2)
        acted = [now_s for now_s, name, sent in flight.said if name == topics.WHY.name and "land here" in sent.what]
        spent.append(acted[0] - asked)
    assert spent[0] < 1.0 and spent[1] > 10.0


def test_a_retry_can_succeed():
    text = mission("{do: goto, at: [8, 0, 2], id: go, on_fail: {do: retry, retries: 3}}")
    flight = FakeFlight(text, blocked=frozenset({2, 3}))
    assert flight.until_over().state == "done"


def test_no_progress_and_timeouts_end_a_step():
    slow = FakeFlight(mission("{do: goto, at: [300, 0, 2], id: go, timeout_s: 20, on_fail: {do: land_here}}"))
    assert slow.until_over().state == "failed" and "timeout" in slow.status.reason
    stuck = FakeFlight(mission(GO), frozen=frozenset({2}))
    assert stuck.until_over().state == "failed" and "no progress for 12 s" in stuck.status.reason
    assert not stuck.armed


def test_a_takeoff_that_stays_on_the_ground_gives_up_there():
    flight = FakeFlight(mission(GO), frozen=frozenset({1}))
    assert flight.until_over().state == "failed"
    assert [g.kind for g in flight.goals] == ["takeoff", "land"]
    assert not flight.armed


def test_battery_reserve_and_time_limit_bring_it_home():
    head = HEAD + "failsafe: {battery: {reserve: 0.3}, time_limit_s: 60}\n"
    low = FakeFlight(mission(SURVEY, head=head))
    low.run(10.0)
    low.battery = 0.29
    assert low.until_over().state == "failed" and "battery 29% is below" in low.status.reason
    assert np.hypot(*low.p[:2]) < 0.5
    late = FakeFlight(mission(SURVEY, head=head))
    for guard, seconds in [("hold", 9.0), ("ok", 2.0)] * 6:  # never stuck for 12 s, but late
        late.safety = guard
        late.run(seconds)
    assert late.until_over().state == "failed" and "time limit" in late.status.reason


def test_safety_land_lands_at_once():
    flight = FakeFlight(mission(SURVEY))
    flight.run(10.0)
    flight.safety = "land"
    flight.tick()
    assert flight.commands[-1] == "land"
    assert flight.until_over().state == "failed" and flight.status.reason == "test"


def test_it_does_not_start_while_safety_holds():
    flight = FakeFlight(mission(GO))
    flight.safety = "hold"
    flight.run(5.0)
    assert flight.commands == []


def test_a_refused_landing_is_asked_a_bounded_number_of_times():
    flight = FakeFlight(mission(GO), refuse=("land",))
    assert flight.until_over().state == "failed"
    assert flight.commands.count("land") == 6
    assert "refuses to land" in flight.status.reason


def test_a_body_goal_outside_the_fence_is_refused_in_flight():
    head = HEAD + "geofence: {inside: [[-9, -9], [9, -9], [9, 9], [-9, 9]], alt: [-2, 6]}\n"
    text = mission("{do: goto, at: [20, 0, 0], frame: body, on_fail: {do: land_here}}", head=head)
    flight = FakeFlight(text)
    assert flight.until_over().state == "failed"
    assert "11.0 m outside the fence" in flight.status.reason
    assert [g.kind for g in flight.goals] == ["takeoff", "land"]


def test_the_same_flight_says_the_same():
    said = []
    for _ in range(2):
        flight = FakeFlight(mission(SURVEY), blocked=frozenset({3}))
        flight.until_over()
        said.append([(t, name, repr(message)) for t, name, message in flight.said])
    assert said[0] == said[1]


@settings(max_examples=40, deadline=None)
@given(
    st.frozensets(st.integers(1, 12), max_size=8),
    st.frozensets(st.integers(1, 12), max_size=8),
    st.sampled_from(["retry", "skip", "hold", "return_home", "land_here", "abort"]),
    st.lists(st.tuples(st.sampled_from(["ok", "slow", "hold"]), st.floats(0.5, 15)), max_size=5),
)
def test_whatever_fails_it_never_hovers_for_ever(blocked, frozen, action, guards):
    """Law: every mission ends, within a bound, on the ground and disarmed."""
    text = mission(f"{{do: goto, at: [5, 0, 2], on_fail: {{do: {action}}}}}", SURVEY, land="{do: return_home}")
    flight = FakeFlight(text, blocked=blocked, frozen=frozen)
    for guard, seconds in guards:
        flight.safety = guard
        flight.run(seconds)
    flight.safety = "ok"
    assert flight.until_over(900.0).state in ("done", "failed")
    assert flight.landed and not flight.armed
    assert flight.status.state == "done" or flight.status.reason
