"""A node with a scripted autopilot on the other end of its link, and what that autopilot may say."""

from __future__ import annotations

from pymavlink.dialects.v20 import all as dialect

from companion.autopilot import codec
from companion.autopilot.node import AutopilotConfig, AutopilotNode
from companion.autopilot.wire import Parser
from companion.core.messages import MavlinkBytes
from companion.core.topics import MAVLINK_RX, MAVLINK_TX, VEHICLE

S, MS = 10**9, 10**6
OFFBOARD, HOLD = 6 << 16, 4 << 16 | 3 << 24
ESTIMATOR_GOOD = 1 | 2 | 4 | 8 | 32
PREARM = 1 << 28


class Flight:
    """A node with a scripted autopilot on the other end of the link."""

    def __init__(self, *, system=1, component=1, key=None, **config) -> None:
        self.node = AutopilotNode(AutopilotConfig(**config), signing_key=key)
        self.mav = dialect.MAVLink(None, srcSystem=system, srcComponent=component)
        self.out = []
        self.parser = Parser()

    def hear(self, now_ns, *messages, system=1, component=1):
        self.mav.srcSystem, self.mav.srcComponent = system, component
        for message in messages:
            data = bytes(message.pack(self.mav))
            self.mav.seq = (self.mav.seq + 1) & 0xFF
            self._take(self.node.handle(MAVLINK_RX, MavlinkBytes(stamp_ns=now_ns, data=data)))
        return self

    def tick(self, now_ns):
        self._take(self.node.tick("step", now_ns))
        return self

    def feed(self, topic, message):
        self._take(self.node.handle(topic, message))
        return self

    def _take(self, outputs):
        self.out += list(outputs)

    def published(self, topic):
        return [o.message for o in self.out if o.topic is topic]

    def sent(self, kind=None):
        """Decoded messages that went out since the last call."""
        frames = [f for m in self.published(MAVLINK_TX) for f in self.parser.feed(m.data)]
        self.out = [o for o in self.out if o.topic is not MAVLINK_TX]
        messages = [codec.decode(f) for f in frames]
        return [m for m in messages if kind is None or isinstance(m, kind)]

    @property
    def status(self):
        return self.published(VEHICLE)[-1]


def heartbeat(custom_mode=HOLD, *, armed=False, autopilot=12):
    return dialect.MAVLink_heartbeat_message(2, autopilot, 29 | (128 if armed else 0), custom_mode, 3, 3)


def sys_status(*, health=PREARM, battery=80):
    return dialect.MAVLink_sys_status_message(0, 0, health, 0, 16000, 100, battery, 0, 0, 0, 0, 0, 0)


def estimator(flags=ESTIMATOR_GOOD):
    return dialect.MAVLink_estimator_status_message(0, flags, 0, 0, 0, 0, 0, 0, 0, 0)


def position(x=2.0, y=1.0, z=-3.0):
    return dialect.MAVLink_local_position_ned_message(0, x, y, z, 0.2, 0.1, -0.3)


def landed(state=1):
    return dialect.MAVLink_extended_sys_state_message(0, state)


def ready_flight(now_ns=S, **config) -> Flight:
    flight = Flight(**config)
    flight.hear(now_ns - 2 * S, heartbeat())  # it listens for a second companion first
    return flight.hear(now_ns, heartbeat(), sys_status(), estimator(), position(), landed())
