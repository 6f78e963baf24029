"""The 40 classes of bad tables of reliability.md 2d: each spoils a good candidate, in ten ways drawn from a fixed seed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from random import Random

from abbe.service.push.validate import Candidate, CandidateContext, Column, EvidenceSeal, TableEvidence, content_digest

LSB_MM = 1e-4
NOW_S = 1.8e9
N = 9
Made = tuple[Candidate, CandidateContext]


def good(rng: Random) -> Made:
    """A table that nothing speaks against, with the context that it is for."""
    columns = tuple(_column(a, i, rng) for a in "XYZ" for i in "XYZ")
    active = {(c.moved, c.corrected): (0.0,) * N for c in columns} | {("X", "X"): (0.0, *(10 * LSB_MM,) * (N - 1))}
    evidence = TableEvidence(4, NOW_S - 3600.0, (20.0, 20.6), 0.0005, 0.0004, 0.006, 0.0005, "mark 7", (NOW_S + 1e6, NOW_S + 2e6))
    context = CandidateContext("mill", "mark 7", 1, 100, 4800, dict.fromkeys("XYZ", (0.0, 800.0)), {}, 0xABCD, active, {}, NOW_S)
    return signed(Candidate("mill", 1, 100, "mm", columns, 0xABCD, evidence, "")), context


def _column(moved: str, corrected: str, rng: Random) -> Column:
    pitch = 80.0
    height = rng.choice((-1, 1)) * rng.randint(60, 90)
    counts = [round(height * math.sin(math.pi * k / (2 * (N - 1)))) for k in range(N)]
    values = tuple(k * LSB_MM for k in counts)
    before = (0.0, *(10 * LSB_MM,) * (N - 1)) if (moved, corrected) == ("X", "X") else (0.0,) * N
    left = tuple(b - v + rng.uniform(-2e-5, 2e-5) for v, b in zip(values, before, strict=True))
    return Column(moved, corrected, tuple(pitch * k for k in range(N)), values, left)


def signed(candidate: Candidate, role: str = "metrologist") -> Candidate:
    digest = content_digest(candidate)
    return replace(candidate, digest=digest, seal=EvidenceSeal(role, digest))


def _with(candidate: Candidate, at: int, **change: object) -> Candidate:
    columns = list(candidate.columns)
    columns[at] = replace(columns[at], **change)
    return signed(replace(candidate, columns=tuple(columns)))


def _values(change: Callable[[tuple[float, ...], Random], tuple[float, ...]]) -> Callable[[Random], Made]:
    """A class that spoils the corrections of one column."""

    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        at = rng.randrange(9)
        return _with(candidate, at, correction_mm=change(candidate.columns[at].correction_mm, rng)), context

    return make


def _everywhere(factor: float) -> Callable[[Random], Made]:
    """A class that multiplies the whole table, the first one of its machine."""

    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        columns = tuple(
            replace(
                c, correction_mm=tuple(factor * v if v else 0.0 for v in c.correction_mm), left_mm=tuple(0.0 - v for v in c.correction_mm)
            )
            for c in candidate.columns
        )
        return signed(replace(candidate, columns=columns)), replace(context, active={})

    return make


def _positions(change: Callable[[list[float], Random], list[float]]) -> Callable[[Random], Made]:
    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        at = rng.randrange(9)
        return _with(candidate, at, position_mm=tuple(change(list(candidate.columns[at].position_mm), rng))), context

    return make


def _swapped(p: list[float], k: int) -> list[float]:
    return [*p[:k], p[k + 1], p[k], *p[k + 2 :]]


def _size(n: Callable[[Random], int]) -> Callable[[Random], Made]:
    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        at, many = rng.randrange(9), n(rng)
        values = (candidate.columns[at].correction_mm * (many // N + 1))[:many]
        return _with(candidate, at, correction_mm=values), context

    return make


def _evidence(**change: Callable[[Random], object]) -> Callable[[Random], Made]:
    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        evidence = replace(candidate.evidence, **{name: draw(rng) for name, draw in change.items()})
        return signed(replace(candidate, evidence=evidence)), context

    return make


def _candidate(**change: Callable[[Random], object]) -> Callable[[Random], Made]:
    def make(rng: Random) -> Made:
        candidate, context = good(rng)
        return signed(replace(candidate, **{name: draw(rng) for name, draw in change.items()})), context

    return make


def _put(values: tuple[float, ...], at: int, value: float) -> tuple[float, ...]:
    return (*values[:at], value, *values[at + 1 :])


def _wrong_axis(rng: Random) -> Made:
    candidate, context = good(rng)
    return _with(candidate, rng.randrange(9), **{rng.choice(("moved", "corrected")): rng.choice("ABCxw")}), context


def _wrong_grid(rng: Random) -> Made:
    candidate, context = good(rng)
    return candidate, replace(context, grid_mm={rng.choice("XYZ"): tuple(80.0 * k + rng.uniform(0.1, 5.0) for k in range(N))})


def _exchanged(rng: Random) -> Made:
    """The column of the way back stands where that of the way there belongs."""
    candidate, context = good(rng)
    at, play = rng.randrange(9), rng.uniform(0.002, 0.005)
    there = candidate.columns[at].correction_mm
    return _with(candidate, at, reverse_mm=tuple(v + play for v in there), reversal_mm=play), context


def _all_zero(rng: Random) -> Made:
    candidate, context = good(rng)
    return signed(replace(candidate, columns=tuple(replace(c, correction_mm=(0.0,) * N) for c in candidate.columns))), context


def _the_same(rng: Random) -> Made:
    candidate, context = good(rng)
    decoded = {(c.moved, c.corrected): tuple(v + rng.uniform(-1e-12, 1e-12) for v in c.correction_mm) for c in candidate.columns}
    return candidate, replace(context, active=decoded)


def _changed_machine(rng: Random) -> Made:
    candidate, context = good(rng)
    return candidate, replace(context, machine_mark=f"mark {rng.randint(8, 99)}")


def _unsigned(rng: Random) -> Made:
    candidate, context = good(rng)
    return replace(candidate, seal=EvidenceSeal()), context


def _wrong_role(rng: Random) -> Made:
    candidate, context = good(rng)
    return signed(candidate, rng.choice(("viewer", "operator", "approver", "admin", "service"))), context


def _altered(rng: Random) -> Made:
    candidate, context = good(rng)
    at = rng.randrange(9)
    columns = list(candidate.columns)
    values = columns[at].correction_mm
    k = rng.randrange(1, N)
    columns[at] = replace(columns[at], correction_mm=_put(values, k, round(values[k] / LSB_MM + 1) * LSB_MM))
    return replace(candidate, columns=tuple(columns)), context


def _steep(rng: Random) -> Made:
    """Small steps, but on a grid so fine that the slope is a wall."""
    candidate, context = good(rng)
    at = rng.randrange(9)
    position = tuple(0.5 * k for k in range(N))
    return _with(candidate, at, position_mm=position), context


def _signed_wrong(rng: Random) -> Made:
    return _everywhere(-1.0)(rng)


CLASSES: dict[str, tuple[Callable[[Random], Made], str]] = {
    "size 0": (_size(lambda rng: 0), "FORM SIZE"),
    "size 1": (_size(lambda rng: 1), "FORM SIZE"),
    "size n - 1": (_size(lambda rng: N - 1), "FORM SIZE"),
    "size n + 1": (_size(lambda rng: N + rng.randint(1, 3)), "FORM SIZE"),
    "size 65535": (_size(lambda rng: 65535), "FORM SIZE"),
    "wrong axis": (_wrong_axis, "FORM AXES"),
    "wrong machine": (_candidate(machine=lambda rng: rng.choice(("mill 2", "", "Mill", "mill "))), "MACHINE"),
    "wrong map version": (_candidate(map_version=lambda rng: rng.choice((0, 2, 65535))), "MAP"),
    "sign inverted": (_signed_wrong, "SIGN"),
    "times 1000": (_everywhere(1000.0), "VALUE"),
    "times 0.001": (_everywhere(0.001), "GAIN"),
    "times 25.4": (_everywhere(25.4), "VALUE"),
    "wrong scale": (_candidate(lsb_nm=lambda rng: rng.choice((1, 10, 1000, 254))), "SCALE"),
    "columns of the directions exchanged": (_exchanged, "DIRECTIONS"),
    "positions not monotonic": (_positions(lambda p, rng: _swapped(p, rng.randrange(N - 1))), "FORM POS"),
    "a position twice": (_positions(lambda p, rng: (lambda k: [*p[:k], p[k - 1], *p[k + 1 :]])(rng.randrange(1, N))), "FORM POS"),
    "a position beyond the travel": (_positions(lambda p, rng: (lambda by: [x + by for x in p])(rng.uniform(161, 900))), "FORM TRAVEL"),
    "not the controller's grid": (_wrong_grid, "FORM GRID"),
    "not a number": (_values(lambda v, rng: _put(v, rng.randrange(N), math.nan)), "NUMBER"),
    "infinite": (_values(lambda v, rng: _put(v, rng.randrange(N), rng.choice((math.inf, -math.inf)))), "NUMBER"),
    "minus zero": (_values(lambda v, rng: _put(v, rng.randrange(N), -0.0)), "NUMBER"),
    "denormal": (_values(lambda v, rng: _put(v, rng.randrange(N), rng.choice((-1, 1)) * 5e-324 * rng.randint(1, 9))), "NUMBER"),
    "overflow of 16 bits": (_values(lambda v, rng: _put(v, N - 1, rng.choice((-1, 1)) * rng.randint(32768, 70000) * LSB_MM)), "OVERFLOW"),
    "value above the cap": (_values(lambda v, rng: tuple(rng.randint(1300, 1500) / (N - 1) * k // 1 * LSB_MM for k in range(N))), "VALUE"),
    "change above the cap": (_values(lambda v, rng: tuple(rng.choice((-70, 70)) * k * LSB_MM for k in range(N))), "CHANGE"),
    "step above the cap": (_values(lambda v, rng: _put(v, rng.randrange(1, N), 320 * LSB_MM)), "STEP"),
    "slope above the cap": (_steep, "SLOPE"),
    "second difference above the cap": (_values(lambda v, rng: tuple(150 * (k % 2) * LSB_MM for k in range(N))), "BEND"),
    "reference not zero": (_values(lambda v, rng: tuple(x + rng.choice((-20, 20)) * LSB_MM for x in v)), "REFERENCE"),
    "all zeros over a table": (_all_zero, "ZERO"),
    "identical to the table in force": (_the_same, "SAME"),
    "stale measurement": (_evidence(ended_s=lambda rng: NOW_S - rng.choice((73, 500, -1)) * 3600.0), "STALE"),
    "machine changed since": (_changed_machine, "CHANGED"),
    "temperature outside": (
        _evidence(temperature_c=lambda rng: rng.choice(((17.0, 20.0), (20.0, 25.0), (30.0, 31.0), (math.nan, 20.0)))), "TEMPERATURE",
    ),
    "uncertainty above half of the promise": (_evidence(u_mm=lambda rng: rng.uniform(0.0028, 0.02)), "PROMISE"),
    "too few runs": (_evidence(run_count=lambda rng: rng.randrange(3)), "RUNS"),
    "drift between first and last run": (_evidence(drift_mm=lambda rng: rng.choice((0.0031, 0.1, math.nan))), "DRIFT"),
    "wrong units in the metadata": (_candidate(length_unit=lambda rng: rng.choice(("inch", "um", "m", "", "MM"))), "UNIT"),
    "no certificate, or an expired one": (
        _evidence(calibrated_until_s=lambda rng: rng.choice(((), (NOW_S - 1e6, NOW_S + 1e6)))), "CERTIFICATE",
    ),
    "unsigned": (_unsigned, "UNSIGNED"),
    "signed by the wrong role": (_wrong_role, "ROLE"),
    "hash mismatch": (_altered, "HASH"),
}  # fmt: skip
EACH = 10
