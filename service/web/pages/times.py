"""What happened and what comes: trends of the checks, and the timetable with its past slots."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from markupsafe import Markup

from abbe.service.domain.results import VerificationRecord
from abbe.service.domain.service_records import SlotRecord
from abbe.service.storage.store import Store
from abbe.service.verification.trend_table import FigureTrend, in_words
from abbe.service.verification.trend_table import trends as figure_trends
from abbe.service.web import language
from abbe.service.web.frame import current
from abbe.service.web.page import trends
from abbe.service.web.pages.desk import zone_of
from abbe.service.web.schemas import Due, Status, Verification, Verified

CHECKS = 300
SLOTS = 30
AUDIT_ROWS = 200


@dataclass(frozen=True, slots=True)
class TrendLine:
    """One judged figure: what the control chart says, and when the limit will be reached."""

    name: str
    checks: int
    latest: str
    limit: str
    state: str
    direction: int
    since: str
    ahead: str


@dataclass(frozen=True, slots=True)
class TrendScreen:
    """Pictures and control charts, of checks with the table in force; ``verified``: whether there is one."""

    verified: Verified
    plots: Sequence[Markup]
    charts: Sequence[TrendLine]
    checks: int


@dataclass(frozen=True, slots=True)
class ScheduleLine:
    """One schedule: what comes, in the reader's words, and what became of its past slots."""

    due: Due
    in_words: str
    slots: Sequence[SlotRecord]


def trend_screen(past: Sequence[Verification], moment: Status) -> TrendScreen:
    """Every judged figure of the latest checks."""
    records = [VerificationRecord(p.id, 0, None, p.verdict, p.model_dump(mode="json"), p.started_utc.isoformat()) for p in past]
    changes = moment.verified.changes
    lines = [_line(t) for t in figure_trends(records, changes[-1] if changes else None)]
    return TrendScreen(moment.verified, trends(past, zone_of(moment), changes), lines, len(past))


def _line(one: FigureTrend) -> TrendLine:
    name, unit = language.figure(current().lang, one.figure)
    frame, ours = current(), current().unit(unit)
    limit = "–" if one.limit is None else f"{frame.length(f'{one.limit:g}', unit)} {ours}"
    since = "" if one.since_utc is None else one.since_utc.isoformat()
    ahead = in_words(one.trend.forecast)
    latest = f"{frame.length(f'{one.latest:.2f}', unit)} ± {frame.length(f'{one.expanded:.2f}', unit)} {ours}"
    return TrendLine(name, one.checks, latest, limit, one.trend.state, one.trend.direction, since, ahead)


def schedule_lines(store: Store, moment: Status) -> list[ScheduleLine]:
    """All schedules with their latest slots."""
    lang = current().lang
    return [
        ScheduleLine(d, language.due(lang, d.due_utc, moment.now_utc), store.slots_of(f"{moment.machine}/{d.schedule}", SLOTS))
        for d in moment.next_due
    ]
