"""Trends of a machine's checks from the stored verifications: one line for each judged figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any

from abbe.service.domain.results import VerificationRecord

if TYPE_CHECKING:  # a machine without checks has no trend, and a list of alarms computes none
    from abbe.models.arrays import F1
    from abbe.models.trend import Trend

DAY_S = 86400.0
COVERAGE = 2.0
"""Stored uncertainties are expanded (k = 2)."""

HEADINGS = ("figure", "checks", "latest", "U (k = 2)", "limit", "state", "since (UTC)", "change a day", "days until limit (95 %)")


@dataclass(frozen=True, slots=True, kw_only=True)
class FigureTrend:
    """Trend of one figure of a machine over its checks, in the figure's unit. Uncertainties have k = 2; unknown values are None.

    ``state``, ``direction``: result of the control chart (`abbe.models.trend.Trend`), whose latest values are the last four fields;
    ``since_utc``: first check of a drift; ``found_utc``: the check that detected it; ``reason``: why the days until the limit are
    unknown.
    """

    figure: str
    checks: int
    latest: float
    expanded_uncertainty: float
    limit: float | None
    state: str
    direction: int
    since_utc: datetime | None
    found_utc: datetime | None
    change_per_day: float | None
    change_per_day_u: float | None
    days_until_limit: float | None
    days_until_limit_95: tuple[float, float] | None
    reason: str
    cusum_high: float | None
    cusum_low: float | None
    ewma: float | None
    ewma_limit: float | None

    @property
    def ahead(self) -> str:
        """The days until the limit with their interval, or why they are unknown."""
        if self.days_until_limit is None or self.days_until_limit_95 is None:
            return self.reason
        low, high = self.days_until_limit_95
        return f"{_days(self.days_until_limit)} ({_days(low)} to {_days(high)})"


@dataclass(frozen=True, slots=True, eq=False)
class FigureChart:
    """One figure of the checks in order of time, with its control chart (`abbe.models.trend`).

    ``values``, ``expanded``: in the figure's unit, U with k = 2; ``limit``: limit in the latest check.
    """

    figure: str
    at: Sequence[datetime]
    values: F1
    expanded: F1
    limit: float | None
    found: Trend

    @property
    def centre(self) -> float:
        """The mean with which the chart compares: of the checks before a drift, or of all."""
        from abbe.models.trend import mean_of

        before = len(self.values) if self.found.since is None else max(self.found.since, 1)
        return mean_of(self.values[:before], self.expanded[:before] / COVERAGE)[0]

    @property
    def as_trend(self) -> FigureTrend:
        """Trend by the chart after the latest check."""
        found, ahead = self.found, self.found.forecast
        since, certain = (None if k is None else self.at[k] for k in (found.since, found.found))
        return FigureTrend(
            figure=self.figure,
            checks=len(self.at),
            latest=float(self.values[-1]),
            expanded_uncertainty=float(self.expanded[-1]),
            limit=self.limit,
            state=found.state,
            direction=found.direction,
            since_utc=since,
            found_utc=certain,
            change_per_day=_known(ahead.slope),
            change_per_day_u=_known(ahead.slope_u),
            days_until_limit=_known(ahead.days),
            days_until_limit_95=None if ahead.reason else (float(ahead.low), float(ahead.high)),
            reason=ahead.reason,
            cusum_high=_known(found.high[-1]),
            cusum_low=_known(found.low[-1]),
            ewma=_known(found.ewma[-1]),
            ewma_limit=_known(found.ewma_limit[-1]),
        )


def trends(records: Sequence[VerificationRecord], after_utc: datetime | None = None) -> list[FigureTrend]:
    """Trends by the charts of `charts` after the latest check."""
    return [one.as_trend for one in charts(records, after_utc)]


def charts(records: Sequence[VerificationRecord], after_utc: datetime | None = None) -> list[FigureChart]:
    """Control chart of every figure that has a limit in the latest check with figures.

    ``records`` may have any order; checks without a figure or a valid uncertainty are left out of its series. Only checks after
    ``after_utc`` are used, because a new table or a repair begins a new series.
    """
    docs = _docs(records, after_utc)
    if not docs:
        return []
    judged = [key for key, limit in docs[-1][1].get("limits", {}).items() if limit is not None]
    return [found for key in judged if (found := _of_figure(key, docs)) is not None]


def of_series(key: str, records: Sequence[VerificationRecord], after_utc: datetime | None) -> list[tuple[datetime, float, float]]:
    """One figure's series in order of time: time, value, expanded uncertainty."""
    return _rows(key, _docs(records, after_utc))


def _docs(records: Sequence[VerificationRecord], after_utc: datetime | None) -> list[tuple[datetime, dict[str, Any]]]:
    """Comparable checks with their times: measured, and within the allowed temperature."""
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


def _of_figure(key: str, docs: Sequence[tuple[datetime, dict[str, Any]]]) -> FigureChart | None:
    rows = _rows(key, docs)
    if not rows:
        return None
    import numpy as np

    from abbe.models.trend import trend

    limit = docs[-1][1]["limits"].get(key)
    days = np.array([(at - rows[0][0]).total_seconds() / DAY_S for at, _, _ in rows])
    values, expanded = np.array([v for _, v, _ in rows]), np.array([u for _, _, u in rows])
    return FigureChart(key, [at for at, _, _ in rows], values, expanded, limit, trend(days, values, expanded / COVERAGE, limit))


def _known(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def row(one: FigureTrend) -> tuple[str, ...]:
    """Cells of a trend under `HEADINGS`."""
    state = one.state if not one.direction else f"{one.state} {'up' if one.direction > 0 else 'down'}"
    slope = ""
    if one.change_per_day is not None and one.change_per_day_u is not None:
        slope = f"{one.change_per_day:+.3g} ± {COVERAGE * one.change_per_day_u:.2g}"
    limit = "" if one.limit is None else f"{one.limit:g}"
    since = "" if one.since_utc is None else f"{one.since_utc:%Y-%m-%d %H:%M}"
    figures = f"{one.latest:.2f}", f"{one.expanded_uncertainty:.2f}"
    return (one.figure, str(one.checks), *figures, limit, state, since, slope, one.ahead)


def _days(days: float) -> str:
    return f"{days:.1f}" if days < 10 else f"{days:.0f}"


def chart() -> dict[str, float]:
    """Settings of the control chart, for programs that draw it."""
    from abbe.models.trend import CUSUM_H, CUSUM_K, average_run_length

    return {"cusum_k": CUSUM_K, "cusum_h": CUSUM_H, "checks_to_a_false_alarm": round(average_run_length())}
