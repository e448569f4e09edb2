"""Thins out a stream of odometry by its stamps."""

from __future__ import annotations

from companion.core.messages import Odometry


class OdometryPace:
    """`is_due` for each message: true at a mean rate of `hz`, and at once after a reset of the estimator."""

    def __init__(self, hz: float) -> None:
        self._period_ns = round(1e9 / hz)
        self._due_ns: int | None = None
        self._resets = -1

    def is_due(self, odometry: Odometry) -> bool:
        """Whether this one is to be passed on."""
        stamp_ns, due_ns, period_ns = odometry.stamp_ns, self._due_ns, self._period_ns
        reset = odometry.reset_counter != self._resets
        if due_ns is not None and not reset and due_ns - period_ns < stamp_ns < due_ns:
            return False
        late = due_ns is None or reset or abs(stamp_ns - due_ns) > period_ns
        self._due_ns = (stamp_ns if late or due_ns is None else due_ns) + period_ns
        self._resets = odometry.reset_counter
        return True
