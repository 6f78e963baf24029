"""A printed number, whose digits define its rounding."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal


@dataclass(frozen=True, slots=True)
class Printed:
    """One printed number, exactly as printed.

    Parameters
    ----------
    text : str
        Digits as printed, e.g. ``"-8.5619E-05"``; trailing zeros count.
    bound : bool
        The paper prints an upper bound, not the number.
    last : str, optional
        Unit of the last digit if the text does not show it: ``"0.1"`` for a ``"0"`` in a column of tenths.
    digits, padding : int and str, optional
        Number of significant digits if the zeros after them are padding, and the reason. An assumption, which never makes a number
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
            raise ValueError(f"{self.text!r} is no finite number")
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


def _half(exponent: int) -> float:
    return float(Decimal(5).scaleb(exponent - 1))


def printed(*texts: str) -> tuple[Printed, ...]:
    """Several printed numbers, e.g. a row of a table."""
    return tuple(Printed(t) for t in texts)


def values(numbers: tuple[Printed, ...]) -> list[float]:
    """Values of printed numbers."""
    return [n.value for n in numbers]
