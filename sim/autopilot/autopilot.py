"""The simulated autopilot: PX4's behaviour on real MAVLink 2 bytes, without sockets or a clock.

    autopilot = Autopilot(AutopilotConfig(), airframe=airframe, seed=1)
    motors = autopilot.step(now_ns, imu=(gyro, accel), baro_altitude_m=None, gps=None, range_m=None,
                            battery_voltage=16.0)      # every 2.5 ms
    autopilot.receive(now_ns, data_from_the_stack)
    data = autopilot.transmit(now_ns)

It estimates for itself, refuses what PX4 refuses and fails safe as PX4 does. Its clock
starts `boot_offset_s` before the simulation's: stamps must be translated, as in life.
"""

from __future__ import annotations

import math

import numpy as np

from companion.core.messages import Array
from sim.autopilot.codec import BY_NAME, Encoder, Parser
from sim.autopilot.commander import Commander
from sim.autopilot.commands import Commands
from sim.autopilot.control import Controller
from sim.autopilot.estimator import Estimator
from sim.autopilot.inbox import Inbox
from sim.autopilot.mission_flight import MissionFlight
from sim.autopilot.mission_store import MissionStore
from sim.autopilot.modes import Severity
from sim.autopilot.params import Parameters, ParameterService, airframe_defaults
from sim.autopilot.readings import Airframe, AutopilotConfig, GpsFix
from sim.autopilot.signing import Signing
from sim.autopilot.streams import Streams
from sim.autopilot.telemetry import Clock, Readings, Telemetry
from sim.autopilot.timesync import TimeSync

STEP_S = 0.0025
POSITION_STEPS = 4  # position control and supervision at 100 Hz
TEXT_BYTES = 50


class Autopilot:
    """Estimator, cascade, commander and protocol in one state machine; see the module's text."""

    def __init__(
        self, config: AutopilotConfig, *, airframe: Airframe, seed: int, signing_key: bytes | None = None
    ) -> None:
        """With a `signing_key` of 32 bytes it signs what it says and hears only who holds the key."""
        own = {"MAV_SYS_ID": config.system_id, "BAT1_N_CELLS": config.battery_cells}
        self.parameters = Parameters(airframe_defaults(airframe), own, config.parameters)
        self._offset_ns = round(config.boot_offset_s * 1e9)
        heading = None if config.boot_heading_deg is None else math.radians(config.boot_heading_deg)
        rng = np.random.default_rng([seed, 0xA0])
        self._clock, self._readings = Clock(), Readings()
        self.signing = None if signing_key is None else Signing(signing_key)
        self._encoder = Encoder(system=config.system_id, component=1, signing=self.signing)
        self._parser = Parser(signing=self.signing)
        self.estimator = Estimator(self.parameters, boot_heading=heading)
        self.controller = Controller(self.parameters, airframe)
        self.commander = Commander(self.parameters, self.estimator, self.controller, say=self._say)
        self._missions = MissionStore(self._encoder)
        self._telemetry = Telemetry(
            self._clock, self._encoder, self.estimator, self.controller,
            commander=self.commander, readings=self._readings, missions=self._missions,
        )  # fmt: skip
        self._telemetry.origin = (
            config.origin_latitude_deg, config.origin_longitude_deg, config.origin_altitude_m,
        )  # fmt: skip
        self._streams = Streams(self._telemetry.ids, rng)
        uid = int(rng.integers(1, 1 << 62))
        self._commands = Commands(
            self.commander, self._telemetry, self._streams, self._encoder, missions=self._missions, uid=uid,
        )  # fmt: skip
        self._mission_flight = MissionFlight(
            self._missions, self.commander, place=self._commands.place, say=self._say
        )  # fmt: skip
        self.timesync = TimeSync()
        self._services = ParameterService(self.parameters, self._encoder)
        self._inbox = Inbox(
            config.system_id, self.commander, self.estimator, self._commands,
            encoder=self._encoder, timesync=self.timesync, parameters=self._services, missions=self._missions,
            say=self._say,
        )  # fmt: skip
        self._texts: list[tuple[Severity, str]] = []
        self._text_id = self._steps = 0
        self._shown = (self.commander.mode, self.commander.armed)

    @property
    def armed(self) -> bool:
        """Whether the motors turn."""
        return self.commander.armed

    @property
    def mode(self) -> str:
        """OFFBOARD, HOLD, TAKEOFF, LAND, RETURN, POSCTL or DESCEND."""
        return self.commander.mode.name

    def receive(self, now_ns: int, data: bytes) -> None:
        """Bytes from the link, cut anywhere, damaged or not; never raises."""
        self._tell_time(now_ns)
        for frame in self._parser.feed(bytes(data)):
            self._inbox.handle(self._clock.ns, frame)

    def step(
        self, now_ns: int, *, imu: tuple[Array, Array], baro_altitude_m: float | None, gps: GpsFix | None,
        range_m: float | None, battery_voltage: float,
    ) -> Array:  # fmt: skip
        """Every 2.5 ms: readings in, motor commands (4,) in [0, 1] out.

        `imu` is (angular velocity rad/s, specific force m/s2), both body FLU and means over
        the interval that ends now; the others are new readings or None.
        """
        self._tell_time(now_ns)
        own_ns, estimator = self._clock.ns, self.estimator
        estimator.imu(own_ns, imu[0], imu[1], STEP_S)
        if baro_altitude_m is not None:
            estimator.baro(baro_altitude_m)
        if range_m is not None:
            estimator.range_m = range_m
        if gps is not None:
            self._take_fix(gps)
        self._steps += 1
        if self._steps % POSITION_STEPS == 0:
            self._supervise(own_ns, battery_voltage)
        return self.commander.motors(STEP_S).copy()

    def transmit(self, now_ns: int) -> bytes:
        """All frames due now: answers, texts, telemetry."""
        self._tell_time(now_ns)
        own_ns = self._clock.ns
        out = self._inbox.take()
        out += self._commands.extra
        self._commands.extra.clear()
        out += self._services.due() + self._missions.due(own_ns)
        for severity, text in self._texts:
            out += self._status_text(severity, text)
        self._texts.clear()
        if self._shown != (self.commander.mode, self.commander.armed):
            self._shown = self.commander.mode, self.commander.armed
            out += self._telemetry.heartbeat()
        for msg_id in self._streams.due(own_ns):
            out += self._telemetry.pack(msg_id)
        return bytes(out)

    def _tell_time(self, now_ns: int) -> None:
        self._clock.ns = now_ns + self._offset_ns
        self.commander.now_ns = self._clock.ns
        if self.signing is not None:
            self.signing.now_ns = self._clock.ns

    def _take_fix(self, fix: GpsFix) -> None:
        self._readings.gps = fix
        self.estimator.gps(fix)
        if self.estimator.global_position and not self._telemetry.origin_known:
            self._commands.set_origin(*self._telemetry.origin)
        if self.estimator.global_position and not self.armed and not self.commander.home_set:
            self.commander.set_home(self.estimator.p)

    def _supervise(self, own_ns: int, battery_voltage: float) -> None:
        p, dt = self.parameters, STEP_S * POSITION_STEPS
        self._readings.battery_v = battery_voltage
        if math.isfinite(battery_voltage):
            full, empty = p["BAT1_V_CHARGED"], p["BAT1_V_EMPTY"]
            charge = (battery_voltage / p["BAT1_N_CELLS"] - empty) / max(full - empty, 0.01)
            self.commander.battery += 0.005 * (min(max(charge, 0.0), 1.0) - self.commander.battery)
        self.estimator.hold(at_rest=self.commander.flight.landed)
        self._mission_flight.step(own_ns)
        self.commander.tick(own_ns, dt)

    def _say(self, severity: Severity, text: str) -> None:
        self._texts.append((severity, text))

    def _status_text(self, severity: Severity, text: str) -> bytes:
        """STATUSTEXT, in pieces if it is long."""
        raw = text.encode()
        if len(raw) <= TEXT_BYTES:
            return self._encoder(BY_NAME["STATUSTEXT"], severity, raw, 0, 0)
        self._text_id = self._text_id % 65535 + 1
        pieces = [raw[i : i + TEXT_BYTES] for i in range(0, len(raw), TEXT_BYTES)]
        return b"".join(
            self._encoder(BY_NAME["STATUSTEXT"], severity, piece, self._text_id, k) for k, piece in enumerate(pieces)
        )
