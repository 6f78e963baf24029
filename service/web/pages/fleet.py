"""All machines of the database for the screen `/fleet`: state, worst figure and alarms of each, worst first.

The screen computes no trends: for ten machines over a month they take most of the time of ``abbe fleet``.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

from abbe.service.domain.utc import utc_text
from abbe.service.scheduler.fleet import FleetFigure, MachineStatus, machine_statuses
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import folded, is_open

SORTS = ("worst", "machine", "due")
COLUMNS = (
    "machine", "state", "last_check_utc", "verdict", "worst_figure", "value", "expanded_uncertainty_k2", "limit",
    "share_of_limit", "next_due_utc", "next_recipe", "open_alarms", "table_in_force",
)  # fmt: skip
_FORMULA = ("=", "+", "-", "@", "\t", "\r")


@dataclass(frozen=True, slots=True)
class FleetLine:
    """One machine: state, worst figure, and number of open alarms."""

    machine: MachineStatus
    worst: FleetFigure | None
    alarms: int

    @property
    def share(self) -> float | None:
        """The worst figure divided by its limit; None without one."""
        one = self.worst
        return None if one is None or not one.limit else one.value / one.limit

    @property
    def share_u(self) -> float | None:
        """Expanded uncertainty of `share` (k = 2); None if that of the figure is unknown."""
        one = self.worst
        return None if one is None or not one.limit or one.expanded is None else one.expanded / one.limit

    @property
    def upper(self) -> float:
        """Sort key: the upper end of the share; infinite without figures, so that unknown machines come first."""
        return float("inf") if self.share is None else self.share + (self.share_u or 0.0)


@dataclass(frozen=True, slots=True)
class FleetQuery:
    """Filter and order: part of a name, a verdict, and the sort key."""

    name: str = ""
    verdict: str = ""
    sort: str = SORTS[0]


def fleet_lines(store: Store, now: datetime, query: FleetQuery) -> list[FleetLine]:
    """The matching machines in the requested order."""
    lines = [_line(store, one) for one in machine_statuses(store, now) if _fits(one, query)]
    if query.sort == "machine":
        return sorted(lines, key=lambda one: one.machine.machine)
    if query.sort == "due":
        return sorted(lines, key=lambda one: (_sortable(one.machine.next_due_utc), one.machine.machine))
    return sorted(lines, key=lambda one: (-one.upper, -one.alarms, one.machine.machine))


def _sortable(utc: str) -> str:
    return utc_text(datetime.fromisoformat(utc)) if utc else "~"  # machines without a due time come last


def _fits(one: MachineStatus, query: FleetQuery) -> bool:
    return query.name.casefold() in one.machine.casefold() and query.verdict in {"", one.verdict}


def _line(store: Store, one: MachineStatus) -> FleetLine:
    judged = [figure for figure in one.figures if figure.limit]
    worst = max(judged, key=lambda f: (f.value + (f.expanded or 0.0)) / (f.limit or 1.0), default=None)
    return FleetLine(one, worst, sum(is_open(alarm) for alarm in folded(store.alarms.entries(one.machine))))


def fleet_csv(lines: Sequence[FleetLine]) -> str:
    """The machines as CSV: figures in the unit at the end of their name, times in UTC."""
    out = io.StringIO()
    write = csv.writer(out, lineterminator="\n")
    write.writerow(COLUMNS)
    for line in lines:
        one, worst = line.machine, line.worst
        figure = ("", "", "", "", "") if worst is None else (worst.name, worst.value, worst.expanded, worst.limit, line.share)
        head = (one.machine, one.state, one.check_utc, one.verdict)
        write.writerow([_cell(v) for v in (*head, *figure, one.next_due_utc, one.next_recipe)] + [line.alarms, one.verified.text])
    return out.getvalue()


def _cell(value: object) -> object:
    """A cell that a spreadsheet does not take for a formula."""
    if value is None:
        return ""
    return "'" + value if isinstance(value, str) and value.startswith(_FORMULA) else value
