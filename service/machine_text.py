"""The text of a new machine file, with comments for the person who edits it; `abbe.service.config` reads it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import date
from typing import Any

from abbe.service.domain.machine import DeviceUrls
from abbe.service.push.validate import PushLimits

TEXT = """# A machine file. `abbe check-config` says what is in force, docs/reference/machine-file.md describes every key.
# Lengths in mm, in the machine's own coordinates.
name = {name}
# Carriages from the workpiece (w) over the bed (b) to the tool (t).
chain = {chain}
vertical_axis = {vertical_axis}
# From the spindle's reference point to the functional point.
tool_mm = {tool_mm}

[stroke_mm]
{stroke_mm}
{pivots}
# Leave out what is not connected. "fixture+console:" asks the person at the console to mount bar and mirror.
[devices]
{devices}

# Last days of your instruments' certificates. Without them Abbe measures and solves, but writes no table.
[calibration]
{calibration}
{limits}{verify}
# A SQLite file beside this file.
[store]
url = "sqlite:///abbe.sqlite3"

# Unattended checks by `abbe serve`: minute hour day month weekday. They need a fixture that asks no person.
# [[schedule]]
# name = "weekly"
# cron = "0 6 * * 1"
# timezone = "Europe/Berlin"
# recipe = "quick-check"
"""
PIVOTS = """
# Points about which the angular errors of the carriages turn them.
[pivots_mm]
{rows}
"""
VERIFY = """
# The machine fails the check if a figure is above its limit.
[verify]
body_diagonal_um = 20.0
helix_rms_um = 5.0
# reversal_um = 5.0
"""
CERTIFIED = ("ballbar", "laser", "artefact")
LIMITS = """
[limits]
table_value_um = {value:g}
table_change_um = {change:g}
table_walk_um = {walk:g}
"""


def machine_text(
    doc: Mapping[str, Any],
    urls: DeviceUrls,
    certificates: Mapping[str, date] | None = None,
    limits: PushLimits | None = None,
    *,
    verify: bool = True,
) -> str:
    """Return the text of a machine file.

    Parameters
    ----------
    doc : dict
        The machine as exchange files have it: name, chain, stroke_mm, tool_mm; optional vertical_axis and pivots_mm.
    urls : DeviceUrls
        Addresses; a device without an address gets a comment instead.
    certificates : dict, optional
        Last day of the certificate of ``ballbar``, ``laser`` and ``artefact``; an instrument without a certificate gets a comment
        instead.
    limits : PushLimits, optional
        Limits of a table; of these the largest value, change and change over 30 days are written. None: nothing.
    verify : bool
        Also write the limits of a check, which decide whether the machine passes.
    """
    known = certificates or {}
    return TEXT.format(
        name=json.dumps(doc["name"], ensure_ascii=False),
        chain=json.dumps(doc["chain"]),
        vertical_axis=json.dumps(doc.get("vertical_axis", "Z")),
        tool_mm=_row(doc["tool_mm"]),
        stroke_mm=_rows(doc["stroke_mm"]),
        pivots=PIVOTS.format(rows=_rows(doc["pivots_mm"])) if doc.get("pivots_mm") else "",
        devices="\n".join(_device(role, getattr(urls, role)) for role in ("cnc", "ballbar", "laser", "fixture")),
        calibration="\n".join(f"{role} = {known[role]}" if role in known else f"# {role} = 2027-05-31" for role in CERTIFIED),
        limits="" if limits is None else _limits(limits),
        verify=VERIFY if verify else "",
    )


def _row(values: Any) -> str:
    return "[" + ", ".join(repr(float(value)) for value in values) + "]"


def _rows(by_axis: Mapping[str, Any]) -> str:
    return "\n".join(f"{axis} = {_row(by_axis[axis])}" for axis in "XYZ" if axis in by_axis)


def _device(role: str, url: str | None) -> str:
    return f"# {role} =" if url is None else f"{role} = {json.dumps(url)}"


def _limits(limits: PushLimits) -> str:
    return LIMITS.format(value=limits.value_mm * 1e3, change=limits.change_mm * 1e3, walk=limits.walk_mm * 1e3)
