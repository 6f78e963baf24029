"""How far a measurement is, when it will be done, and why it waits: as events for whoever draws them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from abbe.service.clock import Clock
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.sequences.control import Control, State

WAITING = (State.PAUSED, State.SUSPENDED)


@dataclass
class ProgressMeter:
    """Progress of a job in planned machine seconds; the wall time per machine second so far gives the ETA.

    The time in which the job waited for a person (``waited_s``) says nothing about the machine and does not count.
    """

    stage: str
    total_s: float
    sink: ProgressSink
    clock: Clock
    done_s: float = 0.0
    start_s: float = field(default=0.0)
    waited_s: float = 0.0
    skipped_s: float = 0.0
    control: Control | None = None
    message: str = ""
    _at_s: float = 0.0
    _waits_since_s: float | None = None

    def __post_init__(self) -> None:
        """Start the stopwatch."""
        self.start_s = self.clock.monotonic_s()

    def at(self, done_s: float, message: str, waited_s: float = 0.0) -> None:
        """Report how far the job is, and how long the last step waited for a person."""
        self.waited_s += waited_s
        self.message, self._at_s = message, done_s
        self._report(self._eta_s(done_s))

    async def tell(self) -> None:
        """Report every pause and suspension as it begins and ends; a suspension's time is left out of the ETA."""
        if self.control is None:
            return
        async for now in self.control.watch():
            if now.state in WAITING:
                self.waits()
                self._report(None)
            else:
                self.goes_on()

    def waits(self) -> None:
        """The job waits from now on."""
        if self._waits_since_s is None:
            self._waits_since_s = self.clock.monotonic_s()

    def goes_on(self) -> None:
        """It does not wait any more."""
        if self._waits_since_s is not None:
            self.waited_s += self.clock.monotonic_s() - self._waits_since_s
            self._waits_since_s = None

    def skip(self, duration_s: float) -> None:
        """Planned time of what was complete before this job began: it says nothing about how fast this one is."""
        self.done_s += duration_s
        self.skipped_s += duration_s

    def _eta_s(self, done_s: float) -> float | None:
        elapsed, made_s = self.clock.monotonic_s() - self.start_s - self.waited_s, done_s - self.skipped_s
        return elapsed / made_s * (self.total_s - done_s) if made_s > 0.02 * self.total_s else None

    def _report(self, eta_s: float | None) -> None:
        now = self.control.progress if self.control is not None else Progress()
        self.sink(replace(now, stage=self.stage, done=self._at_s, total=self.total_s, eta_s=eta_s, message=self.message))
