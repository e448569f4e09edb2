"""Put this process before others that want the processor, where the system allows it."""

from __future__ import annotations

import os

LEVEL = 10  # of 1..99: before everything ordinary, behind what a system runs for itself


def run_first() -> bool:
    """Real-time round robin for this thread and those it starts; False if not allowed.

    Control must not wait for mapping. Allowed to root, and to others by `LimitRTPRIO` (systemd) or
    an entry `rtprio` in limits.conf.
    """
    if not hasattr(os, "sched_setscheduler"):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LEVEL))
    except PermissionError:
        return False
    return True
