"""Whether a computed number is the printed one: by its digits, within its inputs' rounding, under an assumption, or not."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from abbe.service.papers.printed import Printed

Fit = Literal["equal", "rounding", "padding", "bound", "no"]
"""Equal to the last printed digit; within the rounding of the inputs; that only if zeros at the end are padding; below a bound; not."""

FLOAT = 1e-12
"""Of the larger number: what binary arithmetic may add to a decimal comparison."""
OPERANDS = "rounding of the printed operands"


@dataclass(frozen=True, slots=True)
class Computed:
    """A computed number with what its inputs leave open.

    Attributes
    ----------
    value : float
    allowance : float
        How far it may be off because of its inputs or its method (rounded operands, neglected second order), zero if they are exact.
    because : str
        What the allowance consists of, in a few words.
    allowance_if_padded, padding : float and str
        Allowance if zeros at the end of an input are padding, and why they may be; not less than ``allowance``, equal without such inputs.
    """

    value: float
    allowance: float = 0.0
    because: str = ""
    allowance_if_padded: float = 0.0
    padding: str = ""


def fit(computed: Computed, number: Printed) -> Fit:
    """How a computed number agrees with the printed one.

    A bound speaks of a size; a rounded number itself, it holds when the size does not exceed it by more than half a unit of its last digit.
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
    """Whether a computed number is what was printed, to the digit or within the rounding of its inputs, without any assumption."""
    return fit(computed, number) not in ("padding", "no")


def within_if_padded(computed: Computed, number: Printed) -> float:
    """How far the two may be apart if zeros at the end of printed numbers are padding."""
    return number.rounding_if_padded + max(computed.allowance, computed.allowance_if_padded)


def computed_from(function: Callable[..., float], *inputs: Printed, because: str = OPERANDS) -> Computed:
    """A function of printed numbers, with how far their rounding can move it.

    The allowance is the sum over the inputs of the larger change when one of them moves by half a unit of its last digit: the worst case of
    the first order.
    """
    at = [p.value for p in inputs]
    value = function(*at)

    def moved(i: int, half: float) -> float:
        return max(abs(function(*at[:i], at[i] + side * half, *at[i + 1 :]) - value) for side in (-1.0, 1.0))

    each = [moved(i, p.rounding) for i, p in enumerate(inputs)]
    padded = [moved(i, p.rounding_if_padded) if p.padding else change for i, (p, change) in enumerate(zip(inputs, each, strict=True))]
    reasons = dict.fromkeys(p.padding for p in inputs if p.padding)
    return Computed(float(value), float(sum(each)), because, float(sum(padded)), "; ".join(reasons))
