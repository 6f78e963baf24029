"""What long work tells the outside while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Progress:
    """Where a job stands.

    ``done`` of ``total`` in the job's own unit (seconds of planned machine time, if not said otherwise); ``eta_s`` wall seconds left, None
    while there is no basis for an estimate.
    """

    stage: str
    done: float
    total: float
    eta_s: float | None
    message: str


ProgressSink = Callable[[Progress], None]


def ignore_progress(_: Progress) -> None:
    """A sink for callers that do not care."""
