"""A flight with a ground station beside it."""

import importlib.util
import os
import sys
import threading
import time
from pathlib import Path

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

_spec = importlib.util.spec_from_file_location("flying", Path(__file__).resolve().parents[1] / "flying.py")
flying = importlib.util.module_from_spec(_spec)
sys.modules["flying"] = flying
_spec.loader.exec_module(flying)

PX4 = {"OFFBOARD": (6, 0), "HOLD": (4, 3), "LAND": (4, 6)}  # main and sub mode
OFFBOARD = 6


class Station:
    """A pilot at a ground station: hears the vehicle on an endpoint of its own, changes its mode."""

    def __init__(self, port):
        os.environ["MAVLINK20"] = "1"
        from pymavlink import mavutil

        self._link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=255, source_component=190)
        self.modes, self.acks = [], []  # (monotonic s, mode, armed); (command, result)
        self._ended = False
        self._thread = threading.Thread(target=self._listen)
        self._thread.start()

    def _listen(self):
        while not self._ended:
            message = self._link.recv_match(type=["HEARTBEAT", "COMMAND_ACK"], blocking=True, timeout=0.2)
            if message is None or message.get_srcSystem() != 1:
                continue
            if message.get_type() == "COMMAND_ACK" and message.target_system == 255:
                self.acks.append((message.command, message.result))
            elif message.get_type() == "HEARTBEAT" and message.get_srcComponent() == 1:
                mode = message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF
                armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
                self.modes.append((time.monotonic(), mode, armed))

    def __str__(self):
        return f"newest mode {self.modes[-1:]}, answers {self.acks}"

    def switch(self, mode):
        """Command a mode; the monotonic time at which it was sent."""
        sent_s = time.monotonic()
        self._link.mav.command_long_send(1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1, *PX4[mode], 0, 0, 0, 0)
        return sent_s

    def in_mode(self, mode):
        return bool(self.modes) and self.modes[-1][1] == PX4[mode]

    def left(self, mode, since_s):
        """Whether the vehicle was in another mode since, with its motors on."""
        return any(m != PX4[mode] for when, m, armed in self.modes if when > since_s and armed)

    @property
    def last_armed_s(self):
        """When the vehicle said last that its motors are on."""
        return max(when for when, _, armed in self.modes if armed)

    def close(self):
        self._ended = True
        self._thread.join(5)
        self._link.close()


@pytest.fixture
def fly(tmp_path):
    """Starts flights: `fly(options=..., sim_options=...)`."""
    flights = []

    def start(**settings):
        flights.append(flying.Flight(tmp_path, **settings))
        return flights[-1].__enter__()

    yield start
    for flight in flights:
        flight.__exit__(None, None, None)


@pytest.fixture
def watched(fly):
    """A flight and its pilot."""
    port = flying.free_port(flying.socket.SOCK_DGRAM)
    flight = fly(sim_options=(f"--gcs=udp://127.0.0.1:{port}",))
    station = Station(port)
    yield flight, station
    station.close()


@pytest.fixture(scope="session")
def faults():
    return flying.middleman.Faults


@pytest.fixture(scope="session")
def wishes():
    """(monotonic s, what) of every arming and mode that went to the vehicle."""

    def of(flight, since_s):
        kinds = {mavlink.MAV_CMD_DO_SET_MODE: "mode", mavlink.MAV_CMD_COMPONENT_ARM_DISARM: "arm"}
        found = []
        for when, m in flight.sent("COMMAND_LONG", since_s):
            if m.command in kinds:
                mode = "OFFBOARD" if m.param2 == OFFBOARD else f"AUTO {m.param3:.0f}"
                found.append((when, mode if kinds[m.command] == "mode" else f"arm {m.param1:.0f}"))
        return found

    return of
