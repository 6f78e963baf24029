"""Comparison of a number from outside with the computed one, and its status.

``math.md`` is the mathematical specification that comes with the vector files, not part of this repository; it adds numbers to the papers.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, Literal

from abbe.service.reference.printed import Computed, Expected, Fit, Printed, agrees, fit, within_if_padded

Status = Literal["reproduced", "consistent", "differs", "input", "not reproducible", "holds", "fails"]
Source = Literal["paper", "math.md", "own check"]
STATUSES: dict[Source, tuple[Status, ...]] = {
    "paper": ("reproduced", "consistent", "differs", "input", "not reproducible"),
    "math.md": ("reproduced", "consistent", "differs", "input", "not reproducible"),
    "own check": ("holds", "fails"),
}
"""Possible statuses of the numbers of each source."""
_OF_FIT: dict[Fit, Status] = {
    "equal": "reproduced",
    "rounding": "consistent",
    "padding": "consistent",
    "bound": "consistent",
    "no": "differs",
}


@dataclass(frozen=True, slots=True)
class Erratum:
    """A misprint, and the number computed with its correction (None if not computable)."""

    text: str
    again: Computed | None = None


@dataclass(frozen=True, slots=True)
class Comparison:
    """Comparison of one number from outside with the computed one.

    Attributes
    ----------
    location : str
        Table, equation or section of the number.
    expected : Printed or Given
        The printed number; in an own check, the input that must come back. In ``unit``.
    computed : Computed or None
        In ``unit``; None for an input, and if the paper lacks the inputs.
    how : str
        Inputs and function of the computation.
    why : str
        Why the number differs or cannot be computed, or what the comparison shows; required if the number is not computed.
    erratum : Erratum or None
        Misprint that may explain a difference.
    series : str
        Column of the number; text output shows a column with one status in one line.
    again : bool
        Whether another row already counts the printed number.
    source : "paper" | "math.md" | "own check"
        Source of the expected number. An own check tests a function with a paper's numbers and proves nothing about the paper.
    given : bool
        Whether the number is an input, or zero by construction, and so is not computed.
    """

    location: str
    quantity: str
    unit: str
    expected: Expected
    computed: Computed | None = None
    how: str = ""
    why: str = ""
    erratum: Erratum | None = None
    series: str = ""
    again: bool = False
    source: Source = "paper"
    given: bool = False

    def __post_init__(self) -> None:
        """Check that a number which is not computed has a reason, and that a computed one says how and is not an input."""
        name = f"{self.location}: {self.quantity}"
        if self.computed is None and not self.why:
            raise ValueError(f"{name} is not computed and has no reason")
        if self.computed is not None and not self.how:
            raise ValueError(f"{name} is computed and has no origin")
        if self.computed is not None and self.given:
            raise ValueError(f"{name} is an input and must not be computed")

    @property
    def difference(self) -> float | None:
        """Computed minus expected."""
        return None if self.computed is None else self.computed.value - self.expected.value

    @property
    def fit(self) -> Fit | None:
        """Agreement of expected and computed number; None without a computation."""
        return None if self.computed is None else fit(self.computed, self.expected)

    @property
    def status(self) -> Status:
        """Status of the number.

        Reproduced: equal to the last printed digit. Consistent: not equal, but within the rounding of the inputs, possibly under the
        assumption of padded zeros (see `remark`); also a bound that holds, since it confirms no digit. Differs: farther apart. Input:
        given, not computed. Not reproducible: inputs are not printed. An own check holds or fails.
        """
        if self.fit is None:
            return "input" if self.given else "not reproducible"
        if self.source == "own check":
            return "holds" if self.fit == "equal" else "fails"
        return _OF_FIT[self.fit]

    @property
    def within(self) -> float | None:
        """Largest difference that this status allows; None if the printed number is a bound, or if there is no computation."""
        if self.computed is None or self.expected.bound:
            return None
        if self.fit == "padding":
            return within_if_padded(self.computed, self.expected)
        return self.expected.rounding + self.computed.allowance

    @property
    def remark(self) -> str:
        """Basis of the status if it does not follow from the digits alone; else empty."""
        if self.computed is None:
            return ""
        if self.expected.bound:
            return _of_bound(self.computed.value, self.expected)
        return f"only if {_padding(self.computed, self.expected)}" if self.fit == "padding" else ""

    @property
    def again_fit(self) -> Fit | None:
        """How the number computed by the erratum agrees with the printed one; None without a computable erratum."""
        return None if self.erratum is None or self.erratum.again is None else fit(self.erratum.again, self.expected)

    @property
    def explained(self) -> bool | None:
        """Whether the erratum explains the printed number without an assumption about padded zeros (see `gap`); None if not computable."""
        return None if self.again_fit is None else self.again_fit not in ("padding", "no")

    @property
    def gap(self) -> str:
        """Text about the agreement with the erratum; empty without a computable erratum."""
        if self.erratum is None or self.erratum.again is None or self.again_fit is None:
            return ""
        if self.again_fit == "padding":
            return f"explained by the erratum only if {_padding(self.erratum.again, self.expected)}"
        return {
            "equal": "explained by the erratum",
            "bound": "explained by the erratum",
            "rounding": "explained by the erratum within the rounding of its inputs",
            "no": "NOT explained",
        }[self.again_fit]

    def to_document(self) -> dict[str, Any]:
        """Return the JSON value for ``--json``."""
        if self.source == "own check":
            return self._check_document()
        expected, computed = self.expected, self.computed
        return {
            "where": self.location,
            "quantity": self.quantity,
            "unit": self.unit,
            "printed": expected.value,
            "printed_text": expected.text,
            "printed_is_bound": expected.bound,
            "rounding": expected.rounding,
            "rounding_if_padded": expected.rounding_if_padded,
            "computed": None if computed is None else computed.value,
            "allowance": None if computed is None else computed.allowance,
            "allowance_because": "" if computed is None else computed.because,
            "allowance_if_padded": None if computed is None else max(computed.allowance, computed.allowance_if_padded),
            "padding_because": "" if computed is None else _padding(computed, expected),
            "difference": self.difference,
            "within": self.within,
            "status": self.status,
            "remark": self.remark,
            "how": self.how,
            "why": self.why,
            "erratum": None if self.erratum is None else {**asdict(self.erratum), "explained": self.explained, "gap": self.gap},
            "series": self.series,
            "again": self.again,
            "source": self.source,
        }

    def _check_document(self) -> dict[str, Any]:
        return {
            "where": self.location,
            "quantity": self.quantity,
            "unit": self.unit,
            "expected": self.expected.value,
            "found": None if self.computed is None else self.computed.value,
            "bound": self.expected.rounding,
            "how": self.how,
            "why": self.why,
            "series": self.series,
            "deviation": self.difference,
            "status": self.status,
        }


def stated(location: str, quantity: str, unit: str, number: Printed, value: float, how: str) -> Comparison:
    """Compare a number stated in math.md; if it differs, test whether double rounding explains it."""
    computed = Computed(value)
    if agrees(computed, number):
        return Comparison(location, quantity, unit, number, computed, how, source="math.md")
    twice = Computed(_rounded_twice(value, number))
    if agrees(twice, number):
        slip = Erratum("math.md rounds a rounded number", twice)
        return Comparison(location, quantity, unit, number, computed, how, erratum=slip, source="math.md")
    digits = abs(value - number.value) / (2.0 * number.rounding)
    why = f"off by {digits:.1f} units of the last digit that math.md states"
    return Comparison(location, quantity, unit, number, computed, how, why, source="math.md")


def _rounded_twice(value: float, number: Printed) -> float:
    once = Decimal(repr(value)).quantize(Decimal(1).scaleb(number.exponent - 1), ROUND_HALF_UP)
    return float(once.quantize(Decimal(1).scaleb(number.exponent), ROUND_HALF_UP))


def _of_bound(value: float, number: Expected) -> str:
    size = abs(value)
    if fit(Computed(value), number) != "bound":
        return f"bound broken: {size:.8g} against {number.text}"
    if size > number.value:
        return f"bound holds within its printed rounding: {size:.8g} exceeds {number.text} by {size - number.value:.1e}"
    return "bound holds"


def _padding(computed: Computed, number: Expected) -> str:
    return "; ".join(dict.fromkeys(reason for reason in (number.padding, computed.padding) if reason))
