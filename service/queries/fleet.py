"""All machines of a database: state, last check, next slot, and the limit that is reached first."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from datetime import datetime
from typing import Any

from abbe.service.domain.results import VerificationRecord
from abbe.service.domain.service_records import SILENT_AFTER, HeartbeatRecord
from abbe.service.storage.store import Store
from abbe.service.verification.trend_table import FigureTrend, trends
from abbe.service.verification.verified_by import LATEST_CHECKS, VerifiedBy, of_push_taken_back, verified_by

CHECKS = 400
"""Number of checks of each machine read for its trend, which uses no more (`abbe.models.trend.MOST_CHECKS`)."""
NOT_RUNNING = "not running"
NO_SERVICE = "no service"
HEADINGS = (
    "machine",
    "state",
    "last check (UTC)",
    "verdict",
    "table in force",
    "figures ± U (k = 2)",
    "next due (UTC)",
    "days until limit (95 %)",
)


@dataclass(frozen=True, slots=True)
class FleetFigure:
    """One figure of a check: value, expanded uncertainty (k = 2) and limit, in the unit at the end of its name; None: unknown."""

    name: str
    value: float
    expanded: float | None
    limit: float | None


@dataclass(frozen=True, slots=True)
class MachineStatus:
    """Status of one machine: state of its service, and result of its last check. Empty text: there is none.

    Parameters
    ----------
    state : str
        ``measuring``, ``waiting``, ``not running`` (the service ended, or was silent for minutes), ``no service`` (there never was one).
    heard_utc : str
        Time of the service's last heartbeat.
    check_utc, verdict : str
        The last check. If it did not check the table in force, the verdict is ``verified`` (the push of that table was measured before
        and after), ``unverified`` or ``unknown``.
    figures : tuple of FleetFigure
        Judged figures of the last check, in its order; none if it did not check the table in force.
    verified : VerifiedBy
        Which measurement verified the table in force, or since when none has.
    next_due_utc, next_recipe : str
        The service's next slot; empty if the service does not run or has no timetable.
    """

    machine: str
    state: str
    heard_utc: str = ""
    check_utc: str = ""
    verdict: str = ""
    figures: tuple[FleetFigure, ...] = ()
    next_due_utc: str = ""
    next_recipe: str = ""
    verified: VerifiedBy = field(default_factory=lambda: VerifiedBy("unknown", "never"))


@dataclass(frozen=True, slots=True)
class MachineLine(MachineStatus):
    """Status of one machine with the trends of its figures.

    Parameters
    ----------
    drifting : tuple of str
        Figures that drift.
    limit_figure : str
        The figure that reaches its limit first; empty if unknown for all.
    limit_days : tuple of float or None
        Days until then, and the 95 % interval.
    """

    drifting: tuple[str, ...] = ()
    limit_figure: str = ""
    limit_days: tuple[float, float, float] | None = None


def machine_statuses(store: Store, now: datetime) -> list[MachineStatus]:
    """Return the status of every machine, by name. Only the last checks are read, so that the cost does not grow with the years."""
    heartbeats = store.heartbeats.all()
    return [
        _status(store, name, heartbeats.get(name), store.verifications.of_machine(name, LATEST_CHECKS), now)
        for name in store.machines.names()
    ]


def fleet(store: Store, now: datetime) -> list[MachineLine]:
    """Return the status and trends of every machine of a database, by name."""
    heartbeats = store.heartbeats.all()
    return [
        _line(store, name, heartbeats.get(name), store.verifications.of_machine(name, limit=CHECKS), now) for name in store.machines.names()
    ]


def _line(store: Store, name: str, heartbeat: HeartbeatRecord | None, checks: Sequence[VerificationRecord], now: datetime) -> MachineLine:
    status = _status(store, name, heartbeat, checks, now)
    found = trends(checks, status.verified.since)
    soonest = min((one for one in found if one.days_until_limit is not None), key=lambda one: one.days_until_limit or 0.0, default=None)
    return MachineLine(
        **{one.name: getattr(status, one.name) for one in fields(status)},
        drifting=tuple(one.figure for one in found if one.state == "drifting"),
        limit_figure="" if soonest is None else soonest.figure,
        limit_days=None if soonest is None else _days(soonest),
    )


def _status(
    store: Store, name: str, heartbeat: HeartbeatRecord | None, checks: Sequence[VerificationRecord], now: datetime
) -> MachineStatus:
    """Return the status of one machine; ``checks``: newest first."""
    state = state_of(heartbeat, now)
    due = heartbeat.doc.get("due", []) if heartbeat is not None and state not in {NOT_RUNNING, NO_SERVICE} else []
    first: dict[str, str] = min(due, key=lambda one: datetime.fromisoformat(one["due_utc"]), default={})
    last = next((one for one in checks if not of_push_taken_back(one)), None)
    known = verified_by(store, name)
    verdict = "" if last is None and known.holds else known.verdict("" if last is None else last.verdict)
    return MachineStatus(
        machine=name,
        state=state,
        heard_utc=heartbeat.seen_utc if heartbeat is not None else "",
        check_utc="" if last is None else str(last.doc.get("started_utc") or last.utc),
        verdict=verdict,
        figures=() if last is None or not known.holds else figures_of(last.doc),
        next_due_utc=first.get("due_utc", ""),
        next_recipe=first.get("recipe", ""),
        verified=known,
    )


def state_of(heartbeat: HeartbeatRecord | None, now: datetime) -> str:
    """Return the state of a machine's service by its last heartbeat."""
    if heartbeat is None:
        return NO_SERVICE
    if heartbeat.owner.is_gone() or now - datetime.fromisoformat(heartbeat.seen_utc) > SILENT_AFTER:
        return NOT_RUNNING
    return str(heartbeat.doc.get("state", NOT_RUNNING))


def figures_of(doc: Mapping[str, Any]) -> tuple[FleetFigure, ...]:
    """Return the judged figures of a check; none for a check that could not be completed."""
    values, expanded = doc.get("values", {}), doc.get("uncertainties", {})
    judged = {name: limit for name, limit in doc.get("limits", {}).items() if values.get(name) is not None}
    return tuple(FleetFigure(name, values[name], expanded.get(name), limit) for name, limit in judged.items())


def _days(one: FigureTrend) -> tuple[float, float, float] | None:
    if one.days_until_limit is None or one.days_until_limit_95 is None:
        return None
    return (one.days_until_limit, *one.days_until_limit_95)


def row(line: MachineLine) -> tuple[str, ...]:
    """Return the cells of one machine under `HEADINGS`."""
    figures = ", ".join(_figure_text(one) for one in line.figures)
    state = line.state if line.state != NOT_RUNNING else f"{NOT_RUNNING}, last heard {_minute(line.heard_utc)}"
    due = f"{_minute(line.next_due_utc)} {line.next_recipe}" if line.next_due_utc else ""
    return (line.machine, state, _minute(line.check_utc), line.verdict, line.verified.text, figures, due, _limit_text(line))


def _figure_text(one: FleetFigure) -> str:
    expanded = "" if one.expanded is None else f" ± {one.expanded:.1f}"
    limit = "" if one.limit is None else f" (limit {one.limit:g})"
    return f"{one.name} {one.value:.1f}{expanded}{limit}"


def _limit_text(line: MachineLine) -> str:
    if line.limit_days is None:
        return "not known" if line.figures else ""
    days, low, high = (f"{v:.1f}" if v < 10 else f"{v:.0f}" for v in line.limit_days)
    return f"{days} ({low} to {high}) {line.limit_figure}"


def _minute(utc: str) -> str:
    return utc[:16].replace("T", " ")


def as_doc(lines: Sequence[MachineLine]) -> dict[str, Any]:
    """Return all lines as a JSON value; unknown values are null or empty."""
    return {"schema": 1, "machines": [_doc(one) for one in lines]}


def _doc(one: MachineLine) -> dict[str, Any]:
    days = one.limit_days
    return {
        "machine": one.machine,
        "state": one.state,
        "heard_utc": one.heard_utc or None,
        "check_utc": one.check_utc or None,
        "verdict": one.verdict or None,
        "verified": one.verified.as_doc(),
        "figures": [{"name": f.name, "value": f.value, "expanded_uncertainty": f.expanded, "limit": f.limit} for f in one.figures],
        "next_due_utc": one.next_due_utc or None,
        "next_recipe": one.next_recipe or None,
        "drifting": list(one.drifting),
        "limit_figure": one.limit_figure or None,
        "days_until_limit": None if days is None else days[0],
        "days_until_limit_95": None if days is None else days[1:],
    }
