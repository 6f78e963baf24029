"""Which signals a machine's checks give: above a limit, a jump, a drift, few days until the limit. From stored verifications alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from abbe.models.trend import MIN_CHECKS, Forecast, jumps, mean_of
from abbe.service.storage.records import VerificationRecord
from abbe.service.verification.alarm_states import Found, Signal
from abbe.service.verification.trend_table import COVERAGE, FigureTrend, in_words, of_series, trends
from abbe.service.verification.verify import judge

NAMES = {"body_diagonal_um": "worst body diagonal", "helix_rms_um": "helix rms"}


@dataclass(frozen=True, slots=True)
class Terms:
    """What counts: checks of ``recipe`` after ``begins_utc``; ``warn_days``: 0 for no warning ahead.

    ``compare``: figure -> value and standard uncertainty before the alarm that is active now: what jumped must not become habit.
    """

    recipe: str
    begins_utc: datetime | None = None
    warn_days: float = 0.0
    compare: Mapping[str, tuple[float, float]] | None = None


def found_in(records: Sequence[VerificationRecord], terms: Terms) -> Found:
    """What the latest check of a recipe says of alarms, beside those before it.

    Parameters
    ----------
    records : sequence of VerificationRecord
        Checks of one machine, newest first, as the store gives them.
    terms : Terms
        Which of them count.
    """
    mine = [r for r in records if r.doc.get("recipe") == terms.recipe]
    if not mine or not mine[0].doc.get("values") or not mine[0].doc.get("comparable", True):
        return Found(False, "cannot tell")
    found = [signal for one in trends(mine, terms.begins_utc) for signal in _of_figure(one, mine, terms)]
    return Found(True, mine[0].verdict, tuple(found))


def _of_figure(one: FigureTrend, records: Sequence[VerificationRecord], terms: Terms) -> Iterator[Signal]:
    if one.limit is None or records[0].doc["values"].get(one.figure) is None:
        return
    limit, value, u = one.limit, one.latest, one.expanded / COVERAGE
    name, unit = NAMES.get(one.figure, one.figure), " µm" if one.figure.endswith("_um") else ""
    said = f"{name} {value:.1f} ± {one.expanded:.1f}{unit} (U, k = 2)"
    if judge(value, u, limit) == "fail":
        yield Signal(one.figure, "limit", value, one.expanded, limit, f"{said} is above its limit of {limit:g}{unit}")
    before = _before(one, records, terms)
    if before is not None and jumps(value - before[0], float(np.hypot(u, before[1])), limit):
        expanded = COVERAGE * float(np.hypot(u, before[1]))
        text = f"{said} is {value - before[0]:+.1f} ± {expanded:.1f}{unit} from the checks before"
        yield Signal(one.figure, "jump", value, one.expanded, limit, text, *before)
    ahead = one.trend.forecast
    if one.trend.direction > 0:
        since = "" if one.since_utc is None else f" since {one.since_utc:%Y-%m-%d %H:%M} UTC"
        yield Signal(one.figure, "drift", value, one.expanded, limit, f"{said} drifts up{since}")
    if terms.warn_days and not ahead.reason and ahead.low < terms.warn_days:
        yield Signal(one.figure, "days", value, one.expanded, limit, _days_text(name, limit, unit, ahead))


def _days_text(name: str, limit: float, unit: str, ahead: Forecast) -> str:
    return f"{name} reaches its limit of {limit:g}{unit} in {in_words(ahead)} days (95 %)"


def _before(one: FigureTrend, records: Sequence[VerificationRecord], terms: Terms) -> tuple[float, float] | None:
    """What the latest figure is compared with while too few checks have shown their spread."""
    kept = (terms.compare or {}).get(one.figure)
    if kept is not None:
        return kept
    rows = of_series(one.figure, records, terms.begins_utc)[:-1]
    if not 0 < len(rows) < MIN_CHECKS - 1:
        return None
    return mean_of(np.array([v for _, v, _ in rows]), np.array([expanded / COVERAGE for _, _, expanded in rows]))
