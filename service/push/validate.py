"""A proposed table, its limits, and the checks that reject it without the controller: form, numbers, predicted gain, evidence, policy.

All reasons are collected, so that a person sees everything at once. Only an empty list admits a table. A table beyond a limit is rejected;
its values are never cut to the limit. Pure.
"""

from __future__ import annotations

import hashlib
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import pairwise

from abbe.service.domain.document import canonical

AXES = ("X", "Y", "Z")
HEADER_REGISTERS = 24
SIGNERS = frozenset({"metrologist"})
LARGEST = 32767
WHOLE = 0.01
"""Allowed distance of a value from a whole unit of the table, in units: float noise only."""
ZERO_MM = 0.5e-6
"""Allowed value at the reference (first position): a table that is not zero there moves the axis as soon as it comes into force."""


@dataclass(frozen=True, slots=True)
class PushLimits:
    """Every limit that can reject a table. Lengths mm, times h, temperatures °C.

    Parameters
    ----------
    value_mm, change_mm : float
        Largest absolute value, largest change against the table in force.
    step_mm, slope : float
        Largest difference of neighbouring values; the same per mm of travel.
    second_mm : float
        Largest second difference.
    gain, k : float
        Smallest predicted improvement of the rms: as a share of the rms, and as a multiple of the model's standard uncertainty.
    beyond : float
        Largest part of a stroke, 0 to 1, that a table corrects beyond the positions of the runs, at either end.
    share : float
        Largest standard uncertainty of the model as a share of the predicted improvement.
    age_h, temperature_c, drift_mm, runs : float, pair, float, int
        Largest age of the measurement, range of the air temperature, largest rms residual of the solution in a newer run, fewest runs.
    unattended_h, walk_mm : float
        For unattended pushes: hours since the last kept push; largest change of a value over 30 days.
    """

    value_mm: float = 0.1
    change_mm: float = 0.05
    step_mm: float = 0.02
    slope: float = 0.002
    second_mm: float = 0.01
    gain: float = 0.1
    k: float = 2.0
    share: float = 0.5
    age_h: float = 72.0
    temperature_c: tuple[float, float] = (18.0, 24.0)
    drift_mm: float = 0.003
    runs: int = 3
    unattended_h: float = 24.0
    walk_mm: float = 0.05
    beyond: float = 0.25

    def digest(self) -> str:
        """SHA-256 of the limits. Every approval contains it, so no approval holds under other limits."""
        return hashlib.sha256(canonical(asdict(self))).hexdigest()


@dataclass(frozen=True, slots=True)
class Column:
    """Correction of the axis ``corrected`` over the travel of the axis ``moved``; the control adds it to the command.

    ``left_mm``: the measured error that remains in this column with the table in force; a correction of opposite sign reduces it.
    ``reverse_mm``: corrections for the reverse approach, or empty; ``reversal_mm``: measured mean difference, reverse minus forward.
    """

    moved: str
    corrected: str
    position_mm: tuple[float, ...]
    correction_mm: tuple[float, ...]
    left_mm: tuple[float, ...] = ()
    reverse_mm: tuple[float, ...] = ()
    reversal_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class TableEvidence:
    """The measurement and the prediction behind a table. Lengths mm; ``machine_mark``: see `CandidateContext`.

    ``before_mm``, ``after_mm``, ``u_mm``: predicted rms without and with the table, and the model's standard uncertainty. ``drift_mm``: rms
    residual of the solution in a newer run, 0 if none. ``temperature_c``: lowest and highest air temperature. ``ended_s``, ``last_s``:
    end of the oldest and of the newest run, seconds UTC; ``last_s`` None: the same as ``ended_s``.
    ``reached_mm``: lowest and highest position of each axis in the runs; empty if it is not known.
    """

    run_count: int
    ended_s: float
    temperature_c: tuple[float, float]
    drift_mm: float
    u_mm: float
    before_mm: float
    after_mm: float
    machine_mark: str
    calibrated_until_s: tuple[float, ...]
    last_s: float | None = None
    reached_mm: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class EvidenceSeal:
    """Person who vouches for the table: role, and SHA-256 of the signed content; both are empty without a signature."""

    role: str = ""
    digest: str = ""


@dataclass(frozen=True, slots=True)
class Candidate:
    """A proposed table. ``base_crc``: CRC of the table in force during the measurement, the only table that the candidate may replace."""

    machine: str
    map_version: int
    lsb_nm: int
    length_unit: str
    columns: tuple[Column, ...]
    base_crc: int
    evidence: TableEvidence
    digest: str
    seal: EvidenceSeal = field(default_factory=EvidenceSeal)


@dataclass(frozen=True, slots=True)
class CandidateContext:
    """Reference for checks of a candidate: this machine, its controller, the table in force, the time.

    Parameters
    ----------
    machine, machine_mark : str
        Name; mark that changes when older measurements no longer hold (the boot ids of the controller).
    map_version, lsb_nm, bank_registers : int
        Register map of this program, as a controller with another one is refused at its connection; unit of a table's values and size of a
        bank, as the controller states them.
    travel_mm : dict
        Axis -> (lowest, highest) position.
    grid_mm : dict
        Axis -> the controller's grid, where it prescribes one.
    active_crc, active : int, dict
        Table in force: its CRC; (moved, corrected) -> corrections on the candidate's grid, empty for no correction.
    month_ago : dict
        As ``active``, for the table of 30 days ago.
    now_s : float
        Seconds UTC.
    attended : bool
        An authorised approver is at the machine.
    last_push_s : float
        Time of the last kept push, seconds UTC; minus infinity for never.
    """

    machine: str
    machine_mark: str
    map_version: int
    lsb_nm: int
    bank_registers: int
    travel_mm: dict[str, tuple[float, float]]
    grid_mm: dict[str, tuple[float, ...]]
    active_crc: int
    active: dict[tuple[str, str], tuple[float, ...]]
    month_ago: dict[tuple[str, str], tuple[float, ...]]
    now_s: float
    attended: bool = True
    last_push_s: float = float("-inf")


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
        yield f"SCALE: one unit is {c.lsb_nm} nm in the table, {context.lsb_nm} nm in the controller"
    if c.length_unit != "mm":
        yield f"UNIT: lengths are in {c.length_unit!r}, not in mm"
    if c.base_crc != context.active_crc:
        yield f"BASE: measured with table {c.base_crc:08X}, but table {context.active_crc:08X} is active"


def _form(c: Candidate, context: CandidateContext) -> Iterator[str]:
    names = [(column.moved, column.corrected) for column in c.columns]
    if sorted(names) != [(a, i) for a in AXES for i in AXES]:
        yield f"FORM AXES: expected one column for each of X, Y, Z over each of X, Y, Z, got {len(names)} columns"
        return
    registers = HEADER_REGISTERS + sum(len(column.correction_mm) for column in c.columns)
    if registers > context.bank_registers:
        yield f"FORM SIZE: the table needs {registers} registers, a bank has {context.bank_registers}"
    for column in c.columns:
        reason = _column_form(column, context)
        if reason:
            yield f"FORM {reason} (table of {column.corrected} over {column.moved})"


def _column_form(column: Column, context: CandidateContext) -> str:
    position, n = column.position_mm, len(column.position_mm)
    if n < 2 or len(column.correction_mm) != n or (column.left_mm and len(column.left_mm) != n):
        return f"SIZE: {n} positions, but {len(column.correction_mm)} corrections and {len(column.left_mm)} residuals"
    if column.reverse_mm and len(column.reverse_mm) != n:
        return f"SIZE: {len(column.reverse_mm)} reverse values, but {n} positions"
    if not all(b > a for a, b in pairwise(position)):
        return "POSITIONS: the positions do not increase strictly"
    low, high = context.travel_mm[column.moved]
    if not low - 1e-6 <= position[0] <= position[-1] <= high + 1e-6:
        return f"TRAVEL: the table covers {position[0]:g} to {position[-1]:g} mm, the axis goes from {low:g} to {high:g} mm"
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
        yield f"STALE: measured {(context.now_s - e.ended_s) / 3600.0:.1f} h ago, the limits are 0 to {limits.age_h:g} h"
    if e.machine_mark != context.machine_mark:
        yield "CHANGED: the control was restarted during or since the measurement: measure again"
    if not low <= e.temperature_c[0] <= e.temperature_c[1] <= high:
        yield f"TEMPERATURE: {e.temperature_c[0]:.1f} to {e.temperature_c[1]:.1f} °C, the limits are {low:g} to {high:g} °C"
    if e.run_count < limits.runs:
        yield f"RUNS: {e.run_count} measured, but {limits.runs} are needed"
    if drift := drift_reason(e.drift_mm, limits):
        yield drift
    if promise := promise_reason(e.before_mm, e.after_mm, e.u_mm, limits):
        yield f"PROMISE: {promise}"
    if not e.calibrated_until_s:
        yield "CERTIFICATE: the instruments have no calibration certificate"
    elif not min(e.calibrated_until_s) >= newest_s:
        yield "CERTIFICATE: an instrument's certificate had ended before the measurement"
    yield from _reach(c, context, limits)


def _reach(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Yield the reason for each axis whose table extends too far beyond the positions of the runs, where the map is only assumed.

    The whole grid counts, even where a correction is constant: the tables of one axis act at every position of the others.
    """
    for axis, (low, high) in zip(AXES, c.evidence.reached_mm, strict=False):
        grids = [column.position_mm for column in c.columns if column.moved == axis and column.position_mm]
        travel = context.travel_mm[axis][1] - context.travel_mm[axis][0]
        beyond = max((max(low - grid[0], grid[-1] - high) / travel for grid in grids), default=0.0)
        if not beyond <= limits.beyond:
            yield (
                f"REACH: the runs moved {axis} from {low:.0f} to {high:.0f} mm, but the table corrects {beyond:.0%} of the stroke beyond "
                f"that, the limit is {limits.beyond:.0%} ([limits] table_beyond_percent)"
            )


def drift_reason(drift_mm: float, limits: PushLimits) -> str:
    """Return the reason why the drift (rms residual of the solution in a newer run) is too large; empty if it is not."""
    if drift_mm <= limits.drift_mm:
        return ""
    return f"DRIFT: a newer run deviates from the solution by {drift_mm * 1e3:.1f} µm rms, the limit is {limits.drift_mm * 1e3:.1f} µm"


def promise_reason(before_mm: float, after_mm: float, u_mm: float, limits: PushLimits) -> str:
    """Return the reason why the predicted improvement is too small to write a table; empty if it is large enough.

    ``before_mm``, ``after_mm``, ``u_mm``: predicted rms without and with the table, and the model's standard uncertainty.
    """
    gain = before_mm - after_mm
    if u_mm <= limits.share * gain and gain > limits.k * u_mm and gain >= limits.gain * before_mm:
        return ""
    promise = f"the tables promise {before_mm * 1e3:.1f} → {after_mm * 1e3:.1f} µm rms"
    return f"{promise} (model uncertainty {u_mm * 1e3:.1f} µm): not enough to write"


def _policy(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Yield the reasons of limits that hold only for unattended pushes: minimum interval, and drift of the tables over 30 days."""
    if context.attended:
        return
    if context.now_s - context.last_push_s < limits.unattended_h * 3600.0:
        yield f"POLICY TIME: the last kept push was less than {limits.unattended_h:g} h ago, too soon for an unattended one"
    for column in c.columns:
        then = context.month_ago.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)
        walk = max((abs(a - b) for a, b in zip(column.correction_mm, then, strict=False)), default=0.0)
        if not walk <= limits.walk_mm:
            yield f"POLICY WALK: {column.corrected} over {column.moved} moved {walk * 1e3:.1f} µm in 30 days"


def _seal(c: Candidate) -> Iterator[str]:
    digest = content_digest(c)
    if c.digest != digest:
        yield "HASH: the table does not match its digest"
    if not c.seal.role:
        yield "UNSIGNED: the table has no signature"
    elif c.seal.role not in SIGNERS:
        yield f"ROLE: the table is signed by a {c.seal.role}, only a metrologist may sign it"
    elif c.seal.digest != digest:
        yield "SIGNATURE: the signature is for another table"


def number_reasons(candidate: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Yield all reasons against the numbers of a candidate whose form has been checked."""
    odd = [reason for column in candidate.columns if (reason := _odd(column))]
    if odd:
        yield from odd
        return
    lsb_mm = context.lsb_nm * 1e-6
    for column in candidate.columns:
        name = f"table of {column.corrected} over {column.moved}"
        active = context.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)
        for reason in _size(column, active, limits, lsb_mm):
            yield f"{reason} ({name})"
    for axis in sorted({column.corrected for column in candidate.columns}):
        total_mm = sum(max(abs(v) for v in column.correction_mm) for column in candidate.columns if column.corrected == axis)
        yield from together_reasons(axis, total_mm, limits)
    yield from _whole(candidate, context, limits)


def _odd(column: Column) -> str:
    for value in (*column.correction_mm, *column.reverse_mm, *column.left_mm, *column.position_mm):
        if not math.isfinite(value):
            return f"NUMBER: {value} is not finite (table of {column.corrected} over {column.moved})"
        if value == 0.0 and math.copysign(1.0, value) < 0.0:
            return f"NUMBER: minus zero (table of {column.corrected} over {column.moved})"
        if value != 0.0 and abs(value) < sys.float_info.min:
            return f"NUMBER: {value} is denormal (table of {column.corrected} over {column.moved})"
    return ""


def size_reasons(p: Sequence[float], v: Sequence[float], active: Sequence[float], limits: PushLimits) -> Iterator[str]:
    """Reasons against values, changes, steps and second differences of one table that exceed the limits.

    ``p``, ``v``, ``active``: positions, new corrections and those in force, mm.
    """
    steps = [b - a for a, b in pairwise(v)]
    changes = [a - b for a, b in zip(v, active, strict=True)]
    bends = [b - a for a, b in pairwise(steps)]
    for word, sizes, limit, key in (
        ("VALUE", v, limits.value_mm, "table_value_um"),
        ("CHANGE", changes, limits.change_mm, "table_change_um"),
        ("STEP", steps, limits.step_mm, "table_step_um"),
        ("BEND", bends, limits.second_mm, ""),
    ):
        k = max(range(len(sizes)), key=lambda n: abs(sizes[n]), default=0)
        if sizes and abs(sizes[k]) > limit:
            allowed = f"the limit is {limit * 1e3:.1f} µm" + (f" ([limits] {key})" if key else "")
            yield f"{word}: {abs(sizes[k]) * 1e3:.1f} µm at {p[k]:.1f} mm, {allowed}"


def together_reasons(axis: str, total_mm: float, limits: PushLimits) -> Iterator[str]:
    """Yield the reason if the largest values of an axis' three tables add up to too much; ``total_mm``: their sum."""
    if total_mm > limits.value_mm:
        allowed = f"the limit is {limits.value_mm * 1e3:.1f} µm ([limits] table_value_um)"
        yield f"VALUE: the tables of {axis} together reach {total_mm * 1e3:.1f} µm, {allowed}"


def _size(column: Column, active: tuple[float, ...], limits: PushLimits, lsb_mm: float) -> Iterator[str]:
    v, p = column.correction_mm, column.position_mm
    counts = max(abs(x) / lsb_mm for x in v)
    if round(counts) > LARGEST:
        yield f"OVERFLOW: {counts:.0f} units do not fit 16 bits"
    if len(active) != len(v):
        yield "CHANGE: the table in force has another grid, and its values on the new grid are missing"
        return
    yield from size_reasons(p, v, active, limits)
    slopes = [abs(d - c) / (b - a) for c, d, a, b in zip(v, v[1:], p, p[1:], strict=False)]
    if max(slopes) > limits.slope:
        yield f"SLOPE: {max(slopes) * 1e3:.2f} µm/mm, the limit is {limits.slope * 1e3:.2f} µm/mm"
    if abs(v[0]) > ZERO_MM:
        yield f"REFERENCE: {v[0] * 1e3:.2f} µm at the reference instead of 0"
    if max(abs(x / lsb_mm - round(x / lsb_mm)) for x in v) > WHOLE:
        yield "ROUNDING: values are not whole units of the table; quantise it first"
    if column.reverse_mm:
        yield from _reverse(column)


def _reverse(column: Column) -> Iterator[str]:
    """Check that the difference between the two directions reduces the measured reversal instead of doubling it."""
    table = sum(b - a for a, b in zip(column.correction_mm, column.reverse_mm, strict=True)) / len(column.reverse_mm)
    if abs(column.reversal_mm + table) > abs(column.reversal_mm):
        measured_um, table_um = column.reversal_mm * 1e3, table * 1e3
        yield f"DIRECTIONS: the two columns are exchanged (measured {measured_um:.1f} µm, the table adds {table_um:.1f} µm)"


def _whole(c: Candidate, context: CandidateContext, limits: PushLimits) -> Iterator[str]:
    """Predict the residuals with the new table from the residuals measured with the table in force."""
    values = [x for column in c.columns for x in column.correction_mm]
    active = [x for column in c.columns for x in _active(column, context)]
    none_mm = WHOLE * 1e-6 * c.lsb_nm
    if len(values) == len(active) and all(abs(new - old) <= none_mm for new, old in zip(values, active, strict=True)):
        yield "SAME: this table is in force already"
        return
    if not any(values) and any(active):
        yield "ZERO: the new table is all zeros and would only remove the one in force: use a rollback"
    left = [x for column in c.columns for x in column.left_mm]
    if len(left) != len(values) or len(active) != len(values):
        yield "RESIDUAL: the machine's residuals are missing, so nothing can be predicted"
        return
    after = [e + (new - old) for e, new, old in zip(left, values, active, strict=True)]
    before_mm, after_mm = _rms(left), _rms(after)
    if not after_mm <= (1.0 - limits.gain) * before_mm:
        opposed = sum(e * (new - old) for e, new, old in zip(left, values, active, strict=True)) > 0.0
        word = "SIGN: the table adds to the error" if opposed else "GAIN: the table removes too little of the error"
        yield f"{word}: {before_mm * 1e3:.2f} → {after_mm * 1e3:.2f} µm rms predicted"


def _active(column: Column, context: CandidateContext) -> tuple[float, ...]:
    return context.active.get((column.moved, column.corrected)) or (0.0,) * len(column.correction_mm)


def _rms(values: list[float]) -> float:
    return math.sqrt(sum(v * v for v in values) / len(values))
