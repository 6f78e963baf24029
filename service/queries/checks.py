"""Checks and their trends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import datetime

from abbe.service.domain.verification import Verification
from abbe.service.errors import Unusable
from abbe.service.queries.reader import Doc, Reader, finite, read_as, storable
from abbe.service.verification.trend_table import FigureTrend
from abbe.service.verification.trend_table import trends as figure_trends
from abbe.service.verification.verified_by import VerifiedBy, verified_by

CHECKS = 20_000
"""Number of latest checks in a trend: more than ten years at four a day."""
UNSCHEDULED: Doc = {
    "schedule": "", "recipe": "", "duration_s": 0.0, "values": {}, "uncertainties": {}, "limits": {}, "runs": [], "text": "",
}  # fmt: skip
"""Defaults for a check that no schedule ordered."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trends:
    """Trends of a machine's figures over its checks with the table in force; ``verified``: the measurement that verified that table."""

    machine: str
    figures: Sequence[FigureTrend] = ()
    verified: VerifiedBy = field(default_factory=lambda: VerifiedBy("unknown", "never"))


def checks(
    reader: Reader, machine: str | None, verdict: str | None, cursor: int | None, limit: int
) -> tuple[list[Verification], int | None]:
    """Checks of all machines, newest first, without those stored in another form."""
    rows, after = reader.page("verifications", {"machine": machine, "verdict": verdict}, cursor, limit)
    return [one for row in rows if (one := _check(row)) is not None], after


def check(reader: Reader, number: int) -> Verification:
    """One check: figures with uncertainties (k = 2), limits, verdict. Raises NotStored, Unusable."""
    row = reader.row("verifications", number, "check")
    found = _check(row)
    if found is None:
        raise Unusable(f"check {number} was stored in another form")
    return found


def latest_checks(reader: Reader, limit: int) -> list[Verification]:
    """The latest checks of this service's machine, newest first."""
    return checks(reader, reader.machine, None, None, limit)[0]


def _check(row: Doc) -> Verification | None:
    known = {"id": row["id"], "verdict": row["verdict"], "machine": row["machine"]}
    return read_as(Verification, UNSCHEDULED | {"slot_utc": row["utc"], "started_utc": row["utc"]} | finite(row["doc"]) | known)


def trends(reader: Reader, machine: str, after_utc: datetime | None = None, limit: int = CHECKS) -> Trends:
    """Whether the figures of a machine's checks drift, since when, and when they reach their limits.

    Uses at most ``limit`` of the checks later than ``after_utc``; None: since the table came into force.
    """
    if not storable(machine):
        return Trends(machine=machine)
    known = verified_by(reader.store, machine, control=reader.control_of(machine))
    found = figure_trends(reader.store.verifications.of_machine(machine, limit), after_utc or known.since)
    return Trends(machine=machine, figures=found, verified=known)
