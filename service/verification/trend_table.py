"""The trends of a machine's checks: one line for each figure that is judged, from the stored verifications."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

import numpy as np

from abbe.models.trend import CUSUM_H, CUSUM_K, Forecast, Trend, average_run_length, trend
from abbe.service.domain.results import VerificationRecord

DAY_S = 86400.0
COVERAGE = 2.0
"""Stored uncertainties are expanded (k = 2)."""

HEADINGS = ("figure", "checks", "latest", "U (k = 2)", "limit", "state", "since (UTC)", "change a day", "days until limit (95 %)")


@dataclass(frozen=True, slots=True)
class FigureTrend:
    """One figure of a machine over its checks. Units as in the figure's name; ``since_utc``: first check of a drift."""

    figure: str
    checks: int
    latest: float
    expanded: float
    limit: float | None
    since_utc: datetime | None
    found_utc: datetime | None
    trend: Trend


def trends(records: Sequence[VerificationRecord], after_utc: datetime | None = None) -> list[FigureTrend]:
    """Return the trend of every figure that has a limit in the latest check that has figures.

    Parameters
    ----------
    records : sequence of VerificationRecord
        In any order. Checks without a figure, or with an uncertainty that is none, are left out of that figure's series.
    after_utc : datetime, optional
        Only later checks: a new table, a repair, begins a new series.
    """
    docs = _docs(records, after_utc)
    if not docs:
        return []
    judged = [key for key, limit in docs[-1][1].get("limits", {}).items() if limit is not None]
    return [found for key in judged if (found := _of_figure(key, docs)) is not None]


def of_series(key: str, records: Sequence[VerificationRecord], after_utc: datetime | None) -> list[tuple[datetime, float, float]]:
    """One figure's series: when, value, expanded uncertainty, in order of time."""
    return _rows(key, _docs(records, after_utc))


def _docs(records: Sequence[VerificationRecord], after_utc: datetime | None) -> list[tuple[datetime, dict[str, Any]]]:
    """Checks whose figures can be put beside each other: measured, and in the air in which they can be judged."""
    usable = [one for one in records if one.doc.get("values") and one.doc.get("comparable", True)]
    docs = sorted(((_when(one), one.doc) for one in usable), key=lambda one: one[0])
    return [(at, doc) for at, doc in docs if after_utc is None or at > after_utc]


def _when(record: VerificationRecord) -> datetime:
    return datetime.fromisoformat(record.doc.get("started_utc") or record.utc)


def _rows(key: str, docs: Sequence[tuple[datetime, dict[str, Any]]]) -> list[tuple[datetime, float, float]]:
    rows = []
    for at, doc in docs:
        value, expanded = doc["values"].get(key), doc.get("uncertainties", {}).get(key)
        if value is not None and expanded is not None and expanded > 0:
            rows.append((at, float(value), float(expanded)))
    return rows


def _of_figure(key: str, docs: Sequence[tuple[datetime, dict[str, Any]]]) -> FigureTrend | None:
    rows = _rows(key, docs)
    if not rows:
        return None
    limit = docs[-1][1]["limits"].get(key)
    days = np.array([(at - rows[0][0]).total_seconds() / DAY_S for at, _, _ in rows])
    found = trend(days, np.array([v for _, v, _ in rows]), np.array([u / COVERAGE for _, _, u in rows]), limit)
    since, certain = (None if k is None else rows[k][0] for k in (found.since, found.found))
    return FigureTrend(key, len(rows), rows[-1][1], rows[-1][2], limit, since, certain, found)


def row(one: FigureTrend) -> tuple[str, ...]:
    """Return the cells of `HEADINGS`."""
    state = one.trend.state if not one.trend.direction else f"{one.trend.state} {'up' if one.trend.direction > 0 else 'down'}"
    ahead = one.trend.forecast
    slope = "" if math.isnan(ahead.slope) else f"{ahead.slope:+.3g} ± {COVERAGE * ahead.slope_u:.2g}"
    limit = "" if one.limit is None else f"{one.limit:g}"
    since = "" if one.since_utc is None else f"{one.since_utc:%Y-%m-%d %H:%M}"
    return (one.figure, str(one.checks), f"{one.latest:.2f}", f"{one.expanded:.2f}", limit, state, since, slope, in_words(ahead))


def in_words(ahead: Forecast) -> str:
    """Return the days until the limit with their interval, or why they are not known."""
    return ahead.reason or f"{_days(ahead.days)} ({_days(ahead.low)} to {_days(ahead.high)})"


def _days(days: float) -> str:
    return f"{days:.1f}" if days < 10 else f"{days:.0f}"


def as_doc(machine: str, found: Sequence[FigureTrend]) -> dict[str, Any]:
    """Return everything as JSON value; what is not known is null, with its reason beside it."""
    chart = {"cusum_k": CUSUM_K, "cusum_h": CUSUM_H, "checks_to_a_false_alarm": round(average_run_length())}
    return {"schema": 1, "machine": machine, "chart": chart, "figures": [_figure_doc(one) for one in found]}


def _figure_doc(one: FigureTrend) -> dict[str, Any]:
    ahead = one.trend.forecast
    return {
        "figure": one.figure,
        "checks": one.checks,
        "latest": one.latest,
        "expanded_uncertainty": one.expanded,
        "limit": one.limit,
        "state": one.trend.state,
        "direction": one.trend.direction,
        "since_utc": None if one.since_utc is None else one.since_utc.isoformat(),
        "found_utc": None if one.found_utc is None else one.found_utc.isoformat(),
        "change_per_day": _known(ahead.slope),
        "change_per_day_u": _known(ahead.slope_u),
        "days_until_limit": _known(ahead.days),
        "days_until_limit_95": None if ahead.reason else [_known(ahead.low), _known(ahead.high)],
        "reason": ahead.reason,
        "cusum_high": _known(float(one.trend.high[-1])),
        "cusum_low": _known(float(one.trend.low[-1])),
        "ewma": _known(float(one.trend.ewma[-1])),
        "ewma_limit": _known(float(one.trend.ewma_limit[-1])),
    }


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
