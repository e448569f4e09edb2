"""What the wire refuses from the other side; what the user writes is refused with InputError."""

from __future__ import annotations

from companion.core.errors import CompanionError


class WireError(CompanionError):
    """Bytes from the bus are not what their type says; drop the sample."""
