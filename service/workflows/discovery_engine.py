"""What a discovery computes with: the catalogue with its plug-ins, and the search. The one place that knows both by name."""

from __future__ import annotations

from difflib import get_close_matches
from functools import cache

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.effect import Effect
from abbe.service.clock import SystemClock
from abbe.service.errors import EffectUnknown
from abbe.service.events import Progress, ProgressSink
from abbe.service.workflows.axis_test import SLOW_DRIFT, is_axis_test
from abbe.service.workflows.effect_plugins import Plugins, installed


def catalogue() -> tuple[Effect, ...]:
    """All effects that are known by name: ours, then those of other packages that passed the self-test."""
    return CATALOGUE + plugins().effects


@cache
def plugins() -> Plugins:
    """Effects of other packages, looked up once per process, and why some were left out."""
    return installed(e.name for e in CATALOGUE)


def effect_named(name: str) -> Effect:
    """One effect of the catalogue.

    Raises
    ------
    EffectUnknown
        There is none; what is spelt alike is told.
    """
    found = {e.name: e for e in (*catalogue(), SLOW_DRIFT)}
    if name not in found:
        close = get_close_matches(name, found, n=3, cutoff=0.4)
        raise EffectUnknown(
            f"the catalogue has no effect {name!r}", f"did you mean {', '.join(close)}?" if close else "`abbe effects` lists all"
        )
    return found[name]


def search(case: Case, effects: tuple[Effect, ...], sink: ProgressSink) -> Discovery:
    """Find what a case's present model lacks (`abbe.models.discovery.discover`), and tell how far it is and how long it will take.

    In a positioning test of one axis alone repeats are asked for a drift first (`abbe.service.workflows.axis_search`).
    """
    from abbe.models.discovery.discover import discover
    from abbe.service.workflows.axis_search import axis_discovery

    clock = SystemClock()
    begun = clock.monotonic_s()

    def tell(text: str, share: float) -> None:
        spent = clock.monotonic_s() - begun
        sink(Progress("discover", share, 1.0, spent * (1.0 - share) / share if share > 0.0 else None, text))

    found = (axis_discovery if is_axis_test(case) else discover)(case, effects, progress=tell)
    sink(Progress("discover", 1.0, 1.0, 0.0, "done"))
    return found
