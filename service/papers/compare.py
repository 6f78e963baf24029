"""Comparison of a computed with a printed number: equal digits, within the rounding of the inputs, under an assumption, or different."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from abbe.service.papers.printed import Printed

Fit = Literal["equal", "rounding", "padding", "bound", "no"]
"""Equal to the last printed digit; within the rounding of the inputs; the same if trailing zeros are padding; below a bound; different."""

FLOAT = 1e-12
"""Relative tolerance for binary arithmetic in a decimal comparison."""
OPERANDS = "rounding of the printed operands"


@dataclass(frozen=True, slots=True)
class Computed:
    """A computed number with the uncertainty of its inputs.

    Attributes
    ----------
    allowance : float
        Largest error from its inputs or its method (rounded operands, neglected second order), zero if they are exact.
    because : str
        Sources of the allowance.
    allowance_if_padded, padding : float and str
        Allowance if trailing zeros of an input are padding, and the reason; not less than ``allowance``, equal without such inputs.
    """

    value: float
    allowance: float = 0.0
    because: str = ""
    allowance_if_padded: float = 0.0
    padding: str = ""


def fit(computed: Computed, number: Printed) -> Fit:
    """Agreement of a computed number with the printed one.

    A bound limits the size of the number; it is rounded itself, so the size may exceed it by half a unit of its last digit.
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


def agrees(computed: Computed, number: Printed) -> bool:
    """Whether a computed number equals the printed one, to the digit or within the rounding of its inputs, without any assumption."""
    return fit(computed, number) not in ("padding", "no")


def within_if_padded(computed: Computed, number: Printed) -> float:
    """Largest allowed difference if trailing zeros of printed numbers are padding."""
    return number.rounding_if_padded + max(computed.allowance, computed.allowance_if_padded)


def computed_from(function: Callable[..., float], *inputs: Printed, because: str = OPERANDS) -> Computed:
    """Value of a function of printed numbers, with the effect of their rounding as allowance.

    The allowance is the first-order worst case: the sum over the inputs of the larger change for a shift by half a unit of the last digit.
    """
    at = [p.value for p in inputs]
    value = function(*at)

    def moved(i: int, half: float) -> float:
        return max(abs(function(*at[:i], at[i] + side * half, *at[i + 1 :]) - value) for side in (-1.0, 1.0))

    each = [moved(i, p.rounding) for i, p in enumerate(inputs)]
    padded = [moved(i, p.rounding_if_padded) if p.padding else change for i, (p, change) in enumerate(zip(inputs, each, strict=True))]
    reasons = dict.fromkeys(p.padding for p in inputs if p.padding)
    return Computed(float(value), float(sum(each)), because, float(sum(padded)), "; ".join(reasons))
