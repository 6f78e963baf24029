"""Computed against stored: what was compared, how far off it was, and what the file does not allow to compute."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from abbe.service.vectors.case import VectorCase

Unit = Literal["mm", "rad", "1"]
LIMIT: dict[str, float] = {"mm": 1e-9, "rad": 1e-12, "1": np.inf}
"""Largest deviation that is ever accepted unless a coarser rounding of the vector is stated (issue: 1e-9 mm, 1e-12 rad)."""
RELATIVE = 1e-11
"""Of the stored value. An altered 8th digit is 1e-8 or more of an output; the rest of the margin catches most altered inputs as well."""


@dataclass
class Quantity:
    """All comparisons of one quantity of one file.

    ``floor`` is the rounding of the stored number itself in ``unit``, with its reason in ``rounding``; a comparison holds when it is off by
    no more than the larger of ``floor`` and ``relative`` times the stored value, and never by more than the larger of ``floor`` and LIMIT.
    Where comparisons of one quantity have different roundings each is held to its own, and the largest is shown. ``allowed`` is what acted
    where the quantity was farthest off (``worst``).
    """

    name: str
    unit: Unit
    floor: float
    rounding: str
    relative: float = RELATIVE
    cases: int = 0
    values: int = 0
    max_abs: float = 0.0
    max_rel: float = 0.0
    worst: str = ""
    allowed: float = 0.0
    failures: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        """Whether every comparison held."""
        return not self.failures

    def doc(self) -> dict[str, Any]:
        """For ``--json``; a deviation that is no number (nothing was computed) is null."""
        return {
            "name": self.name,
            "unit": self.unit,
            "cases": self.cases,
            "values": self.values,
            "max_abs_deviation": _finite(self.max_abs),
            "max_rel_deviation": _finite(self.max_rel),
            "allowed_at_worst": self.allowed,
            "rounding_of_vector": self.floor,
            "rounding_relative": self.relative,
            "rounding_why": self.rounding,
            "worst": self.worst,
            "ok": self.ok,
            "failures": self.failures,
        }


@dataclass
class NotComputable:
    """Numbers of a file that its own inputs do not determine, with the reason."""

    name: str
    numbers: int
    why: str


@dataclass
class Checks:
    """Result of one vector file."""

    file: str
    quantities: dict[str, Quantity] = field(default_factory=dict)
    forms: dict[str, Quantity] = field(default_factory=dict)
    """Inputs that nothing computes, held to the form that they must have."""
    not_computable: list[NotComputable] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    """Layout facts that the file does not state, found by trial."""
    unread: list[str] = field(default_factory=list)
    refused: str = ""
    """Why a public function would not take the inputs of the file, if so."""
    error: str = ""
    """Why the file is unusable (unreadable, another layout), if so; what was compared before that still stands."""

    def compare(
        self,
        name: str,
        computed: ArrayLike,
        stored: VectorCase,
        *,
        unit: Unit,
        floor: float = 1e-15,
        rounding: str = "float64",
        relative: float = RELATIVE,
    ) -> None:
        """Compare a computed value with the stored one (number or nested list of the same shape).

        Parameters
        ----------
        name : str
            Quantity; the same name in every case of a file.
        computed : array_like
            From the public functions, using the inputs of the case only.
        stored : VectorCase
            The part of the file that holds the expected value.
        unit : "mm" | "rad" | "1"
        floor : float
            Rounding of the stored value in ``unit``.
        rounding : str
            Why it is that large, in a few words.
        relative : float
            Rounding as a share of the stored value: larger for ill-conditioned figures, smaller for plain sums.
        """
        self._compare(self.quantities, Quantity(name, unit, floor, rounding, relative), computed, stored)

    def check_form(
        self, name: str, expected: ArrayLike, stored: VectorCase, *, unit: Unit = "1", floor: float = 1e-18, rounding: str = ""
    ) -> None:
        """Check numbers that nothing computes against the form that they must have: digits of print, a rotation, a grid.

        ``expected`` comes from the stored numbers themselves, therefore it is reported apart from what was computed and compared.

        Parameters
        ----------
        name, expected, stored, unit, floor, rounding
            As in `compare`; no share of the value is granted.
        """
        self._compare(self.forms, Quantity(name, unit, floor, rounding, 0.0), expected, stored)

    def _compare(self, known: dict[str, Quantity], this: Quantity, computed: ArrayLike, stored: VectorCase) -> None:
        q = known.setdefault(this.name, this)
        if this.unit != q.unit:
            raise TypeError(f"{self.file}: {q.name} is compared in {q.unit} and in {this.unit}")
        floor, relative = this.floor, this.relative
        if floor > q.floor:
            q.floor, q.rounding = floor, this.rounding
        q.relative = max(q.relative, relative)
        expected = stored.array()
        got = np.asarray(computed, dtype=np.float64)
        q.cases += 1
        q.values += expected.size
        if got.shape != expected.shape:
            q.failures.append(f"{stored.label}: computed shape {got.shape}, stored {expected.shape}")
            return
        off = np.where(np.isfinite(got), np.abs(got - expected), np.inf).ravel()
        size = np.abs(expected).ravel()
        allowed = np.maximum(floor, np.minimum(LIMIT[q.unit], relative * size))
        if off.max() >= q.max_abs:
            worst = int(off.argmax())
            q.max_abs, q.worst, q.allowed = float(off[worst]), stored.label, float(allowed[worst])
        large = size > floor
        if large.any():
            q.max_rel = max(q.max_rel, float((off[large] / size[large]).max()))
        for i in np.flatnonzero(off > allowed)[:3]:
            where = f"[{i}]" if off.size > 1 else ""
            q.failures.append(f"{stored.label}{where}: stored {float(expected.ravel()[i])!r}, computed {float(got.ravel()[i])!r}")

    def assume(self, text: str) -> None:
        """State a fact of the layout that the file does not, and that was found by trial: with it, and only so, the figures agree."""
        if text not in self.assumptions:
            self.assumptions.append(text)

    def leave_out(self, name: str, part: VectorCase, why: str) -> None:
        """State that numbers of a file cannot be computed from its inputs, and why."""
        self.not_computable.append(NotComputable(name, part.skip(), why))

    @property
    def ok(self) -> bool:
        """Every comparison and form held, every number of the file was used, no input was refused, the file could be read."""
        held = all(q.ok for q in (*self.quantities.values(), *self.forms.values()))
        return held and bool(self.quantities) and not (self.error or self.refused or self.unread)

    def doc(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "file": self.file,
            "ok": self.ok,
            "error": self.error,
            "quantities": [q.doc() for q in self.quantities.values()],
            "forms": [q.doc() for q in self.forms.values()],
            "not_computable": [{"name": n.name, "numbers": n.numbers, "why": n.why} for n in self.not_computable],
            "assumptions": self.assumptions,
            "unread": self.unread,
            "refused": self.refused,
        }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
