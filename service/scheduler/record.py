"""One check as a document: the same for the store, for MQTT, for the status page and for JSON clients."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime

from abbe.drivers.errors import DriverError
from abbe.service.domain.schedule import Schedule
from abbe.service.domain.verification import CheckFailure, CheckResult
from abbe.service.errors import AbbeError
from abbe.service.scheduler.ports import Doc

SCHEMA = 1
"""Version of the documents. It rises when a key changes its meaning or disappears, not for new keys."""

VERDICTS = ("pass", "fail", "cannot tell")


@dataclass(frozen=True, slots=True)
class Occasion:
    """Identity of a check: machine, schedule and slot."""

    machine: str
    schedule: Schedule
    slot_utc: datetime


def check_doc(occasion: Occasion, result: CheckResult) -> Doc:
    """Return the document of a completed check."""
    return {
        **_head(occasion, result.started_utc),
        "duration_s": round(result.duration_s, 3),
        # An unknown verdict must not look like a pass.
        "verdict": result.verdict if result.verdict in VERDICTS else "cannot tell",
        "values": _figures(result.values),
        "uncertainties": _figures(result.uncertainties),
        "limits": _figures(result.limits),
        "campaign": result.campaign,
        "runs": list(result.run_labels),
        "text": result.text,
        "comparable": bool(result.comparable),
        "cause": None,
    }


def failed_doc(occasion: Occasion, cause: Exception, started_utc: datetime, duration_s: float) -> Doc:
    """Return the document of a check that could not be completed: no verdict, but the cause."""
    reason = cause_of(cause)
    return {
        **_head(occasion, started_utc),
        "duration_s": round(duration_s, 3),
        "verdict": "cannot tell",
        "values": {},
        "uncertainties": {},
        "limits": {},
        "campaign": "",
        "runs": [],
        "text": f"The check could not be completed: {reason.what}",
        "cause": asdict(reason),
    }


def alarm(doc: Doc) -> Doc:
    """Return the alarm that goes with the document of a failed check."""
    return {**doc["cause"], "at_utc": doc["started_utc"]}


def cause_of(cause: Exception) -> CheckFailure:
    """Return code, one line of cause, remedy and device of an error.

    Of a group of errors, the first one of a driver or of Abbe counts: if several devices fail together, the first failure matters.
    """
    known = _first(cause)
    if isinstance(known, DriverError):
        what = _line(f"{known.operation}: {known.detail}")
        return CheckFailure(code=known.code, what=what, remedy=known.remedy, device=known.device)
    if isinstance(known, AbbeError):
        return CheckFailure(code=known.code, what=_line(known.detail), remedy=known.remedy)
    name = type(known).__name__
    return CheckFailure(code="ABB-001", what=_line(f"{name}: {known}"), remedy="see the service's log for details")


def _first(cause: Exception) -> Exception:
    if not isinstance(cause, ExceptionGroup):
        return cause
    leaves = [_first(member) for member in cause.exceptions]
    return next((leaf for leaf in leaves if isinstance(leaf, DriverError | AbbeError)), leaves[0])


def _head(occasion: Occasion, started_utc: datetime) -> Doc:
    return {
        "schema": SCHEMA,
        "machine": occasion.machine,
        "schedule": occasion.schedule.name,
        "recipe": occasion.schedule.recipe,
        "slot_utc": occasion.slot_utc.isoformat(),
        "started_utc": started_utc.isoformat(),
    }


def _figures(figures: Mapping[str, float]) -> dict[str, float | None]:
    """Replace NaN and infinity, which JSON does not have, with null."""
    return {name: float(value) if math.isfinite(value) else None for name, value in figures.items()}


def _line(text: str) -> str:
    """Return ``text`` as one printable line of at most 500 characters: device strings end up in logs and pages."""
    return " ".join("".join(c if c.isprintable() else " " for c in text).split())[:500]
