"""Reasons against a table, found without touching the controller: form, numbers, promise, evidence, policy, signature.

All reasons are collected, so that a person sees everything at once. Only an empty list admits a table.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, replace
from itertools import pairwise

from abbe.service.push.candidate import Candidate, CandidateContext, Column, EvidenceSeal
from abbe.service.push.entries import canonical
from abbe.service.push.limits import PushLimits
from abbe.service.push.validate_numbers import number_reasons

AXES = ("X", "Y", "Z")
HEADER_REGISTERS = 24
SIGNERS = frozenset({"metrologist"})


def content_digest(candidate: Candidate) -> str:
    """SHA-256 of everything in a candidate except its digest and seal; ``"not canonical"`` where a value cannot be hashed (NaN, Inf)."""
    try:
        return hashlib.sha256(canonical(asdict(replace(candidate, digest="", seal=EvidenceSeal())))).hexdigest()
    except ValueError:
        return "not canonical"


def reasons_against(candidate: Candidate, context: CandidateContext, limits: PushLimits) -> list[str]:
    """Check a proposed table against machine, controller and limits.

    Each returned reason begins with a stable word in capitals.
    """
    form = [*_binding(candidate, context), *_form(candidate, context)]
    numbers = [] if any(reason.startswith("FORM") for reason in form) else list(number_reasons(candidate, context, limits))
    return [*form, *numbers, *_evidence(candidate, context, limits), *_policy(candidate, context, limits), *_seal(candidate)]


def _binding(c: Candidate, context: CandidateContext) -> Iterator[str]:
    if c.machine != context.machine:
        yield f"MACHINE: the table is for {c.machine!r}, this is {context.machine!r}"
    if c.map_version != context.map_version:
        yield f"MAP: made for register map {c.map_version}, the controller has {context.map_version}"
    if c.lsb_nm != context.lsb_nm:
        yield f"SCALE: a value counts {c.lsb_nm} nm in the table, {context.lsb_nm} nm in the controller"
    if c.length_unit != "mm":
        yield f"UNIT: lengths are in {c.length_unit!r}, not in mm"
    if c.base_crc != context.active_crc:
        yield f"BASE: measured with table {c.base_crc:08X}, active is {context.active_crc:08X}"


def _form(c: Candidate, context: CandidateContext) -> Iterator[str]:
    names = [(column.moved, column.corrected) for column in c.columns]
    if sorted(names) != [(a, i) for a in AXES for i in AXES]:
        yield f"FORM AXES: needs each of X, Y, Z over each of them once, has {len(names)} columns"
        return
    registers = HEADER_REGISTERS + sum(len(column.correction_mm) for column in c.columns)
    if registers > context.bank_registers:
        yield f"FORM SIZE: {registers} registers, a bank has {context.bank_registers}"
    for column in c.columns:
        reason = _column_form(column, context)
        if reason:
            yield f"FORM {reason} (table of {column.corrected} over {column.moved})"


def _column_form(column: Column, context: CandidateContext) -> str:
    position, n = column.position_mm, len(column.position_mm)
    if n < 2 or len(column.correction_mm) != n or (column.left_mm and len(column.left_mm) != n):
        return f"SIZE: {n} positions, {len(column.correction_mm)} corrections, {len(column.left_mm)} residuals"
    if column.reverse_mm and len(column.reverse_mm) != n:
        return f"SIZE: {len(column.reverse_mm)} reverse values, {n} positions"
    if not all(b > a for a, b in pairwise(position)):
        return "POSITIONS: they do not increase strictly"
    low, high = context.travel_mm[column.moved]
    if not low - 1e-6 <= position[0] <= position[-1] <= high + 1e-6:
        return f"TRAVEL: {position[0]:g} to {position[-1]:g} mm, the axis goes from {low:g} to {high:g} mm"
    grid = context.grid_mm.get(column.moved)
    if grid is not None and (len(grid) != n or any(abs(a - b) > 1e-5 for a, b in zip(grid, position, strict=False))):
        return "GRID: not the controller's grid"
    pitch = (position[-1] - position[0]) / (n - 1)
    if any(abs(b - a - pitch) > 1e-5 for a, b in pairwise(position)):
        return "GRID: not equidistant"
    return ""


def _evidence(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    e = c.evidence
    low, high = limits.temperature_c
    newest_s = e.ended_s if e.last_s is None else e.last_s
    if not context.now_s - limits.age_h * 3600.0 <= e.ended_s <= newest_s <= context.now_s:
        yield f"STALE: measured {(context.now_s - e.ended_s) / 3600.0:.1f} h ago, allowed are 0 to {limits.age_h:g} h"
    if e.machine_mark != context.machine_mark:
        yield "CHANGED: the machine restarted, had a crash or was maintained since it was measured"
    if not low <= e.temperature_c[0] <= e.temperature_c[1] <= high:
        yield f"TEMPERATURE: {e.temperature_c[0]:.1f} to {e.temperature_c[1]:.1f} °C, allowed are {low:g} to {high:g} °C"
    if e.run_count < limits.runs:
        yield f"RUNS: {e.run_count}, needed are {limits.runs}"
    if drift := drift_reason(e.drift_mm, limits):
        yield drift
    if promise := promise_reason(e.before_mm, e.after_mm, e.u_mm, limits):
        yield f"PROMISE: {promise}"
    if not e.calibrated_until_s:
        yield "CERTIFICATE: the instruments have no calibration certificate"
    elif not min(e.calibrated_until_s) >= newest_s:
        yield "CERTIFICATE: a calibration had expired when it was measured"


def drift_reason(drift_mm: float, limits: PushLimits) -> str:
    """Why the drift between the first and the last run is too large; empty if it is not."""
    if drift_mm <= limits.drift_mm:
        return ""
    return f"DRIFT: {drift_mm * 1e3:.1f} µm between the first and the last run, allowed are {limits.drift_mm * 1e3:.1f} µm"


def promise_reason(before_mm: float, after_mm: float, u_mm: float, limits: PushLimits) -> str:
    """Why a promise is too small to write; empty if it is not. Rms before and after, and the model's standard uncertainty, mm."""
    gain = before_mm - after_mm
    if u_mm <= limits.share * gain and gain > limits.k * u_mm and gain >= limits.gain * before_mm:
        return ""
    promise = f"the tables promise {before_mm * 1e3:.1f} → {after_mm * 1e3:.1f} µm rms"
    return f"{promise} (model uncertainty {u_mm * 1e3:.1f} µm): not enough to write"


def _policy(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Limits of unattended pushes only: minimum interval, and drift of the tables over 30 days."""
    if context.attended:
        return
    if context.now_s - context.last_push_s < limits.unattended_h * 3600.0:
        yield f"POLICY TIME: the last unattended push was less than {limits.unattended_h:g} h ago"
    for column in c.columns:
        then = context.month_ago.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)
        walk = max((abs(a - b) for a, b in zip(column.correction_mm, then, strict=False)), default=0.0)
        if not walk <= limits.walk_mm:
            yield f"POLICY WALK: {column.corrected} over {column.moved} moved {walk * 1e3:.1f} µm in 30 days"


def _seal(c: Candidate) -> Iterator[str]:
    digest = content_digest(c)
    if c.digest != digest:
        yield "HASH: the table is not the one that its digest was computed from"
    if not c.seal.role:
        yield "UNSIGNED: nobody vouches for it"
    elif c.seal.role not in SIGNERS:
        yield f"ROLE: signed by a {c.seal.role}, only a metrologist may"
    elif c.seal.digest != digest:
        yield "SIGNATURE: it was given for another table"
