"""What a check does to the alarm of its recipe: its signals, from limits, jumps, drifts and forecasts."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from abbe.models.trend import MIN_CHECKS, MOST_CHECKS, jumps, mean_of
from abbe.service.domain.results import VerificationRecord
from abbe.service.domain.service_records import AlarmFacts, AlarmKind, Signal
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import JournalView
from abbe.service.verification.alarm_states import Alarm, FiredRule, after_check
from abbe.service.verification.alarms import active_alarm
from abbe.service.verification.trend_table import COVERAGE, FigureTrend, of_series, trends
from abbe.service.verification.verify import NAMES, judge


@dataclass(frozen=True, slots=True)
class AlarmTerms:
    """The checks to evaluate (those of ``recipe`` after ``begins_utc``), and when they raise an alarm.

    ``warn_days``: warn so many days ahead of the limit, 0 for never. ``compare``: figure -> value and standard uncertainty before the
    active alarm, so that the figures after a jump do not become its reference.
    """

    recipe: str
    begins_utc: datetime | None = None
    warn_days: float = 0.0
    compare: Mapping[str, tuple[float, float]] | None = None


def found_in(records: Sequence[VerificationRecord], terms: AlarmTerms) -> FiredRule:
    """Signals of the latest check of a recipe, compared with earlier ones. ``records``: checks of one machine, newest first."""
    mine = [r for r in records if r.doc.get("recipe") == terms.recipe]
    if not mine or not mine[0].doc.get("values") or not mine[0].doc.get("comparable", True):
        return FiredRule(False, "cannot tell")
    found = [signal for one in trends(mine, terms.begins_utc) for signal in _of_figure(one, mine, terms)]
    return FiredRule(True, mine[0].verdict, tuple(found))


def _of_figure(one: FigureTrend, records: Sequence[VerificationRecord], terms: AlarmTerms) -> Iterator[Signal]:
    if one.limit is None or records[0].doc["values"].get(one.figure) is None:
        return
    limit, value, u = one.limit, one.latest, one.expanded_uncertainty / COVERAGE
    name, unit = NAMES.get(one.figure, one.figure), " µm" if one.figure.endswith("_um") else ""
    reading = f"{name} {value:.1f} ± {one.expanded_uncertainty:.1f}{unit} (U, k = 2)"
    if judge(value, u, limit) == "fail":
        yield Signal(one.figure, "limit", value, one.expanded_uncertainty, limit, f"{reading} is above its limit of {limit:g}{unit}")
    before = _before(one, records, terms)
    if before is not None and jumps(value - before[0], float(np.hypot(u, before[1])), limit):
        expanded = COVERAGE * float(np.hypot(u, before[1]))
        text = f"{reading} differs by {value - before[0]:+.1f} ± {expanded:.1f}{unit} from the checks before"
        yield Signal(one.figure, "jump", value, one.expanded_uncertainty, limit, text, *before)
    if one.direction > 0:
        since = "" if one.since_utc is None else f" since {one.since_utc:%Y-%m-%d %H:%M} UTC"
        yield Signal(one.figure, "drift", value, one.expanded_uncertainty, limit, f"{reading} drifts up{since}")
    if terms.warn_days and one.days_until_limit_95 is not None and one.days_until_limit_95[0] < terms.warn_days:
        text = f"{name} reaches its limit of {limit:g}{unit} in {one.ahead} days (95 %)"
        yield Signal(one.figure, "days", value, one.expanded_uncertainty, limit, text)


def _before(one: FigureTrend, records: Sequence[VerificationRecord], terms: AlarmTerms) -> tuple[float, float] | None:
    """Reference for a jump (value, standard uncertainty): ``terms.compare``, or the mean of a few earlier checks; None: no reference."""
    kept = (terms.compare or {}).get(one.figure)
    if kept is not None:
        return kept
    rows = of_series(one.figure, records, terms.begins_utc)[:-1]
    if not 0 < len(rows) < MIN_CHECKS - 1:
        return None
    return mean_of(np.array([v for _, v, _ in rows]), np.array([expanded / COVERAGE for _, _, expanded in rows]))


READ_CHECKS = 4 * MOST_CHECKS
"""Number of checks to read: several recipes share it, and the trend of each uses at most `MOST_CHECKS`."""


@dataclass(frozen=True, slots=True)
class AlarmCheck:
    """Effect of a check on the alarm of its recipe; ``kind`` None: no effect."""

    kind: AlarmKind | None
    now: Alarm | None
    found: FiredRule


def series_begins(store: Store, machine: str) -> datetime | None:
    """Time at which the table in force came into force; earlier checks cannot be compared. None: Abbe has put no table into force.

    A push that was rolled back does not begin a new series. Tables written by others are unknown here.
    """
    changed = JournalView.read(store, machine, origins=False).changes
    return datetime.fromisoformat(changed[-1].utc) if changed else None


def evaluate_alarm(store: Store, machine: str, recipe: str, records: Sequence[VerificationRecord], warn_days: float) -> AlarmCheck:
    """Compare the latest check of a recipe with earlier ones and with the active alarm. Nothing is written."""
    begins, now = series_begins(store, machine), active_alarm(store, machine, recipe)
    compare = None
    if now is not None and (begins is None or begins < now.raised_utc):
        compare = {s.figure: (s.baseline, s.baseline_u) for s in now.first if s.baseline is not None and s.baseline_u is not None}
    found = found_in(records, AlarmTerms(recipe, begins, warn_days, compare))
    return AlarmCheck(after_check(now, found), now, found)


def check_facts(check: AlarmCheck, recipe: str, schedule: str, verification: int) -> AlarmFacts:
    """Facts of a check for its alarm line."""
    found = check.found
    return AlarmFacts(recipe=recipe, schedule=schedule, verification=verification, signals=found.signals, text=found.text)
