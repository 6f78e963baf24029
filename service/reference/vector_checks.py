"""Comparison of computed numbers with those stored in vector files, and a record of those that cannot be computed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from abbe.service.reference.vector_file import VectorCase

Unit = Literal["mm", "rad", "1"]
LIMIT: dict[str, float] = {"mm": 1e-9, "rad": 1e-12, "1": np.inf}
"""Largest accepted deviation, unless the stored number is stated to be rounded more coarsely."""
RELATIVE = 1e-11
"""Accepted deviation as a share of the stored value, far below the 1e-8 of an altered eighth digit."""


@dataclass
class Quantity:
    """All comparisons of one quantity of one file.

    ``floor`` is the rounding of the stored numbers in ``unit``, with its reason in ``rounding``. The tolerance of a comparison is the
    smaller of LIMIT and ``relative`` times the stored value, but at least ``floor``. If comparisons have different roundings, the largest
    is kept. ``worst`` names the place of the largest deviation, ``allowed`` is the tolerance there.
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

    def to_document(self) -> dict[str, Any]:
        """Return the JSON value for ``--json``; a deviation that is not finite (nothing was computed) is null."""
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
    """Numbers that are only checked for their form (`check_form`)."""
    not_computable: list[NotComputable] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    """Assumptions about the file that it does not state, found by trial."""
    unread: list[str] = field(default_factory=list)
    refused: str = ""
    """Why a function refused inputs of the file; else empty."""
    error: str = ""
    """Why the file is unusable (unreadable, unknown layout); else empty. Comparisons made before remain valid."""

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
            Name of the quantity, the same in every case of a file.
        computed : array_like
            Computed from the inputs of the case only.
        stored : VectorCase
            Part of the file with the expected value.
        floor : float
            Rounding of the stored value in ``unit``.
        rounding : str
            Reason for the floor.
        relative : float
            Rounding as a share of the stored value: larger for ill-conditioned results, smaller for plain sums.
        """
        self._compare(self.quantities, Quantity(name, unit, floor, rounding, relative), computed, stored)

    def check_form(
        self, name: str, expected: ArrayLike, stored: VectorCase, *, unit: Unit = "1", floor: float = 1e-18, rounding: str = ""
    ) -> None:
        """Check the form of numbers that are not computed, e.g. that a matrix is a rotation.

        ``expected`` comes from the stored numbers themselves, so the result is reported separately. The other parameters are those of
        `compare`.
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
            index = f"[{i}]" if off.size > 1 else ""
            q.failures.append(f"{stored.label}{index}: stored {float(expected.ravel()[i])!r}, computed {float(got.ravel()[i])!r}")

    def assume(self, text: str) -> None:
        """Record an assumption about the file, found by trial, without which the numbers do not agree."""
        if text not in self.assumptions:
            self.assumptions.append(text)

    def leave_out(self, name: str, part: VectorCase, why: str) -> None:
        """Record why a part of the file cannot be computed from its inputs."""
        self.not_computable.append(NotComputable(name, part.skip(), why))

    @property
    def ok(self) -> bool:
        """Whether all comparisons and forms hold, every number was used, no input was refused, and the file was readable."""
        passed = all(q.ok for q in (*self.quantities.values(), *self.forms.values()))
        return passed and bool(self.quantities) and not (self.error or self.refused or self.unread)

    def to_document(self) -> dict[str, Any]:
        """Return the JSON value for ``--json``."""
        return {
            "file": self.file,
            "ok": self.ok,
            "error": self.error,
            "quantities": [q.to_document() for q in self.quantities.values()],
            "forms": [q.to_document() for q in self.forms.values()],
            "not_computable": [{"name": n.name, "numbers": n.numbers, "why": n.why} for n in self.not_computable],
            "assumptions": self.assumptions,
            "unread": self.unread,
            "refused": self.refused,
        }


def _finite(value: float) -> float | None:
    return value if np.isfinite(value) else None
