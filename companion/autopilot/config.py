"""Whom the autopilot node talks to, and how."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec

from companion.autopilot.timesync import TimesyncConfig

_Id = Annotated[int, msgspec.Meta(ge=1, le=255)]
_Count = Annotated[int, msgspec.Meta(ge=1)]
_Seconds = Annotated[float, msgspec.Meta(gt=0)]


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
