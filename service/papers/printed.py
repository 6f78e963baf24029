"""A number as it stands in print: the digits say how far it was rounded."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal


@dataclass(frozen=True, slots=True)
class Printed:
    """One printed number, typed as it stands.

    Parameters
    ----------
    text : str
        Digits as printed, e.g. ``"-8.5619E-05"``; trailing zeros count.
    bound : bool
        The paper says "smaller than this", not "this".
    last : str, optional
        Unit of the last digit where the text alone does not show it: ``"0.1"`` for a ``"0"`` in a column of tenths.
    digits, padding : int and str, optional
        Significant digits that are real if the zeros after them are padding, and why they may be. An assumption: nothing is called
        reproduced on its strength.
    """

    text: str
    bound: bool = False
    last: str = ""
    digits: int | None = None
    padding: str = ""

    def __post_init__(self) -> None:
        """An assumption needs its reason."""
        if (self.digits is None) != (self.padding == ""):
            raise ValueError(f"{self.text}: digits and the reason why zeros are padding belong together")

    @property
    def value(self) -> float:
        """The number."""
        return float(self.text)

    @property
    def exponent(self) -> int:
        """Power of ten of the last printed digit."""
        exponent = Decimal(self.last or self.text).as_tuple().exponent
        if not isinstance(exponent, int):
            raise ValueError(f"{self.text!r} is no finite number")
        return exponent

    @property
    def rounding(self) -> float:
        """Half a unit of the last printed digit: how far the rounded number may be from what was rounded."""
        return _half(self.exponent)

    @property
    def rounding_if_padded(self) -> float:
        """The same of the last digit that is real, if the zeros after it are padding."""
        number = Decimal(self.text)
        return self.rounding if self.digits is None or number == 0 else _half(number.adjusted() - self.digits + 1)


def _half(exponent: int) -> float:
    return float(Decimal(5).scaleb(exponent - 1))


def printed(*texts: str) -> tuple[Printed, ...]:
    """Several printed numbers, e.g. a row of a table."""
    return tuple(Printed(t) for t in texts)


def values(numbers: tuple[Printed, ...]) -> list[float]:
    """Their values."""
    return [n.value for n in numbers]
