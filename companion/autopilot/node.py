"""The autopilot as seen by the stack: MAVLink bytes in and out, our messages on the other side."""

from __future__ import annotations

from typing import Annotated, Final, Literal

import msgspec

from companion.autopilot import codec, modes, timesync
from companion.autopilot.commands import CommandDesk, Verdict
from companion.autopilot.outgoing import Target, odometry_message, setpoint_message
from companion.autopilot.timesync import TimesyncConfig, TimesyncFilter
from companion.autopilot.vehicle import Id, State, Vehicle
from companion.autopilot.wire import Frame, Parser
from companion.core.messages import (
    CommandResult,
    MavlinkBytes,
    Odometry,
    Setpoint,
    VehicleCommand,
)
from companion.core.node import Node, Output, Outputs, every, on
from companion.core.topics import (
    COMMAND_RESULT,
    MAVLINK_RX,
    MAVLINK_TX,
    ODOMETRY,
    SETPOINT,
    VEHICLE,
    VEHICLE_COMMAND,
)

_Id = Annotated[int, msgspec.Meta(ge=1, le=255)]
_Count = Annotated[int, msgspec.Meta(ge=1)]
_Seconds = Annotated[float, msgspec.Meta(gt=0)]

_TICK_HZ: Final = 10
_COMMAND_ACK: Final = 77
_TIMESYNC: Final = 111
_ONBOARD_CONTROLLER: Final = 18  # MAV_TYPE
_ACTIVE: Final = 4  # MAV_STATE
_NEEDED_HZ: Final[dict[modes.Flavour, dict[int, float]]] = {
    "px4": {
        Id.LOCAL_POSITION_NED: 30.0,
        Id.EXTENDED_SYS_STATE: 5.0,
        Id.SYS_STATUS: 2.0,
        Id.ESTIMATOR_STATUS: 1.0,
    },
    "ardupilot": {
        Id.LOCAL_POSITION_NED: 30.0,
        Id.EXTENDED_SYS_STATE: 5.0,
        Id.SYS_STATUS: 2.0,
        Id.EKF_STATUS_REPORT: 2.0,
    },
}
_WANTED: Final = (*Id, _COMMAND_ACK, _TIMESYNC)


class AutopilotConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Whom we talk to, and how."""

    system: _Id = 1
    """Our own MAVLink system: the vehicle's, since we fly on it."""
    component: _Id = 191
    """Our own component: MAV_COMP_ID_ONBOARD_COMPUTER."""
    target_system: _Id = 1
    """The autopilot's system; everyone else on the link is ignored."""
    target_component: _Id = 1
    """The autopilot's component."""
    odometry_hz: Annotated[float, msgspec.Meta(gt=0, le=100)] = 30.0
    """Rate of ODOMETRY to the autopilot; 30-50 suits PX4 and ArduPilot."""
    odometry_clock: Literal["companion", "autopilot"] = "companion"
    """Clock of its stamps. PX4 converts ours itself by TIMESYNC; `autopilot` converts here."""
    rate_variance: Annotated[float, msgspec.Meta(ge=0)] = 1e-4
    """Variance of the body rates in ODOMETRY, (rad/s)^2: a MEMS gyro's."""
    heartbeat_timeout_s: _Seconds = 3.0
    """Disconnected after so long without heartbeat."""
    data_timeout_s: _Seconds = 1.0
    """The autopilot's own position is stale after so long; slow messages after three times that."""
    require_prearm: bool = True
    """`ready` needs the prearm bit of SYS_STATUS. PX4 computes it for the current mode."""
    ack_ticks: _Count = 5
    """Ticks of 0.1 s to wait for a COMMAND_ACK before sending again."""
    attempts: _Count = 4
    """Transmissions of a command before it counts as rejected for timeout."""
    interval_requests: Annotated[int, msgspec.Meta(ge=0)] = 5
    """How often to ask for a message that does not come, per connection."""
    timesync: TimesyncConfig = TimesyncConfig()


class AutopilotNode(Node):
    """Speaks MAVLink with one autopilot. One setpoint in is one message out, never repeated."""

    publishes = (MAVLINK_TX, VEHICLE, COMMAND_RESULT)

    def __init__(self, config: AutopilotConfig) -> None:
        self._config = config
        self._target = Target(config.target_system, config.target_component)
        self._parser = Parser(_WANTED)
        self._encoder = codec.Encoder(system=config.system, component=config.component)
        self._timesync = TimesyncFilter(config.timesync)
        self._desk = CommandDesk(ack_ticks=config.ack_ticks, attempts=config.attempts)
        self._vehicle = Vehicle(
            heartbeat_timeout_s=config.heartbeat_timeout_s,
            data_timeout_s=config.data_timeout_s,
            require_prearm=config.require_prearm,
        )
        self._intervals = _Intervals(config.interval_requests)
        self._ticks = 0
        self._reported: State | None = None
        self._odometry_due_ns: int | None = None
        self._odometry_resets = -1

    @on(MAVLINK_RX)
    def on_bytes(self, received: MavlinkBytes) -> Outputs:
        """Read what the autopilot says; tell the stack at once when its state changed."""
        heard = False
        for frame in self._parser.feed(received.data):
            if frame.system == self._target.system and frame.component == self._target.component:
                heard = True
                yield from self._on_frame(frame, received.stamp_ns)
        if heard and self._vehicle.state(received.stamp_ns) != self._reported:
            yield self._report(received.stamp_ns)

    def _on_frame(self, frame: Frame, now_ns: int) -> Outputs:
        message = codec.decode(frame)
        if frame.msg_id == _TIMESYNC:
            if message.tc1 == 0:
                yield self._send(timesync.answer(message, now_ns), now_ns)
            else:
                self._timesync.learn(message, now_ns)
        elif frame.msg_id == _COMMAND_ACK:
            if self._is_ours(message):
                yield from self._results([self._desk.acknowledge(message)], now_ns)
        else:
            self._vehicle.take(frame.msg_id, message, now_ns)
            self._intervals.heard(frame.msg_id)

    def _is_ours(self, ack: object) -> bool:
        """Zero addresses everyone, as old autopilots do."""
        system, component = getattr(ack, "target_system", 0), getattr(ack, "target_component", 0)
        return system in (0, self._config.system) and component in (0, self._config.component)

    @on(SETPOINT)
    def on_setpoint(self, setpoint: Setpoint) -> Outputs:
        """Pass the demand on; one that controls nothing is dropped."""
        message = setpoint_message(setpoint, self._target, self._vehicle.flavour)
        if message is not None:
            yield self._send(message, setpoint.stamp_ns)

    @on(ODOMETRY)
    def on_odometry(self, odometry: Odometry) -> Outputs:
        """External pose for the autopilot's estimator, thinned out to `odometry_hz`."""
        if not self._odometry_is_due(odometry):
            return
        stamp_ns: int | None = odometry.stamp_ns
        if self._config.odometry_clock == "autopilot":
            stamp_ns = self._timesync.to_autopilot(odometry.stamp_ns)
        if stamp_ns is None or stamp_ns < 0:
            stamp_ns = odometry.stamp_ns
        message = odometry_message(odometry, stamp_ns=stamp_ns, rate_variance=self._config.rate_variance)
        if message is not None:
            yield self._send(message, odometry.stamp_ns)

    def _odometry_is_due(self, odometry: Odometry) -> bool:
        """By stamps, keeping the mean rate; a reset goes out at once."""
        period_ns = round(1e9 / self._config.odometry_hz)
        stamp_ns, due_ns = odometry.stamp_ns, self._odometry_due_ns
        reset = odometry.reset_counter != self._odometry_resets
        if due_ns is not None and not reset and due_ns - period_ns < stamp_ns < due_ns:
            return False
        late = due_ns is None or reset or abs(stamp_ns - due_ns) > period_ns
        self._odometry_due_ns = (stamp_ns if late or due_ns is None else due_ns) + period_ns
        self._odometry_resets = odometry.reset_counter
        return True

    @on(VEHICLE_COMMAND)
    def on_command(self, command: VehicleCommand) -> Outputs:
        """Ask the autopilot; the answer follows as COMMAND_RESULT."""
        system, component = self._target
        request = modes.order(command.kind, self._vehicle.flavour, system=system, component=component)
        send, replaced = self._desk.submit(command.kind, request)
        yield from self._results([replaced], command.stamp_ns)
        if send:
            yield self._send(request, command.stamp_ns)

    @every(hz=_TICK_HZ)
    def step(self, now_ns: int) -> Outputs:
        """Heartbeat at 1 Hz, TIMESYNC and VEHICLE at 10 Hz, retries of commands, message rates."""
        if self._ticks % _TICK_HZ == 0:
            yield self._send(codec.Heartbeat(0, _ONBOARD_CONTROLLER, 8, 0, _ACTIVE), now_ns)
        self._ticks += 1
        connected = self._vehicle.connected(now_ns)
        if connected:
            yield self._send(timesync.request(now_ns), now_ns)
        again, ended = self._desk.tick()
        for request in again:
            yield self._send(request, now_ns)
        yield from self._results(ended, now_ns)
        for msg_id, hz in self._intervals.missing(self._vehicle.flavour, connected):
            yield self._send(self._interval_request(msg_id, hz), now_ns)
        yield self._report(now_ns)

    def _interval_request(self, msg_id: int, hz: float) -> codec.CommandLong:
        system, component = self._target
        return modes.command_long(modes.SET_INTERVAL, msg_id, 1e6 / hz, system=system, component=component)

    def _send(self, message: codec.HotMessage, now_ns: int) -> Output:
        return MAVLINK_TX(MavlinkBytes(stamp_ns=now_ns, data=self._encoder.encode(message)))

    def _report(self, now_ns: int) -> Output:
        self._reported = self._vehicle.state(now_ns)
        return VEHICLE(self._vehicle.status(now_ns))

    def _results(self, verdicts: list[Verdict] | list[Verdict | None], now_ns: int) -> Outputs:
        for verdict in verdicts:
            if verdict is not None:
                yield COMMAND_RESULT(
                    CommandResult(stamp_ns=now_ns, kind=verdict.kind, accepted=verdict.accepted, reason=verdict.reason)
                )


class _Intervals:
    """Which needed messages come too slowly: looked at every 2 s of connection."""

    WINDOW_TICKS: Final = 2 * _TICK_HZ

    def __init__(self, requests_max: int) -> None:
        self._requests_max = requests_max
        self._restart()

    def _restart(self) -> None:
        self._ticks = 0
        self._counts: dict[int, int] = {}
        self._requests: dict[int, int] = {}

    def heard(self, msg_id: int) -> None:
        self._counts[msg_id] = self._counts.get(msg_id, 0) + 1

    def missing(self, flavour: modes.Flavour, connected: bool) -> list[tuple[int, float]]:
        """One tick: (id, rate in Hz) of what came at less than half its rate."""
        if not connected:
            self._restart()
            return []
        self._ticks += 1
        if self._ticks % self.WINDOW_TICKS:
            return []
        slow: list[tuple[int, float]] = []
        for msg_id, hz in _NEEDED_HZ[flavour].items():
            asked = self._requests.get(msg_id, 0)
            if self._counts.get(msg_id, 0) < 0.5 * hz * 2 and asked < self._requests_max:
                self._requests[msg_id] = asked + 1
                slow.append((msg_id, hz))
        self._counts = {}
        return slow
