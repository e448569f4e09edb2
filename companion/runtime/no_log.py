"""A log that keeps nothing, for groups that are not to be replayed."""

from __future__ import annotations

from typing import Any

from companion.core.node import Topic


class NoLog:
    """Numbers nothing, notes nothing."""

    def received(self, now_ns: int, topic: Topic[Any], message: Any) -> int:
        """Forget it."""
        return 0

    def published(self, now_ns: int, source: str, topic: Topic[Any], message: Any) -> int:
        """Forget it."""
        return 0

    def fed(self, now_ns: int, node: str, event: str, number: int) -> None:
        """Forget it."""
