"""The mission protocol: plans, fences and rally points are stored and given back; see `mission_flight` for flying.

Source: mavlink.io/en/services/mission.html.
"""

from __future__ import annotations

from typing import Any, Final

from sim.autopilot.codec import BY_NAME, Encoder, Frame

KINDS: Final = (0, 1, 2)  # mission, fence, rally
LIMIT: Final = 500
ACCEPTED, UNSUPPORTED, NO_SPACE, BAD_SEQUENCE, BAD_TYPE = 0, 3, 4, 13, 14
WAYPOINT, LOITER, LOITER_TIME, RETURN, LAND, TAKEOFF, DELAY, CHANGE_SPEED = 16, 17, 19, 20, 21, 22, 93, 178
MOVING: Final = frozenset({WAYPOINT, LOITER, LOITER_TIME, LAND, TAKEOFF, DELAY})
PASSED: Final = frozenset(
    {RETURN, CHANGE_SPEED, 195, 197, 201, 203, 204, 205, 206, 530, 531, 532, 1000, 1001, 2000, 2001, 2500, 2501}
)
"""Done in passing: what moves nothing (gimbal, camera, region of interest), and the return, which is another mode."""
NO_MISSION, NOT_STARTED, ACTIVE, PAUSED, COMPLETE = 1, 2, 3, 4, 5  # MISSION_STATE
REPEAT_NS: Final = 500_000_000
REPEATS: Final = 5


class MissionStore:
    """Uploads (one at a time, asked for item by item), downloads, clearing."""

    def __init__(self, encoder: Encoder) -> None:
        self._encoder = encoder
        self.items: dict[int, list[tuple[Any, ...]]] = {kind: [] for kind in KINDS}
        self.current = 0
        self.version = 0  # of the mission: counts uploads and clearings
        self.active = False  # flown now
        self.complete = self._begun = False
        self._reached: list[int] = []  # to be told
        self._coming: list[tuple[Any, ...]] = []
        self._count = self._kind = self._asked_ns = self._repeats = 0
        self._peer: tuple[int, int] | None = None

    def handle(self, now_ns: int, frame: Frame) -> bytes:
        """The answer to a frame of this protocol, else b""."""
        named, peer = frame.named, (frame.system, frame.component)
        kind = named.get("mission_type", 0)
        match frame.layout.name:
            case "MISSION_COUNT":
                return self._begin(now_ns, named["count"], kind, peer)
            case "MISSION_ITEM_INT":
                return self._take(now_ns, frame, named["seq"], kind, peer)
            case "MISSION_REQUEST_LIST":
                return self._encoder(BY_NAME["MISSION_COUNT"], len(self.items.get(kind, ())), *peer, kind)
            case "MISSION_REQUEST_INT" | "MISSION_REQUEST":
                return self._give(named["seq"], kind, peer)
            case "MISSION_CLEAR_ALL":
                for cleared in KINDS if kind == 255 else (kind,):
                    self._replace(cleared, [])
                return self._ack(ACCEPTED, kind, peer)
            case "MISSION_SET_CURRENT":
                self.go_to(named["seq"])
                return self.progress()
        return b""

    def progress(self) -> bytes:
        """MISSION_CURRENT."""
        total = len(self.items[0])
        mode = 1 if self.active else 2  # in mission mode, or not
        return self._encoder(BY_NAME["MISSION_CURRENT"], self.current, total or 65535, self._state, mode)

    @property
    def _state(self) -> int:
        if not self.items[0]:
            return NO_MISSION
        if self.complete:
            return COMPLETE
        if self.active:
            return ACTIVE
        return PAUSED if self._begun else NOT_STARTED

    # --- for who flies it ---------------------------------------------------------

    @property
    def flyable(self) -> bool:
        """There is a mission."""
        return bool(self.items[0])

    def moves(self, index: int) -> bool:
        """Whether an item is flown to or waited for, or done in passing."""
        return self.items[0][index][8] in MOVING

    def go_to(self, index: int) -> bool:
        """Make an item the current one; False if there is none of that number."""
        if index >= len(self.items[0]):
            return False
        self.current, self.complete = index, False
        return True

    def reached(self) -> None:
        """The current item is done: tell it, and go on to the next."""
        self._begun = True
        self._reached.append(self.current)
        self.complete = self.current + 1 >= len(self.items[0])
        if not self.complete:
            self.current += 1

    def due(self, now_ns: int) -> bytes:
        """What was reached; once more the question for an item that did not come."""
        told = b"".join(self._encoder(BY_NAME["MISSION_ITEM_REACHED"], index) for index in self._reached)
        if told:
            self._reached.clear()
            return told + self.progress()
        if self._peer is None or now_ns - self._asked_ns < REPEAT_NS:
            return b""
        self._repeats += 1
        if self._repeats > REPEATS:
            self._peer = None
            return b""
        return self._ask(now_ns)

    def _begin(self, now_ns: int, count: int, kind: int, peer: tuple[int, int]) -> bytes:
        if kind not in KINDS or count > LIMIT:
            return self._ack(BAD_TYPE if kind not in KINDS else NO_SPACE, kind, peer)
        self._coming, self._count, self._kind, self._peer = [], count, kind, peer
        return self._ask(now_ns) if count else self._finish()

    def _take(self, now_ns: int, frame: Frame, seq: int, kind: int, peer: tuple[int, int]) -> bytes:
        if self._peer != peer or kind != self._kind:
            return b""
        if seq > len(self._coming):
            return self._ack(BAD_SEQUENCE, kind, peer)
        if kind == 0 and frame.values[8] not in MOVING | PASSED:
            self._peer = None
            return self._ack(UNSUPPORTED, kind, peer)
        if seq == len(self._coming):  # a repeated older one is only asked past
            self._coming.append(frame.values)
        return self._ask(now_ns) if len(self._coming) < self._count else self._finish()

    def _finish(self) -> bytes:
        peer = self._peer or (0, 0)
        self._replace(self._kind, self._coming)
        self._peer = None
        return self._ack(ACCEPTED, self._kind, peer)

    def _replace(self, kind: int, items: list[tuple[Any, ...]]) -> None:
        self.items[kind] = items
        if kind == 0:
            self.current = 0
            self.version += 1
            self.complete = self._begun = False

    def _give(self, seq: int, kind: int, peer: tuple[int, int]) -> bytes:
        items = self.items.get(kind, [])
        if seq >= len(items):
            return self._ack(BAD_SEQUENCE, kind, peer)
        values = list(items[seq])
        values[9:11] = peer  # target system and component: now the one who asks
        return self._encoder(BY_NAME["MISSION_ITEM_INT"], *values)

    def _ask(self, now_ns: int) -> bytes:
        self._asked_ns = now_ns
        if self._peer is None:
            return b""
        return self._encoder(BY_NAME["MISSION_REQUEST_INT"], len(self._coming), *self._peer, self._kind)

    def _ack(self, result: int, kind: int, peer: tuple[int, int]) -> bytes:
        self._repeats = 0
        return self._encoder(BY_NAME["MISSION_ACK"], *peer, result, kind)
