"""The node flies the simulated autopilot over a line that loses half, delays, doubles and reorders."""

from __future__ import annotations

import heapq
import itertools

import numpy as np
import pytest

from companion.autopilot.node import AutopilotConfig, AutopilotNode
from companion.core.messages import MavlinkBytes, Setpoint, VehicleCommand
from companion.core.topics import MAVLINK_RX, MAVLINK_TX, SETPOINT, VEHICLE, VEHICLE_COMMAND, WHY
from tests.unit.sim_autopilot.conftest import Bench

MS = 1_000_000
NAN3 = np.full(3, np.nan)


class Line:
    """One direction; faults by a seeded generator."""

    def __init__(self, seed, *, loss, delay_ms, jitter_ms, duplicate):
        self.rng = np.random.default_rng(seed)
        self.loss, self.delay_ms, self.jitter_ms, self.duplicate = loss, delay_ms, jitter_ms, duplicate
        self.queue, self.order = [], itertools.count()

    def put(self, now_ns, data):
        lost, doubled, *jitters = self.rng.random(4)
        if lost < self.loss:
            return
        for jitter in jitters[: 1 + (doubled < self.duplicate)]:
            due_ns = now_ns + round((self.delay_ms + jitter * self.jitter_ms) * MS)
            heapq.heappush(self.queue, (due_ns, next(self.order), data))

    def due(self, now_ns):
        while self.queue and self.queue[0][0] <= now_ns:
            yield heapq.heappop(self.queue)[2]


class Flight(Bench):
    """The bench keeps the autopilot's own estimate good; commands and setpoints cross the line."""

    def __init__(self, **faults):
        super().__init__()
        self.node = AutopilotNode(AutopilotConfig())
        self.up, self.down = Line(1, **faults), Line(2, **faults)
        self.status, self.whys, self.demand = None, [], None
        self.modes = []

    def read(self, data):
        super().read(data)
        self.up.put(self.now_ns, data)

    def step(self):
        super().step()
        for data in self.down.due(self.now_ns):
            self.autopilot.receive(self.now_ns, data)
        for data in self.up.due(self.now_ns):
            self.take(self.node.handle(MAVLINK_RX, MavlinkBytes(stamp_ns=self.now_ns, data=data)))
        if self.tick % 40 == 0:
            self.take(self.node.tick("step", self.now_ns))
        if self.demand is not None and self.tick % 8 == 0:
            demand = Setpoint(
                stamp_ns=self.now_ns, p_odom=self.demand, v_odom=NAN3, a_odom=NAN3, yaw=np.pi / 2, yaw_rate=np.nan
            )
            self.take(self.node.handle(SETPOINT, demand))

    def take(self, outputs):
        for output in outputs:
            if output.topic is MAVLINK_TX:
                self.down.put(self.now_ns, output.message.data)
            elif output.topic is VEHICLE:
                self.status = output.message
                if self.modes[-1:] != [self.status.mode]:
                    self.modes.append(self.status.mode)
            elif output.topic is WHY:
                self.whys.append(output.message)

    def ask_until(self, kind, done, *, seconds):
        """As the mission does: ask again every 2 s."""
        for i in range(round(seconds / 0.1)):
            if self.status is not None and done(self.status):
                return
            if i % 20 == 0:
                self.take(self.node.handle(VEHICLE_COMMAND, VehicleCommand(stamp_ns=self.now_ns, kind=kind)))
            self.run(0.1)
        raise AssertionError(f"{kind}: {self.status}, {self.texts()}")


BAD = dict(loss=0.5, delay_ms=200, jitter_ms=100, duplicate=0.3)


def test_a_flight_from_arming_to_landing():
    flight = Flight(**BAD)
    flight.run(4.0)
    flight.demand = np.array([0.0, 0.0, 5.0])
    flight.run(1.0)
    flight.ask_until("offboard", lambda s: s.mode == "OFFBOARD", seconds=10)
    flight.ask_until("arm", lambda s: s.armed, seconds=10)
    flight.run(8.0)
    assert flight.truth[-1][3] == pytest.approx(5.0, abs=0.4)
    flight.ask_until("land", lambda s: s.mode == "LAND", seconds=10)
    flight.ask_until("land", lambda s: s.landed and not s.armed, seconds=30)
    assert flight.whys == []  # neither takeover nor reboot was seen where none was
    assert flight.modes[:4] == ["", "HOLD", "OFFBOARD", "LAND"]


def test_over_a_bad_line_the_pilot_still_wins():
    flight = Flight(**BAD)
    flight.run(4.0)
    flight.demand = np.array([0.0, 0.0, 5.0])
    flight.run(1.0)
    flight.ask_until("offboard", lambda s: s.mode == "OFFBOARD", seconds=10)
    flight.ask_until("arm", lambda s: s.armed, seconds=10)
    flight.run(6.0)
    assert flight.command(176, 1, 4, 3) == 0  # the pilot chooses HOLD, over another link
    for _ in range(20):
        flight.take(flight.node.handle(VEHICLE_COMMAND, VehicleCommand(stamp_ns=flight.now_ns, kind="offboard")))
        flight.run(0.25)
        if flight.whys:
            break
    assert flight.status.mode == "HOLD" and "took over" in flight.whys[0].because
    flight.run(3.0)
    assert flight.autopilot.mode == "HOLD" and flight.autopilot.armed
