"""Mutated frames through parser, decoder and node on both sides: nothing escapes, nothing grows."""

from __future__ import annotations

import gc
import resource
from pathlib import Path

import numpy as np
import pytest

from companion.autopilot.node import AutopilotConfig, AutopilotNode
from companion.core.messages import MavlinkBytes, Setpoint, VehicleCommand
from companion.core.topics import MAVLINK_RX, SETPOINT, VEHICLE_COMMAND
from sim.autopilot.autopilot import Autopilot
from sim.autopilot.modes import Mode
from sim.autopilot.readings import AutopilotConfig as SimConfig
from sim.autopilot.readings import GpsFix
from tests.unit.autopilot.mutations import batches
from tests.unit.sim_autopilot.conftest import airframe

S, MS = 10**9, 10**6
BATCH = 20
KEY = bytes(range(32))
PAGE_MB = resource.getpagesize() / 2**20


def resident_mb():
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * PAGE_MB


def run(consume, frames, *, component):
    """Feed everything; how much memory grew after the first quarter, MB."""
    start_mb, quarter = 0.0, frames // BATCH // 4
    for i, data in enumerate(batches(7, frames, size=BATCH, system=1, component=component)):
        if i == quarter:
            start_mb = resident_mb()
        consume(i, data)
    return resident_mb() - start_mb


def through_the_node(frames, key=None):
    node = AutopilotNode(AutopilotConfig(), signing_key=key)
    nan = np.full(3, np.nan)

    def consume(i, data):
        now_ns = i * 20 * MS
        list(node.handle(MAVLINK_RX, MavlinkBytes(stamp_ns=now_ns, data=data)))
        if i % 5 == 0:
            list(node.tick("step", now_ns))
            demand = Setpoint(stamp_ns=now_ns, p_odom=np.ones(3), v_odom=nan, a_odom=nan, yaw=0.0, yaw_rate=0.0)
            list(node.handle(SETPOINT, demand))
        if i % 50 == 0:
            kind = ("arm", "offboard", "land", "hold", "return", "disarm")[i // 50 % 6]
            list(node.handle(VEHICLE_COMMAND, VehicleCommand(stamp_ns=now_ns, kind=kind)))

    return node, run(consume, frames, component=1)


def through_the_autopilot(frames, key=None):
    vehicle = Autopilot(SimConfig(), airframe=airframe(), seed=1, signing_key=key)
    up = np.array([0.0, 0.0, 9.81])
    fix = GpsFix(p_enu_m=(0.0, 0.0, 0.0), v_enu=(0.0, 0.0, 0.0))

    def consume(i, data):
        now_ns = i * 5 * MS
        if i % 100 == 50 and not vehicle.armed:  # a senseless LAND on the ground would keep it down for ever
            vehicle.commander.mode = Mode.HOLD
            vehicle.commander.arm(now_ns, force=True)
        vehicle.receive(now_ns, data)
        for k in range(2):
            motors = vehicle.step(
                now_ns + k * 2_500_000,
                imu=(np.zeros(3), up),
                baro_altitude_m=0.0 if i % 10 == 0 else None,
                gps=fix if i % 40 == 0 else None,
                range_m=None,
                battery_voltage=16.0,
            )
            assert np.all((motors >= 0) & (motors <= 1))
        assert len(vehicle.transmit(now_ns)) < 200_000

    return vehicle, run(consume, frames, component=191)


@pytest.mark.parametrize("key", [None, KEY], ids=["open", "signed"])
def test_our_side_survives(key):
    node, grown_mb = through_the_node(80_000 if key is None else 40_000, key)
    assert node._parser.frames > 20_000 and node._parser.corrupt_pieces > 5_000
    assert grown_mb < 4
    if key:
        assert node._signing.rejected.unsigned > 20_000 and not node._vehicle.connected(0)


def test_the_autopilots_side_survives():
    vehicle, grown_mb = through_the_autopilot(60_000)
    assert vehicle._parser.damaged > 1_000 and grown_mb < 4


@pytest.mark.slow
def test_a_million_frames_on_our_side():
    node, grown_mb = through_the_node(1_000_000)
    assert node._parser.frames > 500_000 and grown_mb < 8


@pytest.mark.slow
def test_a_million_frames_on_the_autopilots_side():
    _, grown_mb = through_the_autopilot(1_000_000)
    assert grown_mb < 8
