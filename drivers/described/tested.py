"""Abilities of a device by the report of its test (`abbe device test`); a job opens only devices with the abilities that it needs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

from abbe.drivers.errors import NotProved
from abbe.drivers.links.urls import untested_remedy

FORMAT = "abbe-device-test/1"


class Ability(StrEnum):
    """Permitted use of a device. `DWELL` needs more proofs than `WATCH`.

    A device file never allows motion or tables, whatever its test proves: these need a driver, whose banks, read-back and
    compare-and-swap `abbe comp commission` proves.
    """

    WATCH = "watch"
    """Its values can be shown."""
    DWELL = "dwell"
    """Measurements may use its readings at standstills of an operator's NC program, or of a motion that Abbe commands."""


class CheckVerdict(StrEnum):
    """Outcome of one check."""

    PASSED = "passed"
    FAILED = "failed"
    NOT_PROVED = "not proved"
    """The check was not made, or is impossible for this device."""


@dataclass(frozen=True, slots=True)
class DeviceCheck:
    """One check: its name, outcome, and a sentence with the figures."""

    check: str
    verdict: CheckVerdict
    text: str


@dataclass(frozen=True, slots=True)
class TestReport:
    """Report of a device test. ``device_sha256``: hash of the device file, empty for a device with a driver; ``utc``: ISO 8601."""

    __test__ = False  # pytest takes names that begin with Test
    device: str
    kind: str
    model: str
    serial_no: str
    device_sha256: str
    utc: str
    abilities: tuple[Ability, ...]
    findings: tuple[DeviceCheck, ...]

    @property
    def failed(self) -> tuple[DeviceCheck, ...]:
        """The checks that failed."""
        return tuple(one for one in self.findings if one.verdict is CheckVerdict.FAILED)

    def to_document(self) -> dict[str, Any]:
        """Return the report as a JSON object."""
        return {"format": FORMAT} | asdict(self)


def check_tested(device: str, path: str, sha256: str, serial_no: str, needed: Ability) -> None:
    """Refuse a device whose report does not prove an ability.

    Parameters
    ----------
    device : str
        Its URL, for the error.
    path : str
        The report; empty: there is none.
    sha256, serial_no : str
        SHA-256 of the device file and serial number of the device that answers now; the report must state the same.
    needed : Ability
        What the job needs.

    Raises
    ------
    NotProved
        There is no report, or the report is about another device or file or does not prove this ability; the message names the checks that
        failed or are missing.
    """
    remedy = untested_remedy(device)
    if not path:
        raise NotProved(device, f"open to {needed}", "its sign, scale and freshness are not proved yet", remedy)
    try:
        doc = json.loads(Path(path).read_text(encoding="utf-8"))
        if not isinstance(doc, Mapping) or doc.get("format") != FORMAT:
            raise ValueError("it is no report of a device test")
        stated = {key: str(doc[key]) for key in ("device_sha256", "serial_no")}
        abilities, findings = (
            list(doc["abilities"]),
            [(str(one["check"]), str(one["verdict"]), str(one["text"])) for one in doc["findings"]],
        )
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise NotProved(device, "read test report", f"{path}: {error}", remedy) from None
    if stated["device_sha256"] != sha256:
        raise NotProved(device, f"open to {needed}", "the device file has changed since its test", remedy)
    if stated["serial_no"] != serial_no:
        detail = (
            f"device {serial_no or 'without serial number'} answers, but device {stated['serial_no'] or 'without serial number'} was tested"
        )
        raise NotProved(device, f"open to {needed}", detail, remedy)
    if needed not in abilities:
        why = "; ".join(f"{check}: {text}" for check, verdict, text in findings if verdict != CheckVerdict.PASSED)
        raise NotProved(device, f"open to {needed}", f"its device test did not prove this: {why}", remedy)
