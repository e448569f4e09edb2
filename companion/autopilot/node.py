"""The autopilot as seen by the stack: MAVLink bytes in and out, our messages on the other side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from companion.autopilot import codec, modes, timesync
from companion.autopilot.authority import MODE_OF, Authority, fulfilled
from companion.autopilot.commands import CommandDesk, Verdict, is_for
from companion.autopilot.config import AutopilotConfig as AutopilotConfig  # for who builds the node
from companion.autopilot.intervals import Intervals
from companion.autopilot.key_words import WANTS_A_KEY, key_trouble, rejected_words
from companion.autopilot.neighbours import Neighbours
from companion.autopilot.outgoing import Target, odometry_message, setpoint_message
from companion.autopilot.pace import OdometryPace
from companion.autopilot.signing import Signing
from companion.autopilot.texts import News, Newsroom, Severity, pieces
from companion.autopilot.timesync import TimesyncFilter
from companion.autopilot.vehicle import Id, State, Vehicle
from companion.autopilot.wire import Frame, Parser
from companion.core.messages import (
    CommandResult,
    MavlinkBytes,
    MissionStatus,
    Odometry,
    SafetyStatus,
    Setpoint,
    VehicleCommand,
    Why,
)
from companion.core.node import Node, Output, Outputs, every, on
from companion.core.topics import (
    COMMAND_RESULT,
    MAVLINK_RX,
    MAVLINK_TX,
    MISSION,
    ODOMETRY,
    SAFETY,
    SETPOINT,
    VEHICLE,
    VEHICLE_COMMAND,
    WHY,
)

_TICK_HZ: Final = 10
_COMMAND_ACK: Final = 77
_TIMESYNC: Final = 111
_ONBOARD_CONTROLLER: Final = 18  # MAV_TYPE
_ACTIVE: Final = 4  # MAV_STATE
_REJECTED_EVERY_TICKS: Final = 100
_WANTED: Final = (*Id, _COMMAND_ACK, _TIMESYNC)


class AutopilotNode(Node):
    """Speaks MAVLink with one autopilot. One setpoint in is one message out, never repeated.

    It never takes back what the pilot took (`authority`), and refuses to command beside a second
    companion (`neighbours`); both are told by WHY, to the pilot as a text, and as the reason of
    COMMAND_RESULT.
    """

    publishes = (MAVLINK_TX, VEHICLE, COMMAND_RESULT, WHY)

    def __init__(self, config: AutopilotConfig, *, signing_key: bytes | None = None) -> None:
        """With a `signing_key` of 32 bytes all frames are signed, and others count as not come."""
        self._config = config
        self._target = Target(config.target_system, config.target_component)
        self._signing = None if signing_key is None else Signing(signing_key)
        self._parser = Parser(_WANTED, signing=self._signing)
        self._encoder = codec.Encoder(system=config.system, component=config.component, signing=self._signing)
        self._timesync = TimesyncFilter(config.timesync)
        self._desk = CommandDesk(ack_ticks=config.ack_ticks, attempts=config.attempts)
        self._vehicle = Vehicle(
            heartbeat_timeout_s=config.heartbeat_timeout_s,
            data_timeout_s=config.data_timeout_s,
            require_prearm=config.require_prearm,
        )
        self._intervals = Intervals(config.interval_requests, ticks_hz=_TICK_HZ)
        self._authority = Authority()
        self._neighbours = Neighbours(system=config.system, component=config.component)
        self._newsroom = Newsroom()
        self._ticks = self._texts = self._rejected_told = 0
        self._barred = ""  # why setpoints do not go out
        self._reported: State | None = None
        self._pace = OdometryPace(config.odometry_hz)

    @on(MAVLINK_RX)
    def on_bytes(self, received: MavlinkBytes) -> Outputs:
        """Read what the autopilot says; tell the stack at once when its state changed."""
        now_ns, heard = received.stamp_ns, False
        for frame in self._parser.feed(received.data, now_ns):
            sender = frame.system, frame.component
            if sender == self._target:
                heard = True
                yield from self._on_frame(frame, now_ns)
            elif sender == (self._config.system, self._config.component) and frame.msg_id == Id.HEARTBEAT:
                yield from self._on_double(frame, now_ns)
        if heard and self._vehicle.state(now_ns) != self._reported:
            yield self._report(now_ns)

    def _on_frame(self, frame: Frame, now_ns: int) -> Outputs:
        message = codec.decode(frame)
        if frame.msg_id == _TIMESYNC:
            if message.tc1 == 0:
                yield self._send(timesync.answer(message, now_ns), now_ns)
                return
            if self._vehicle.rebooted(_TIMESYNC, message.tc1 // 1_000_000 & 0xFFFFFFFF):
                yield from self._start_anew(now_ns)
            self._timesync.learn(message, now_ns)
        elif frame.msg_id == _COMMAND_ACK:
            if is_for(message, self._config.system, self._config.component):
                yield from self._results([self._desk.acknowledge(message)], now_ns)
        else:
            self._intervals.heard(frame.msg_id)
            if self._vehicle.take(frame.msg_id, message, now_ns, sequence=frame.sequence):
                yield from self._start_anew(now_ns)
            if frame.msg_id == Id.HEARTBEAT:
                yield from self._watch_mode(now_ns)

    def _start_anew(self, now_ns: int) -> Outputs:
        """The autopilot rebooted: nothing that it knew or we asked for holds any more."""
        self._timesync.restart()
        self._intervals.restart()
        self._authority.restart()
        yield from self._results(self._desk.cancel("the autopilot rebooted"), now_ns)
        yield self._why(now_ns, "start anew with the autopilot", "it rebooted: its clock went back")
        yield from self._tell(News(Severity.WARNING, "autopilot rebooted"), now_ns)

    def _watch_mode(self, now_ns: int) -> Outputs:
        """What is done or taken from us must not be asked for again, though no answer came."""
        state = self._vehicle.state(now_ns)
        for kind in fulfilled(state.mode, armed=state.armed):
            yield from self._results([self._desk.fulfil(kind)], now_ns)
        if self._authority.saw(state.mode, armed=state.armed, now_ns=now_ns):
            reason = self._authority.reason
            yield from self._results(self._desk.cancel(reason), now_ns)
            yield self._why(now_ns, "command no more", reason)
            yield from self._tell(News(Severity.WARNING, f"{state.mode} is not ours, setpoints stop"), now_ns)

    def _on_double(self, frame: Frame, now_ns: int) -> Outputs:
        if self._neighbours.heard(frame.sequence, now_ns):
            yield self._why(now_ns, "refuse to command", self._neighbours.reason)
            yield from self._tell(News(Severity.CRITICAL, self._neighbours.reason), now_ns)
            yield self._report(now_ns)

    def _refusal(self, kind: str, now_ns: int) -> str:
        """Why we do not ask the autopilot for this now; '' if nothing is against it.

        In flight, a second companion is no reason not to brake or land.
        """
        if self._authority.reason:
            return self._authority.reason
        needed = self._authority.flying and kind not in ("arm", "offboard")
        return self._neighbours.reason if self._neighbours.present(now_ns) and not needed else ""

    @on(SETPOINT)
    def on_setpoint(self, setpoint: Setpoint) -> Outputs:
        """Pass the demand on, if the flight is ours or may become so; one that controls nothing is dropped."""
        now_ns, before = setpoint.stamp_ns, self._barred
        self._barred = self._setpoints_barred(now_ns)
        if self._barred and self._barred != before:
            yield self._why(now_ns, "send no setpoints", self._barred)
        if self._barred:
            return
        message = setpoint_message(setpoint, self._target, self._vehicle.flavour)
        if message is not None:
            yield self._send(message, now_ns)

    def _setpoints_barred(self, now_ns: int) -> str:
        """Why no setpoint goes out now. On the ground they do, since PX4 wants a stream before OFFBOARD."""
        if self._authority.flying:
            return ""
        if self._authority.reason:
            return self._authority.reason
        if self._neighbours.present(now_ns):
            return self._neighbours.reason
        # As after a restart of ours in flight: without setpoints the autopilot's failsafe brings it home.
        return "it flies, and not because we asked" if self._vehicle.airborne else ""

    @on(ODOMETRY)
    def on_odometry(self, odometry: Odometry) -> Outputs:
        """External pose for the autopilot's estimator, thinned out to `odometry_hz`."""
        if not self._pace.is_due(odometry):
            return
        stamp_ns: int | None = odometry.stamp_ns
        if self._config.odometry_clock == "autopilot":
            stamp_ns = self._timesync.to_autopilot(odometry.stamp_ns)
        if stamp_ns is None or stamp_ns < 0:
            stamp_ns = odometry.stamp_ns
        message = odometry_message(odometry, stamp_ns=stamp_ns, rate_variance=self._config.rate_variance)
        if message is not None:
            yield self._send(message, odometry.stamp_ns)

    @on(VEHICLE_COMMAND)
    def on_command(self, command: VehicleCommand) -> Outputs:
        """Ask the autopilot; the answer follows as COMMAND_RESULT."""
        kind, now_ns = command.kind, command.stamp_ns
        refusal = self._refusal(kind, now_ns)
        if refusal:
            yield from self._results([Verdict(kind, False, refusal)], now_ns)
            return
        if kind == "offboard" and self._vehicle.state(now_ns).mode == MODE_OF[kind] and self._authority.flying:
            yield from self._results([Verdict(kind, True, "")], now_ns)  # asking again could undo what a pilot just did
            return
        system, component = self._target
        request = modes.order(kind, self._vehicle.flavour, system=system, component=component)
        send, replaced = self._desk.submit(kind, request)
        yield from self._results([replaced], now_ns)
        if send:
            self._authority.asked(kind, self._vehicle.state(now_ns).mode)
            yield self._send(request, now_ns)

    @on(SAFETY)
    def on_safety(self, status: SafetyStatus) -> Outputs:
        """Tell the pilot when the guards change their action."""
        yield from self._tell(self._newsroom.safety(status), status.stamp_ns)

    @on(MISSION)
    def on_mission(self, status: MissionStatus) -> Outputs:
        """Tell the pilot how the mission stands."""
        yield from self._tell(self._newsroom.mission(status), status.stamp_ns)

    @every(hz=_TICK_HZ)
    def step(self, now_ns: int) -> Outputs:
        """Heartbeat at 1 Hz, TIMESYNC and VEHICLE at 10 Hz, retries of commands, message rates."""
        if self._ticks % _TICK_HZ == 0:
            self._neighbours.sent(self._encoder.sequence)
            yield self._send(codec.Heartbeat(0, _ONBOARD_CONTROLLER, 8, 0, _ACTIVE), now_ns)
        self._ticks += 1
        connected = self._vehicle.connected(now_ns)
        if connected:
            yield self._send(timesync.request(now_ns), now_ns)
        again, ended = self._desk.tick()
        for request in again:
            yield self._send(request, now_ns)
        yield from self._results([self._explained(v) for v in ended], now_ns)
        for msg_id, hz in self._intervals.missing(self._vehicle.flavour, connected):
            yield self._send(self._interval_request(msg_id, hz), now_ns)
        if self._ticks % _REJECTED_EVERY_TICKS == 1:
            yield from self._tell_rejected(now_ns)
        yield self._report(now_ns)

    def _explained(self, verdict: Verdict) -> Verdict:
        if self._signing is not None or not self._parser.signed:
            return verdict
        return verdict._replace(reason=f"{verdict.reason}; {WANTS_A_KEY}")

    def _interval_request(self, msg_id: int, hz: float) -> codec.CommandLong:
        system, component = self._target
        return modes.command_long(modes.SET_INTERVAL, msg_id, 1e6 / hz, system=system, component=component)

    def _send(self, message: codec.HotMessage, now_ns: int) -> Output:
        return MAVLINK_TX(MavlinkBytes(stamp_ns=now_ns, data=self._encoder.encode(message, now_ns)))

    def _report(self, now_ns: int) -> Output:
        """The status; not ready before we could have heard a second companion, nor beside one."""
        self._reported = self._vehicle.state(now_ns)
        status = self._vehicle.status(now_ns)
        if not self._neighbours.listened(now_ns, connected=status.connected):
            status = replace(status, ready=False)
        if self._neighbours.present(now_ns):
            status = replace(status, ready=False, text=self._neighbours.reason)
        elif not status.connected:
            status = replace(status, text=self._key_trouble(ready=False, connected=False))  # its old words are stale
        elif trouble := self._key_trouble(ready=status.ready, connected=True):
            status = replace(status, text=f"{status.text}; {trouble}" if status.text else trouble)
        return VEHICLE(status)

    def _key_trouble(self, *, ready: bool, connected: bool) -> str:
        """Why a vehicle that is there does not count, or does not hear us; '' if keys cannot be the reason."""
        return key_trouble(self._signing, signed=bool(self._parser.signed), ready=ready, connected=connected)

    def _tell(self, news: News | None, now_ns: int) -> Outputs:
        """A text to the pilot, if the autopilot is there to pass it on."""
        if news is not None and self._vehicle.connected(now_ns):
            self._texts = self._texts % 0xFFFF + 1
            for piece in pieces(news, self._texts):
                yield self._send(piece, now_ns)

    def _tell_rejected(self, now_ns: int) -> Outputs:
        """Frames that the key did not let pass, if there were more."""
        if self._signing is None or self._signing.rejected.total == self._rejected_told:
            return
        self._rejected_told = self._signing.rejected.total
        words = rejected_words(self._signing.rejected)
        yield self._why(now_ns, "ignore frames without our signature", words)

    def _why(self, now_ns: int, what: str, because: str) -> Output:
        return WHY(Why(stamp_ns=now_ns, node="autopilot", what=what, because=because))

    def _results(self, verdicts: Sequence[Verdict | None], now_ns: int) -> Outputs:
        for verdict in verdicts:
            if verdict is not None:
                if not verdict.accepted:
                    self._authority.refused(verdict.kind)
                yield COMMAND_RESULT(
                    CommandResult(stamp_ns=now_ns, kind=verdict.kind, accepted=verdict.accepted, reason=verdict.reason)
                )
