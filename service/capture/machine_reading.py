"""What the live screen shows of the machine: the latest answers of controller and laser, which the measurement asks for anyway."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from abbe.drivers.api import Condition, ControllerStatus, beam_is_good
from abbe.service.clock import Clock
from abbe.service.devices.session import Session, latest_reading, latest_status
from abbe.service.domain.progress import MachineReading

SHORTEST_S = 0.2
"""Shortest time between two positions from which a feed is computed, s."""
OLD_S = 5.0
"""An answer of the laser that is older, s, is not shown."""
MM_PER_COUNT = 1e-7
MM_MIN_PER_MM_US = 6e7


class LatestReading:
    """Return the latest state of a session's devices from their last answers, without a new query. Call it in the event loop."""

    def __init__(self, session: Session, clock: Clock, now_s: Callable[[], float] = time.monotonic) -> None:
        self._session, self._clock, self._now_s = session, clock, now_s
        self._before: ControllerStatus | None = None
        self._feed_mm_min: float | None = None

    def __call__(self) -> MachineReading | None:
        """The latest state; None before the controller's first answer. The feed is that of the path between two positions (chord)."""
        status = latest_status(self._session.controller)
        if status is None:
            return None
        self._note_feed(status)
        laser = None if self._session.laser is None else latest_reading(self._session.laser)
        if laser is not None and self._now_s() - laser.host_s > OLD_S:
            laser = None
        return MachineReading(
            at_ms=1e3 * (self._clock.utc().timestamp() - (self._now_s() - status.host_s)),
            position_mm=status.position_mm,
            feed_mm_min=self._feed_mm_min if status.moving else 0.0,
            override_percent=status.override_percent,
            door_open=Condition.DOOR_OPEN in status.conditions,
            air_c=None if laser is None else _finite(laser.air_temp_c),
            laser_mm=None if laser is None else laser.displacement_tenth_nm * MM_PER_COUNT,
            beam_good=laser is not None and beam_is_good(laser.status),
        )

    def _note_feed(self, status: ControllerStatus) -> None:
        before = self._before
        if before is not None and 0 <= status.ctrl_us - before.ctrl_us < SHORTEST_S * 1e6:
            return
        if before is not None and status.ctrl_us > before.ctrl_us:
            way_mm = math.dist(status.position_mm, before.position_mm)
            self._feed_mm_min = way_mm / (status.ctrl_us - before.ctrl_us) * MM_MIN_PER_MM_US
        self._before = status


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
