"""Trends of the checks, and the timetable with its past slots, for the screens."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from abbe.service.domain.service_records import SlotRecord
from abbe.service.domain.verification import Verification
from abbe.service.queries.reader import Reader
from abbe.service.queries.results import trends
from abbe.service.queries.status import Status
from abbe.service.queries.timetable import NextDue, past_slots
from abbe.service.verification.trend_table import FigureTrend
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.page import trends as trend_plots
from abbe.service.web.pages.context import zone_of

CHECKS = 300
SLOTS = 30
AUDIT_ROWS = 200


@dataclass(frozen=True, slots=True)
class TrendLine:
    """A judged figure in the reader's units; ``trend``: result of the control chart."""

    name: str
    latest: str
    limit: str
    trend: FigureTrend


@dataclass(frozen=True, slots=True)
class TrendScreen:
    """Plots of all checks, and control charts of the checks with the table in force."""

    plots: Sequence[Markup]
    charts: Sequence[TrendLine]


@dataclass(frozen=True, slots=True)
class ScheduleLine:
    """A schedule: its next slot as text in the reader's language, and the outcome of past slots."""

    due: NextDue
    due_text: str
    slots: Sequence[SlotRecord]


def trend_screen(reader: Reader, past: Sequence[Verification], status: Status) -> TrendScreen:
    """Plots and control charts of the judged figures; ``past``: checks, newest first."""
    found = trends(reader, status.machine, limit=CHECKS)
    plots = trend_plots(past, zone_of(status), status.verified.changes)
    return TrendScreen(plots, [_line(one) for one in found.figures])


def _line(one: FigureTrend) -> TrendLine:
    """A trend in the reader's language and units."""
    name, unit = language.figure(current().lang, one.figure)
    frame, ours = current(), current().unit(unit)
    limit = "–" if one.limit is None else f"{frame.length(f'{one.limit:g}', unit)} {ours}"
    latest = f"{frame.length(f'{one.latest:.2f}', unit)} ± {frame.length(f'{one.expanded_uncertainty:.2f}', unit)} {ours}"
    return TrendLine(name, latest, limit, one)


def schedule_lines(reader: Reader, status: Status) -> list[ScheduleLine]:
    """All schedules with their latest slots."""
    lang = current().lang
    return [ScheduleLine(d, language.due(lang, d.due_utc, status.now_utc), past_slots(reader, d.schedule, SLOTS)) for d in status.next_due]
