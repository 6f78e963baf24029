"""Printed numbers, whose digits define their rounding, and their agreement with computed ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from decimal import Decimal
from typing import ClassVar, Literal, TypeAlias

Fit = Literal["equal", "rounding", "padding", "bound", "no"]
"""Agreement: to the last printed digit; within the rounding of the inputs; only if trailing zeros are padding; a bound holds; none."""

FLOAT = 1e-12
"""Relative tolerance for the rounding of float64 in a comparison of decimal digits."""
OPERANDS = "rounding of the printed operands"


@dataclass(frozen=True, slots=True)
class Printed:
    """One printed number, exactly as printed.

    Parameters
    ----------
    text : str
        Digits as printed, e.g. ``"-8.5619E-05"``; trailing zeros are significant.
    bound : bool
        Whether the paper prints an upper bound instead of the number.
    last : str, optional
        Unit of the last digit if the text does not show it: ``"0.1"`` for a ``"0"`` in a column of tenths.
    digits, padding : int and str, optional
        Number of significant digits if the zeros after them are padding, and the reason. Padding is an assumption: it never makes a number
        reproduced.
    """

    text: str
    bound: bool = False
    last: str = ""
    digits: int | None = None
    padding: str = ""

    def __post_init__(self) -> None:
        """Check that digits and padding are given together."""
        if (self.digits is None) != (self.padding == ""):
            raise ValueError(f"{self.text}: digits and the reason why zeros are padding belong together")

    @property
    def value(self) -> float:
        """Value of the number."""
        return float(self.text)

    @property
    def exponent(self) -> int:
        """Power of ten of the last printed digit."""
        exponent = Decimal(self.last or self.text).as_tuple().exponent
        if not isinstance(exponent, int):
            raise ValueError(f"{self.text!r} is not a finite number")
        return exponent

    @property
    def rounding(self) -> float:
        """Half a unit of the last printed digit, the largest rounding error."""
        return _half(self.exponent)

    @property
    def rounding_if_padded(self) -> float:
        """Half a unit of the last significant digit if the zeros after it are padding."""
        number = Decimal(self.text)
        return self.rounding if self.digits is None or number == 0 else _half(number.adjusted() - self.digits + 1)


@dataclass(frozen=True, slots=True)
class Given:
    """An input that a computation must return within a tolerance; input and tolerance are in the unit of the comparison."""

    value: float
    tolerance: float
    bound: ClassVar[bool] = False
    padding: ClassVar[str] = ""

    @property
    def text(self) -> str:
        """The number, rounded to a tenth of the tolerance."""
        return f"{self.value:.{self._decimals + 1}f}"

    @property
    def last(self) -> str:
        """The number 1 with as many decimals as computed numbers get at this tolerance."""
        return f"{1.0:.{self._decimals}f}"

    @property
    def rounding(self) -> float:
        """Largest accepted difference."""
        return self.tolerance

    @property
    def rounding_if_padded(self) -> float:
        """Largest accepted difference; without printed digits the same as `rounding`."""
        return self.tolerance

    @property
    def _decimals(self) -> int:
        return max(0, -math.floor(math.log10(self.tolerance)))


Expected: TypeAlias = Printed | Given


def _half(exponent: int) -> float:
    return float(Decimal(5).scaleb(exponent - 1))


def printed(*texts: str) -> tuple[Printed, ...]:
    """Return several printed numbers, e.g. a row of a table."""
    return tuple(Printed(t) for t in texts)


def values(numbers: tuple[Printed, ...]) -> list[float]:
    """Return the values of printed numbers."""
    return [n.value for n in numbers]


@dataclass(frozen=True, slots=True)
class Computed:
    """A computed number with the uncertainty of its inputs.

    Attributes
    ----------
    allowance : float
        Largest error from inputs or method (rounded operands, neglected second order); zero if they are exact.
    because : str
        Sources of the allowance.
    allowance_if_padded, padding : float and str
        Allowance if trailing zeros of an input are padding, and the reason; not used without such inputs.
    """

    value: float
    allowance: float = 0.0
    because: str = ""
    allowance_if_padded: float = 0.0
    padding: str = ""


def fit(computed: Computed, number: Expected) -> Fit:
    """Return how a computed number agrees with the printed one.

    A bound limits the absolute value. The printed bound is rounded, so the value may exceed it by half a unit of the bound's last digit.
    """
    slack = FLOAT * max(abs(computed.value), abs(number.value))
    if number.bound:
        return "bound" if abs(computed.value) <= number.value + number.rounding + computed.allowance + slack else "no"
    off = abs(computed.value - number.value) - slack
    if off <= number.rounding:
        return "equal"
    if off <= number.rounding + computed.allowance:
        return "rounding"
    return "padding" if off <= within_if_padded(computed, number) else "no"


def agrees(computed: Computed, number: Expected) -> bool:
    """Return whether a computed number equals the printed one or lies within the rounding of its inputs, without padded zeros."""
    return fit(computed, number) not in ("padding", "no")


def within_if_padded(computed: Computed, number: Expected) -> float:
    """Return the largest allowed difference if trailing zeros of printed numbers are padding."""
    return number.rounding_if_padded + max(computed.allowance, computed.allowance_if_padded)


def computed_from(function: Callable[..., float], *inputs: Printed, because: str = OPERANDS) -> Computed:
    """Evaluate a function of printed numbers, with the effect of their rounding as allowance.

    The allowance is the first-order worst case: the sum, over the inputs, of the larger change by half a unit of the last digit up or down.
    """
    at = [p.value for p in inputs]
    value = function(*at)

    def moved(i: int, half: float) -> float:
        return max(abs(function(*at[:i], at[i] + side * half, *at[i + 1 :]) - value) for side in (-1.0, 1.0))

    each = [moved(i, p.rounding) for i, p in enumerate(inputs)]
    padded = [moved(i, p.rounding_if_padded) if p.padding else change for i, (p, change) in enumerate(zip(inputs, each, strict=True))]
    reasons = dict.fromkeys(p.padding for p in inputs if p.padding)
    return Computed(float(value), float(sum(each)), because, float(sum(padded)), "; ".join(reasons))
