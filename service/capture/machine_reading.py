"""The machine's state on the live screen: the latest answers of controller and laser to the queries of the measurement."""

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
"""Answers older than this, s, are not shown."""
MOST_PERCENT = 1000.0
"""Largest plausible override, %. Assumed, because no standard names one: no operator's switch reaches ten times the programmed feed, so
a larger number was misread."""
MM_PER_COUNT = 1e-7
MM_MIN_PER_MM_US = 6e7


class LatestReading:
    """Return the latest state of a session's devices from their last answers, without a new query. Call it in the event loop."""

    def __init__(self, session: Session, clock: Clock, now_s: Callable[[], float] = time.monotonic) -> None:
        self._session, self._clock, self._now_s = session, clock, now_s
        self._before: ControllerStatus | None = None
        self._feed_mm_min: float | None = None
        self._stamps: dict[str, tuple[float, float]] = {}

    def __call__(self) -> MachineReading | None:
        """Return the latest state. Its feed is the distance between two positions (chord) over the time between them.

        None before the controller's first answer, if its last answer is older than `OLD_S`, or if a position is not finite.
        """
        status = latest_status(self._session.controller)
        if status is None or self._is_old(status.host_s) or not all(math.isfinite(x) for x in status.position_mm):
            return None
        self._note_feed(status)
        laser = None if self._session.laser is None else latest_reading(self._session.laser)
        if laser is not None and self._is_old(laser.host_s):
            laser = None
        return MachineReading(
            at_ms=self._utc_ms("controller", status.host_s),
            position_mm=status.position_mm,
            feed_mm_min=self._feed_mm_min if status.moving else 0.0,
            override_percent=_percent(status.override_percent),
            door_open=Condition.DOOR_OPEN in status.conditions,
            air_c=None if laser is None else _finite(laser.air_temp_c),
            laser_at_ms=None if laser is None else self._utc_ms("laser", laser.host_s),
            laser_mm=None if laser is None else laser.displacement_tenth_nm * MM_PER_COUNT,
            beam_good=laser is not None and beam_is_good(laser.status),
        )

    def _is_old(self, host_s: float) -> bool:
        return self._now_s() - host_s > OLD_S

    def _utc_ms(self, of: str, host_s: float) -> float:
        """UTC of an answer, computed once: the page recognizes a new answer by its time."""
        if of not in self._stamps or self._stamps[of][0] != host_s:
            self._stamps[of] = host_s, 1e3 * (self._clock.utc().timestamp() - (self._now_s() - host_s))
        return self._stamps[of][1]

    def _note_feed(self, status: ControllerStatus) -> None:
        before = self._before
        if before is not None and 0 <= status.ctrl_us - before.ctrl_us < SHORTEST_S * 1e6:
            return
        if before is not None and status.ctrl_us > before.ctrl_us:
            way_mm = math.dist(status.position_mm, before.position_mm)
            self._feed_mm_min = _finite(way_mm / (status.ctrl_us - before.ctrl_us) * MM_MIN_PER_MM_US)
        self._before = status


def _percent(value: float) -> int | None:
    """Return the override as a whole percentage; None if the control reports an impossible one."""
    return round(value) if math.isfinite(value) and 0.0 <= value <= MOST_PERCENT else None


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
