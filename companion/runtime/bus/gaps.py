"""Samples that never came, by gaps in the senders' numbers."""

from __future__ import annotations

from companion.runtime.wire.keys import Attachment


class Gaps:
    """Of one topic; each sender counts for itself, from the first sample that was heard of it."""

    def __init__(self) -> None:
        self.lost = 0
        self._newest: dict[bytes, int] = {}

    def note(self, attachment: Attachment | None) -> None:
        """One sample has come; those without attachment are of no ROS 2 node and cannot be counted."""
        if attachment is None:
            return
        before = self._newest.get(attachment.gid)
        if before is not None and attachment.sequence <= before:
            return  # a latched sample once more, or one that was overtaken
        if before is not None:
            self.lost += attachment.sequence - before - 1
        self._newest[attachment.gid] = attachment.sequence
