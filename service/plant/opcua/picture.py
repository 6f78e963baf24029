"""Content of the address space as a flat mapping from path to value: pure, so that it is tested without a server."""

from __future__ import annotations

import json
from dataclasses import dataclass
from datetime import datetime
from typing import Literal

from abbe.service.domain.verification import Verification
from abbe.service.plant.facts import PlantAlarm, PlantFacts, PlantUnit, unit_of

Value = str | bool | int | float | datetime | list[str] | list[datetime] | None
Kind = Literal["text", "flag", "count", "real", "time", "texts", "times"]
PAST_CHECKS = 10
MAX_TEXT = 500


@dataclass(frozen=True, slots=True)
class Leaf:
    """One variable. ``value`` None: unknown, which is shown as a bad status and not as zero."""

    value: Value
    kind: Kind
    unit: PlantUnit | None = None


Picture = dict[str, Leaf]
"""Variables by their path under the machine's object, e.g. ``LastResult/Figures/body_diagonal_um``."""


def picture_of(facts: PlantFacts) -> Picture:
    """Return all variables of the machine."""
    return {
        "State": Leaf(facts.state, "text"),
        "Version": Leaf(facts.version, "text"),
        "NextCheck": Leaf(facts.next_utc, "time"),
        **_running(facts),
        **_last(facts.checks[0] if facts.checks else None, facts.verdict),
        **_past(facts.checks),
        **_alarms(facts.alarms),
        **_table(facts),
        **_devices(facts),
    }


def _running(facts: PlantFacts) -> Picture:
    now = facts.running
    return {
        "Check/Active": Leaf(now is not None, "flag"),
        "Check/Schedule": Leaf(now.schedule if now else None, "text"),
        "Check/Recipe": Leaf(now.recipe if now else None, "text"),
        "Check/Since": Leaf(now.since_utc if now else None, "time"),
        "Check/Stage": Leaf(now.stage if now else None, "text"),
        "Check/Message": Leaf(_short(now.message) if now else None, "text"),
        "Check/Progress": Leaf(now.percent if now else None, "real", unit_of("progress_percent")),
        "Check/Remaining": Leaf(now.eta_s if now else None, "real", unit_of("remaining_s")),
    }


def _last(check: Verification | None, verdict: str | None) -> Picture:
    """Return the last check; ``verdict`` as `PlantFacts.verdict`."""
    out = {
        "LastResult/Number": Leaf(check.id if check else None, "count"),
        "LastResult/Verdict": Leaf(verdict, "text"),
        "LastResult/Text": Leaf(_short(check.text) if check else None, "text"),
        "LastResult/Schedule": Leaf(check.schedule if check else None, "text"),
        "LastResult/Recipe": Leaf(check.recipe if check else None, "text"),
        "LastResult/Started": Leaf(check.started_utc if check else None, "time"),
        "LastResult/Duration": Leaf(check.duration_s if check else None, "real", unit_of("duration_s")),
    }
    for figure in check.figures if check else ():
        unit = unit_of(figure.name)
        out[f"LastResult/Figures/{figure.name}"] = Leaf(figure.value, "real", unit)
        out[f"LastResult/Uncertainties/{figure.name}"] = Leaf(figure.expanded, "real", unit)
        out[f"LastResult/Limits/{figure.name}"] = Leaf(figure.limit, "real", unit)
    return out


def _past(checks: tuple[Verification, ...]) -> Picture:
    shown = checks[:PAST_CHECKS]
    figures = [
        json.dumps({figure.name: [figure.value, figure.expanded, figure.limit] for figure in check.figures}, allow_nan=False)
        for check in shown
    ]
    return {
        "Results/Numbers": Leaf([str(check.id) for check in shown], "texts"),
        "Results/Verdicts": Leaf([str(check.verdict) for check in shown], "texts"),
        "Results/Started": Leaf([check.started_utc for check in shown], "times"),
        "Results/Figures": Leaf(figures, "texts"),
    }


def _alarms(alarms: tuple[PlantAlarm, ...]) -> Picture:
    return {
        "Alarms/Count": Leaf(len(alarms), "count"),
        "Alarms/Codes": Leaf([alarm.code for alarm in alarms], "texts"),
        "Alarms/Texts": Leaf([_short(alarm.text) for alarm in alarms], "texts"),
        "Alarms/Devices": Leaf([_short(alarm.device) for alarm in alarms], "texts"),
        "Alarms/Times": Leaf([alarm.at_utc for alarm in alarms], "times"),
    }


def _table(facts: PlantFacts) -> Picture:
    table, verified = facts.table, facts.verified
    return {
        "CompensationTable/Known": Leaf(table is not None, "flag"),
        "CompensationTable/Bank": Leaf(table.bank if table else None, "count"),
        "CompensationTable/Crc32": Leaf(f"{table.crc:08x}" if table else None, "text"),
        "CompensationTable/Push": Leaf(table.push if table else None, "count"),
        "CompensationTable/Since": Leaf(table.since_utc if table else None, "time"),
        "CompensationTable/Verified": Leaf({"verified": True, "unverified": False}.get(verified.state if verified else ""), "flag"),
        "CompensationTable/VerifiedText": Leaf(verified.text if verified else None, "text"),
    }


def _devices(facts: PlantFacts) -> Picture:
    out: Picture = {}
    for device in facts.devices:
        out[f"Devices/{device.role}/State"] = Leaf(device.state, "text")
        out[f"Devices/{device.role}/Text"] = Leaf(_short(device.text), "text")
        out[f"Devices/{device.role}/LastHeard"] = Leaf(device.at_utc, "time")
    return out


def _short(text: str) -> str:
    """Return printable text of at most `MAX_TEXT` characters: device strings may hold anything."""
    return "".join(c if c.isprintable() else " " for c in text)[:MAX_TEXT]
