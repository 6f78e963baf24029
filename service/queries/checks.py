"""Checks and the trends of their figures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

from abbe.service.domain.document import Doc
from abbe.service.domain.verification import Verification
from abbe.service.errors import Unusable
from abbe.service.queries.reader import Reader, finite, of_row, read_as, storable
from abbe.service.storage.repositories.pages import PageRow
from abbe.service.verification.trend_table import FigureChart, FigureTrend
from abbe.service.verification.trend_table import charts as figure_charts
from abbe.service.verification.verified_by import VerifiedBy, verified_by

CHECKS = 20_000
"""Number of latest checks in a trend: more than ten years of four checks a day."""
UNSCHEDULED: Doc = {
    "schedule": "", "recipe": "", "duration_s": 0.0, "values": {}, "uncertainties": {}, "limits": {}, "runs": [], "text": "",
}  # fmt: skip
"""Defaults for a check that no schedule ordered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trends:
    """Trends of a machine's figures over its checks, by default those since the table in force became active.

    ``verified``: whether a measurement supports that table, and which.
    """

    machine: str
    figures: Sequence[FigureTrend] = ()
    verified: VerifiedBy = field(default_factory=lambda: VerifiedBy("unknown", "never"))


def checks(
    reader: Reader, machine: str | None, verdict: str | None, cursor: int | None, limit: int
) -> tuple[list[Verification], int | None]:
    """Return the checks of all machines, newest first, without checks that are stored in another form."""
    rows, after = reader.page("verifications", {"machine": machine, "verdict": verdict}, cursor, limit)
    return [one for row in rows if (one := _check(row)) is not None], after


def check(reader: Reader, number: int) -> Verification:
    """Return one check: figures with uncertainties (k = 2), limits, verdict. Raises NotStored, Unusable."""
    row = reader.row("verifications", number, "check")
    found = _check(row)
    if found is None:
        raise Unusable(f"check {number} is in the format of another version of Abbe", "open it with the version that stored it")
    return found


def latest_checks(reader: Reader, limit: int) -> list[Verification]:
    """Return the latest checks of this service's machine, newest first."""
    return checks(reader, reader.machine, None, None, limit)[0]


def last_good(found: Sequence[Verification], recipe: str) -> Verification | None:
    """Return the first check of this recipe that passed and did not verify a push; None: there is none. ``found``: newest first."""
    return next((check for check in found if check.verdict == "pass" and check.recipe == recipe and not check.push), None)


@dataclass(frozen=True, slots=True, kw_only=True)
class _CheckRow:
    """The columns of a check."""

    number: int
    machine: str
    verdict: str
    utc: str
    doc: Doc


def _check(row: PageRow) -> Verification | None:
    found = of_row(_CheckRow, row)
    known = {"id": found.number, "verdict": found.verdict, "machine": found.machine}
    return read_as(Verification, UNSCHEDULED | {"slot_utc": found.utc, "started_utc": found.utc} | finite(found.doc) | known)


def trends(reader: Reader, machine: str, after_utc: datetime | None = None, limit: int = CHECKS) -> Trends:
    """Return the trend of the figures of a machine's checks: drift, its start, and the days until their limits.

    Uses at most ``limit`` of the checks later than ``after_utc``; None: since the table came into force.
    """
    if not storable(machine):
        return Trends(machine=machine)
    known = verified_by(reader.store, machine, control=reader.control_of(machine))
    found = charts(reader, machine, after_utc or known.since, limit)
    return Trends(machine=machine, figures=[one.as_trend for one in found], verified=known)


def charts(reader: Reader, machine: str, after_utc: datetime | None, limit: int = CHECKS) -> list[FigureChart]:
    """Control charts of a machine's judged figures over at most ``limit`` of its checks, later than ``after_utc``."""
    return figure_charts(reader.store.verifications.of_machine(machine, limit), after_utc)
