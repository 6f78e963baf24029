"""The search for missing effects, with its progress."""

from __future__ import annotations

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.models.effects.effect import Effect
from abbe.service.clock import SystemClock
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.effects.axis_test import is_axis_test


def search(case: Case, effects: tuple[Effect, ...], sink: ProgressSink) -> Discovery:
    """Find effects that a case's model lacks (`abbe.models.discovery.discover`), and report progress and remaining time to ``sink``.

    A positioning test of one axis is first searched for a drift of its repeats (`abbe.service.discovery.axis_search`).
    """
    from abbe.models.discovery.discover import discover
    from abbe.service.discovery.axis_search import axis_discovery

    clock = SystemClock()
    begun = clock.monotonic_s()

    def report(text: str, share: float) -> None:
        spent = clock.monotonic_s() - begun
        sink(Progress("discover", share, 1.0, spent * (1.0 - share) / share if share > 0.0 else None, text))

    found = (axis_discovery if is_axis_test(case) else discover)(case, effects, progress=report)
    sink(Progress("discover", 1.0, 1.0, 0.0, "done"))
    return found
