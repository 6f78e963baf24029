"""The state of the service as one message: board, running job, due slots, what needs a person."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

from abbe.service.channel.messages import Snapshot
from abbe.service.clock import Clock
from abbe.service.core.board import Board
from abbe.service.core.jobs import JobRegistry
from abbe.service.domain.bounds import TEXT, WORD
from abbe.service.domain.progress import RunningCheck
from abbe.service.domain.schedule import DueSlot, Schedule

AGAIN = timedelta(minutes=1)
"""The timetable is evaluated at most this often, unless a slot has come due: it changes only then."""


class SnapshotSource:
    """Makes snapshots from the board, the registry of jobs (``jobs``), the timetable (``next_due``) and the clock."""

    def __init__(self, board: Board, jobs: JobRegistry, next_due: Callable[[], Sequence[tuple[Schedule, datetime]]], clock: Clock) -> None:
        self._board, self._jobs, self._next_due, self._clock = board, jobs, next_due, clock
        self._due: tuple[DueSlot, ...] = ()
        self._looked: datetime | None = None

    def now(self, web_restarts: int) -> Snapshot:
        """Return the present state of the service."""
        board = self._board
        devices = tuple(replace(d, role=d.role[:WORD], url=d.url[:TEXT], text=d.text[:TEXT]) for d in board.devices)
        attention = tuple(text[:TEXT] for text in board.attention)
        return Snapshot(
            "moment",
            board.changes,
            self._check(),
            devices,
            self._slots(),
            board.mqtt_connected,
            board.mqtt_dropped,
            attention,
            rss_bytes(),
            web_restarts,
        )

    def _check(self) -> RunningCheck | None:
        check, job = self._board.job, self._jobs.running
        if check is None:
            return None
        if job is not None:
            check = replace(check, id=job.id, state=job.state, prompt=job.prompt, ask=job.ask)
        return replace(
            check,
            schedule=check.schedule[:WORD],
            recipe=check.recipe[:WORD],
            stage=check.stage[:WORD],
            message=check.message[:TEXT],
            why=check.why[:TEXT],
            done=check.done if math.isfinite(check.done) else 0.0,
            total=check.total if math.isfinite(check.total) else 0.0,
            eta_s=check.eta_s if check.eta_s is not None and math.isfinite(check.eta_s) else None,
        )

    def _slots(self) -> tuple[DueSlot, ...]:
        now = self._clock.utc()
        come = any(due.slot_utc <= now for due in self._due)
        if self._looked is None or come or not self._looked <= now < self._looked + AGAIN:
            self._looked = now
            self._due = tuple(DueSlot(schedule=schedule, slot_utc=slot) for schedule, slot in self._next_due()[:200])
        return self._due


def rss_bytes() -> int:
    """Return the resident memory of this process, bytes; 0 where the system does not report it."""
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError, AttributeError):
        return 0
