"""What long work tells the outside while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Place:
    """Where a measurement is: ``state`` (of its `Control`), why it waits, the run in hand, its step of ``steps``, points read."""

    state: str = "running"
    why: str = ""
    run: str = ""
    step: int = 0
    steps: int = 0
    points: int = 0


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a job stands.

    ``done`` of ``total`` in the job's own unit (seconds of planned machine time, if not said otherwise); ``eta_s`` wall seconds left, None
    while there is no basis for an estimate; time in which the job waited is not counted. ``place``: of a measurement only.
    """

    stage: str
    done: float
    total: float
    eta_s: float | None
    message: str
    place: Place | None = None


ProgressSink = Callable[[Progress], None]


def ignore_progress(_: Progress) -> None:
    """A sink for callers that do not care."""
