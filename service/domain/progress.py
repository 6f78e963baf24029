"""Progress of long work: one record from the work itself to page, JSON, OPC UA and MTConnect."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime

from abbe.service.domain.bounds import Number, Text, Word


@dataclass(frozen=True, slots=True)
class Progress:
    """Progress of work.

    ``done`` of ``total`` in the work's own unit (default: seconds of planned machine time); ``eta_s``: wall seconds left without waiting
    times, None without a basis for an estimate. Of a measurement: ``state`` (of `abbe.service.sequences.control`) and
    ``why`` it waits, ``step`` of ``steps`` and ``points`` read in the test in hand.
    """

    stage: Word = ""
    done: float = 0.0
    total: float = 0.0
    eta_s: float | None = None
    message: Text = ""
    state: Word = "running"
    why: Text = ""
    step: Number = 0
    steps: Number = 0
    points: Number = 0


ProgressSink = Callable[[Progress], None]


def ignore_progress(_: Progress) -> None:
    """A sink that ignores progress."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningCheck(Progress):
    """The running check and its progress. ``prompt``: number of the request to a person, 0 for none; ``ask``: its text.

    ``state`` is that of its job.
    """

    schedule: Word
    recipe: Word
    since_utc: datetime
    id: Word = ""
    prompt: Number = 0
    ask: Word = ""

    @property
    def percent(self) -> float | None:
        """Elapsed share of the planned time, percent; None if there is no plan."""
        return 100.0 * self.done / self.total if self.total > 0 else None
