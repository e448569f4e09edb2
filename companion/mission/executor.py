"""Flies a mission: one state machine, stepped by time; what it decides, it says (WHY).

wait until ready -> offboard, arm -> steps -> brake -> land -> done or failed

Everything is bounded: each wait has a limit, each failure leads to a landing or to the pilot.
"""

from __future__ import annotations

import numpy as np
from msgspec import UnsetType

from companion.core.messages import Array
from companion.core.topics import GOAL
from companion.mission.commands import Kind
from companion.mission.config import MissionConfig
from companion.mission.inputs import Inputs, missing, taken_over
from companion.mission.legs import Run
from companion.mission.phases import Outputs, Phases
from companion.mission.placing import Places
from companion.mission.route import home_leg, legs_of
from companion.mission.schema import Hover, Land, Mission, ReturnHome, Survey, Takeoff, set_or


class Executor(Phases):
    """Call `step` at 10 Hz with the newest inputs; publish what it yields, and `status`."""

    def __init__(self, mission: Mission, config: MissionConfig) -> None:
        super().__init__(mission, config)
        self._phase = self._wait

    def step(self, now_ns: int, inputs: Inputs) -> Outputs:
        """Decide once."""
        self._in = inputs
        if self._since_ns is None:
            self._since_ns = now_ns
        if self._phase not in (self._wait, self._over):
            took_over = self._taken_over()
            if took_over:
                yield from self._give_up(now_ns, took_over)
                return
            yield from self._guard(now_ns)
        yield from self._phase(now_ns)

    # --- before the flight ---------------------------------------------------------

    def _wait(self, now_ns: int) -> Outputs:
        self._reason = missing(self._in, now_ns, fresh_s=self._config.odometry_fresh_s)
        if not self._reason:
            yield self._why(now_ns, "offboard and arm", "vehicle, odometry and guards are ready")
            self._enter(self._engage, now_ns)
        elif self._elapsed_s(now_ns) > self._config.ready_timeout_s:
            limit_s = self._config.ready_timeout_s
            yield from self._finish(now_ns, f"not ready after {limit_s:g} s: {self._reason}")

    def _engage(self, now_ns: int) -> Outputs:
        vehicle = self._vehicle
        self._offboard_seen = self._offboard_seen or vehicle.mode == "OFFBOARD"
        if vehicle.mode == "OFFBOARD" and vehicle.armed:
            yield from self._start(now_ns)
            return
        kind: Kind = "arm" if vehicle.mode == "OFFBOARD" else "offboard"
        yield from self._ask(kind, now_ns)
        if "took over" in self._requests.refusal:
            yield from self._finish(now_ns, self._requests.refusal)
        elif self._requests.exhausted(now_ns):
            why = self._requests.refusal or vehicle.text or "no answer"
            yield from self._finish(now_ns, f"the autopilot refuses to {kind}: {why}")

    def _start(self, now_ns: int) -> Outputs:
        self._home = self._correction.to_map(self._odometry.p_odom)
        self._armed_ns, self._state = now_ns, "running"
        yield self._why(now_ns, f"home is map {_shown(self._home)}", "armed here")
        yield from self._begin(now_ns, 0)

    # --- guards ----------------------------------------------------------------------

    def _taken_over(self) -> str:
        """Why this is no longer our flight; '' if it is. A mode change is never re-grabbed."""
        if self._phase == self._engage:
            vehicle = self._vehicle
            lost = self._offboard_seen and vehicle.mode != "OFFBOARD"
            return f"pilot took over: mode {vehicle.mode}, not OFFBOARD" if lost else ""
        landing = self._phase == self._landing
        self._land_seen = self._land_seen or (landing and self._vehicle.mode == "LAND")
        ours = ("LAND",) if self._land_seen else ("OFFBOARD", "LAND") if landing else ("OFFBOARD",)
        return taken_over(self._in.vehicle, ours, may_disarm=landing)

    def _give_up(self, now_ns: int, reason: str) -> Outputs:
        """Stop the plan, so that a later return to OFFBOARD does not fly on by itself; command nothing."""
        yield self._stop_goal(now_ns, "hold")
        yield from self._finish(now_ns, reason)

    def _guard(self, now_ns: int) -> Outputs:
        """Land when safety says so; end the mission when battery or time run out."""
        safety, battery, failsafe = self._in.safety, self._vehicle.battery_fraction, self._mission.failsafe
        if self._phase in (self._engage, self._landing):
            return
        if safety is not None and safety.action == "land":
            yield from self._land_now(now_ns, safety.reason)
        elif self._failure:
            return
        elif 0 <= battery < failsafe.battery.reserve:
            reason = f"battery {battery:.0%} is below the reserve of {failsafe.battery.reserve:.0%}"
            yield from self._end_by(now_ns, failsafe.battery.do, reason)
        elif now_ns - self._armed_ns > failsafe.time_limit_s * 1e9:
            yield from self._end_by(now_ns, "return_home", f"time limit of {failsafe.time_limit_s:g} s")

    # --- steps -----------------------------------------------------------------------

    def _begin(self, now_ns: int, index: int) -> Outputs:
        self._index, self._retries = index, 0
        step = self._mission.steps[index]
        places = Places.at(self._odometry, self._correction, self._home)
        xy = places.p_map_start - self._home
        legs = legs_of(self._mission, step, (float(xy[0]), float(xy[1])), leg_m=self._config.leg_m)
        self._run = Run(legs, places, step, now_ns + round(self._timeouts_s[index] * 1e9))
        yield self._why(now_ns, f"step {self._mission.id_of(index)}", f"number {index + 1} is next")
        if isinstance(step, Land):
            yield from self._descend(now_ns)
        elif isinstance(step, Hover):
            self._enter(self._hover, now_ns)
            yield self._stop_goal(now_ns, "hold")
        else:
            self._enter(self._fly, now_ns)
            yield from self._send_leg(now_ns)

    def _next_step(self, now_ns: int) -> Outputs:
        step = self._mission.steps[self._index]
        if isinstance(step, ReturnHome) and step.land == "land":
            yield from self._descend(now_ns)
        elif self._index + 1 < len(self._mission.steps):
            yield from self._begin(now_ns, self._index + 1)
        else:  # only after skipping the last step
            yield from self._end_by(now_ns, "land_here", "no step left")

    def _hover(self, now_ns: int) -> Outputs:
        step = self._mission.steps[self._index]
        assert isinstance(step, Hover)
        if self._elapsed_s(now_ns) >= step.seconds:
            yield from self._next_step(now_ns)

    def _fly(self, now_ns: int) -> Outputs:
        run, plan = self._run, self._in.plan
        assert run is not None
        mine = plan if plan is not None and plan.goal_id == self._goal_id else None
        if mine is not None and mine.state == "reached":
            run.reached += 1
            yield from self._next_leg(now_ns)
            return
        stuck_s, progress_m = self._mission.failsafe.planner_stuck.after_s, self._config.progress_m
        problem = run.problem(now_ns, self._odometry.p_odom, mine, stuck_s=stuck_s, progress_m=progress_m)
        skips = isinstance(run.step, Survey) and run.step.skip_unreachable and not run.late(now_ns)
        if problem and skips:
            yield self._why(now_ns, f"skip goal {run.index + 1} of {len(run.legs)}", problem)
            yield from self._next_leg(now_ns)
        elif problem:
            yield from self._fail(now_ns, problem)

    def _next_leg(self, now_ns: int) -> Outputs:
        run = self._run
        assert run is not None
        run.index += 1
        if run.index < len(run.legs):
            yield from self._send_leg(now_ns)
        elif run.reached == 0:
            yield from self._fail(now_ns, "no goal could be reached")
        elif self._failure:
            yield from self._descend(now_ns)
        else:
            yield from self._next_step(now_ns)

    def _send_leg(self, now_ns: int) -> Outputs:
        run, fence = self._run, self._mission.fence
        assert run is not None
        p_map = run.places.p_map(run.legs[run.index])
        if fence is not None and (depth_m := fence.depth_m(p_map - self._home)) < 0:
            yield from self._fail(now_ns, f"goal {-depth_m:.1f} m outside the fence")
            return
        self._goal_id += 1
        run.begin_leg(now_ns, self._odometry.p_odom)
        limits, lookahead = self._mission.limits_of(run.step), self._config.lookahead_goals
        goal = run.goal(now_ns, self._goal_id, self._correction, limits, lookahead=lookahead)
        leg = f"leg {run.index + 1} of {len(run.legs)} of {self._mission.id_of(self._index)}"
        yield self._why(now_ns, f"goal {goal.id} at odom {_shown(goal.p_odom)}", leg)
        yield GOAL(goal)

    # --- failures --------------------------------------------------------------------

    def _fail(self, now_ns: int, reason: str) -> Outputs:
        """A step failed: retry or skip within bounds, or end the mission."""
        if self._failure:  # on the way home already
            yield from self._end_by(now_ns, "land_here", reason)
            return
        step = self._mission.steps[self._index]
        stuck = "land_here" if isinstance(step, Takeoff) else self._mission.failsafe.planner_stuck.do
        rule = step.on_fail
        action: str = stuck if isinstance(rule, UnsetType) else rule.do
        if action == "retry" and not isinstance(rule, UnsetType):
            self._retries += 1
            if self._retries <= set_or(rule.retries, 1):
                yield from self._retry(now_ns, reason)
                return
            action = set_or(rule.then, stuck)
        if action == "skip":
            yield self._why(now_ns, f"skip {self._mission.id_of(self._index)}", reason)
            yield from self._skip(now_ns)
            return
        yield from self._end_by(now_ns, action, f"{self._mission.id_of(self._index)}: {reason}")

    def _retry(self, now_ns: int, reason: str) -> Outputs:
        run = self._run
        assert run is not None
        yield self._why(now_ns, f"retry {self._retries} of {self._mission.id_of(self._index)}", reason)
        run.index = min(run.index, len(run.legs) - 1)
        run.deadline_ns = now_ns + round(self._timeouts_s[self._index] * 1e9)
        yield from self._send_leg(now_ns)

    def _skip(self, now_ns: int) -> Outputs:
        if self._index + 1 < len(self._mission.steps):
            yield from self._begin(now_ns, self._index + 1)
        else:
            yield from self._end_by(now_ns, "land_here", "the last step was skipped")

    def _end_by(self, now_ns: int, action: str, reason: str) -> Outputs:
        """The mission has failed; bring the vehicle down as told."""
        self._failure, self._state = self._failure or reason, "failing"
        yield self._why(now_ns, action.replace("_", " "), reason)
        if action == "return_home":
            yield from self._go_home(now_ns)
        elif action == "abort":
            self._enter(self._landing, now_ns)
        elif action == "hold":
            self._enter(self._hold, now_ns)
            yield self._stop_goal(now_ns, "hold")
        else:
            yield from self._descend(now_ns)

    def _land_now(self, now_ns: int, reason: str) -> Outputs:
        self._failure, self._state = self._failure or reason, "failing"
        yield self._why(now_ns, "land here", reason)
        self._enter(self._landing, now_ns)

    def _go_home(self, now_ns: int) -> Outputs:
        places = Places.at(self._odometry, self._correction, self._home)
        step = ReturnHome()
        distance_m = float(np.linalg.norm(places.p_map_start - self._home))
        usual_s = distance_m / self._mission.limits_of(step).speed
        limit_s = self._config.timeout_factor * usual_s + self._config.timeout_extra_s
        self._run = Run((home_leg(self._mission),), places, step, now_ns + round(limit_s * 1e9))
        self._enter(self._fly, now_ns)
        yield from self._send_leg(now_ns)

    def _hold(self, now_ns: int) -> Outputs:
        """Wait for the pilot, then land: nobody hovers for ever."""
        if self._elapsed_s(now_ns) > self._config.hold_s:
            yield self._why(now_ns, "land here", f"no pilot within {self._config.hold_s:g} s")
            self._enter(self._landing, now_ns)


def _shown(p: Array) -> str:
    return f"({p[0]:.1f}, {p[1]:.1f}, {p[2]:.1f})"
