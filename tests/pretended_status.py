"""A controller's status as a driver gives it, for tests that pretend a controller."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from abbe.drivers.api import Condition, ControllerStatus

READY = Condition.REMOTE | Condition.REFERENCED | Condition.DRIVES_ON
_AT_REST = ControllerStatus(
    host_s=0.0,
    ctrl_us=0,
    conditions=READY,
    position_mm=(0.0, 0.0, 0.0),
    path_points_done=0,
    path_start_us=0,
    path_end_us=0,
    override_percent=100,
    in_position_us=0,
)


def controller_status(conditions: Condition = READY, **changes: Any) -> ControllerStatus:
    """Ready and at rest, but for what is said."""
    return replace(_AT_REST, conditions=conditions, **changes)
