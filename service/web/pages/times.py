"""Trends of the checks, and the timetable with its past slots, for the screens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta, tzinfo

import numpy as np
from markupsafe import Markup

from abbe.models.arrays import F1
from abbe.models.trend import CUSUM_H
from abbe.service.domain.document import Doc
from abbe.service.domain.service_records import SlotRecord
from abbe.service.domain.verification import Verification
from abbe.service.queries.checks import charts
from abbe.service.queries.reader import Reader
from abbe.service.queries.status import AlarmSummary, Status, alarms
from abbe.service.queries.timetable import NextDue, past_slots
from abbe.service.rendering.numbers import with_uncertainty
from abbe.service.verification.trend_table import FigureChart, FigureTrend
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.page import figures, points_of, trend_picture
from abbe.service.web.pages.context import zone_of
from abbe.service.web.trend import Point
from abbe.service.web.units import converted

CHECKS = 366
"""Number of latest checks in a trend: a year of daily ones."""
SLOTS = 30
PLOT_WORDS = ("check.open", "plot.at", "plot.share", "verdict.cannot tell", "verdict.fail", "verdict.pass")
VERDICTS = ("pass", "cannot tell", "fail")


@dataclass(frozen=True, slots=True)
class TrendLine:
    """A judged figure in the reader's units; ``trend``: result of the control chart."""

    name: str
    latest: str
    limit: str
    trend: FigureTrend


@dataclass(frozen=True, slots=True)
class TrendPlot:
    """All checks of a figure: the series that the page's script draws or, where it draws none, a picture."""

    picture: Markup | None
    series: Doc | None


@dataclass(frozen=True, slots=True)
class TrendScreen:
    """Plots of all checks, and control charts of the checks with the table in force."""

    plots: Sequence[TrendPlot]
    charts: Sequence[TrendLine]


@dataclass(frozen=True, slots=True)
class ScheduleLine:
    """A schedule: its next slot as text in the reader's language, and the outcome of past slots."""

    due: NextDue
    due_text: str
    slots: Sequence[SlotRecord]


def trend_screen(reader: Reader, past: Sequence[Verification], status: Status, *, pictures: bool) -> TrendScreen:
    """Plots and control charts of the judged figures; ``past``: checks, newest first; ``pictures``: no script draws."""
    zone, changes = zone_of(status), status.verified.changes
    found = {one.figure: one for one in charts(reader, status.machine, status.verified.since, CHECKS)}
    known = alarms(reader.store, status.machine, every=True)
    plots = []
    for key in figures(past):
        points = points_of(past, key, changes)
        if points:
            chart = None if pictures else found.get(key)
            series = None if chart is None else trend_series(chart, points, zone, _marks(key, changes, known))
            plots.append(TrendPlot(trend_picture(key, points, zone, changes) if series is None else None, series))
    return TrendScreen(plots, [_line(one.as_trend) for one in found.values()])


def _marks(key: str, changes: Sequence[datetime], known: Sequence[AlarmSummary]) -> list[tuple[datetime, str, str, str]]:
    """Time, kind, sign and text of what happened to a figure: another table, an alarm raised and over."""
    frame = current()
    marks = [(at, "table", "┊", frame.translate("plot.table")) for at in changes]
    for one in known:
        if any(signal.figure == key for signal in one.signals):
            text = f"{frame.translate('alarm')} {one.alarm}"
            marks.append((one.raised_utc, "alarm", "▲", f"{text} {frame.state('alarm.kind', 'raised')}"))
            if one.cleared_utc is not None:
                marks.append((one.cleared_utc, "over", "▽", f"{text} {frame.state('alarm.kind', 'cleared')}"))
    return marks


def trend_series(chart: FigureChart, points: Sequence[Point], zone: tzinfo, marks: Sequence[tuple[datetime, str, str, str]]) -> Doc:
    """Data of the script: points, control chart, forecast and marks of a figure in the reader's unit; times in s since 1970.

    ``value``, ``u``: one text each for all points, separated by spaces; a value and its U are rounded together. ``bare``: pairs of index
    and value of the points without U. Columns of the chart have one entry for each point, None without a value.
    """
    frame = current()
    name, unit = language.figure(frame.lang, chart.figure)
    points = sorted(points, key=lambda point: point.at)
    shown = [with_uncertainty(point.value, point.uncertainty / 2.0 or None) for point in points]
    place = {_s(at): k for k, at in enumerate(chart.at)}
    at = [place.get(_s(point.at)) for point in points]
    limits = [None if point.limit is None else _short(point.limit) for point in points]
    found = chart.found
    return {
        "key": chart.figure,
        "name": name,
        "unit": frame.unit(unit),
        "zone": str(zone),
        "x": [_s(point.at) for point in points],
        "value": " ".join(value for value, _ in shown),
        "u": " ".join(u for _, u in shown),
        "bare": [[k, _short(point.value)] for k, point in enumerate(points) if not point.uncertainty > 0.0],
        "limit": [[k, one] for k, one in enumerate(limits) if not k or one != limits[k - 1]],
        "verdict": "".join(str(VERDICTS.index(point.verdict)) for point in points),
        "earlier": sum(point.earlier for point in points),
        "check": [int(point.href.rpartition("=")[2]) for point in points],
        "centre": _short(converted(chart.centre, unit, frame.units)),
        "cone": _cone(chart, unit),
        "marks": [{"at": _s(at), "kind": kind, "sign": sign, "text": text} for at, kind, sign, text in marks],
        "chart": {
            "h": CUSUM_H,
            "high": _column(found.high, at),
            "low": _column(found.low, at),
            "ewma": _column(found.ewma, at),
            "ewma_limit": _column(found.ewma_limit, at),
        },
    }


def _cone(chart: FigureChart, unit: str) -> Doc | None:
    """The forecast from the last check on: its fitted value, and the times at which the limit is reached; None without a forecast."""
    ahead, last, limit = chart.found.forecast, chart.at[-1], chart.limit
    if limit is None or not np.isfinite(ahead.high) or ahead.days == 0.0:
        return None
    level = converted(limit - ahead.slope * ahead.days, unit, current().units)
    low, days, high = (_s(last + timedelta(days=one)) for one in (ahead.low, ahead.days, ahead.high))
    ends = {"low": low, "days": days, "high": high, "limit": _short(converted(limit, unit, current().units))}
    return {"at": _s(last), "value": _short(level)} | ends


def _s(at: datetime) -> int:
    return round(at.timestamp())


def _short(value: float, digits: int = 6) -> float | None:
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def _column(values: F1, at: Sequence[int | None]) -> list[float | None]:
    """Values of a chart, one for each point, rounded to the digits that a screen can show."""
    return [None if k is None else _short(values[k], 4) for k in at]


def _line(one: FigureTrend) -> TrendLine:
    """A trend in the reader's language and units."""
    name, unit = language.figure(current().lang, one.figure)
    frame, ours = current(), current().unit(unit)
    limit = "–" if one.limit is None else f"{frame.length(f'{one.limit:g}', unit)} {ours}"
    value, expanded = frame.with_u(one.latest, one.expanded_uncertainty / 2.0, unit)
    return TrendLine(name, f"{value} ± {expanded} {ours}", limit, one)


def schedule_lines(reader: Reader, status: Status) -> list[ScheduleLine]:
    """All schedules with their latest slots."""
    lang = current().lang
    return [ScheduleLine(d, language.due(lang, d.due_utc, status.now_utc), past_slots(reader, d.schedule, SLOTS)) for d in status.next_due]
