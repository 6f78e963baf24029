"""The check that runs."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from abbe.service.domain.bounds import Number, Text, Word


@dataclass(frozen=True, slots=True, kw_only=True)
class RunningCheck:
    """The check that runs now. ``prompt``: number of what a person is asked to do, ``ask``: what that is; 0: nothing.

    ``state``: of `abbe.service.sequences.control`; ``done`` of ``total`` s of planned machine time; ``step`` of ``steps`` and ``points``
    read: of the test in hand.
    """

    schedule: Word
    recipe: Word
    since_utc: datetime
    id: Word = ""
    state: Word = "running"
    stage: Word = ""
    message: Text = ""
    done: float = 0.0
    total: float = 0.0
    eta_s: float | None = None
    step: Number = 0
    steps: Number = 0
    points: Number = 0
    prompt: Number = 0
    ask: Word = ""

    @property
    def percent(self) -> float | None:
        """Share of the planned time that is over; None: it is not planned."""
        return 100.0 * self.done / self.total if self.total > 0 else None
