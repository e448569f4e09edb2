"""What is said when signatures, ours or the autopilot's, may be why it does not hear us or we do not count it."""

from __future__ import annotations

from typing import Final

from companion.autopilot.signing import Rejected, Signing

WANTS_A_KEY: Final = "the autopilot signs its messages: it may want ours signed, with its key"
_ANOTHER_KEY: Final = "frames come, but without a signature of our key: both sides need the same key file"


def key_trouble(signing: Signing | None, *, signed: bool, ready: bool, connected: bool) -> str:
    """Why a vehicle that is there does not count, or does not hear us; '' if keys cannot be the reason.

    `signed`: the autopilot's frames carry signatures.
    """
    if signing is None:
        return WANTS_A_KEY if signed and connected and not ready else ""
    return _ANOTHER_KEY if signing.rejected.total and not connected else ""


def rejected_words(rejected: Rejected) -> str:
    """How many frames did not pass, and why."""
    return (
        f"{rejected.unsigned} unsigned, {rejected.forged} of another key or altered, "
        f"{rejected.replayed} replayed or too old so far"
    )
