"""Formatted numbers: the uncertainty decides the number of digits."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import TypeGuard

NOT_AVAILABLE = "n/a"
COVERAGE = 2.0
"""Coverage factor k of every expanded uncertainty in a report."""


@dataclass(frozen=True, slots=True)
class Unit:
    """Display unit of a length: its symbol, and its size in internal units (µm for errors, mm for positions)."""

    sign: str
    size: float = 1.0


UM, MM = Unit("µm"), Unit("mm")

# XML 1.0 cannot hold these characters, not even escaped.
_UNPRINTABLE = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff\ufffe\uffff]")


def finite(value: float | None) -> TypeGuard[float]:
    """Whether the value is a finite number."""
    return value is not None and math.isfinite(value)


def plain(value: float | None, digits: int = 3) -> str:
    """Value to ``digits`` significant digits, without exponent within 1e-6 .. 1e7; ``n/a`` without a value."""
    if not finite(value):
        return NOT_AVAILABLE
    if value == 0.0:
        return "0"
    if not 1e-6 <= abs(value) < 1e7:
        return _signed(f"{value:.{digits - 1}e}")
    return fixed(value, _decimals(value, digits))


def tidy(value: float | None) -> str:
    """A nominal value (stroke, scale, coverage factor) without trailing zeros: 600, not 600.0."""
    if not finite(value):
        return NOT_AVAILABLE
    text = plain(value, 6)
    return text.rstrip("0").rstrip(".") if "." in text and "e" not in text else text


def placed(value_mm: float, unit: Unit) -> str:
    """A commanded position to 0.001 mm or 0.0001 in (2.5 µm), as in the 3-D map, without trailing zeros."""
    if not finite(value_mm):
        return NOT_AVAILABLE
    text = fixed(value_mm / unit.size, 3 if unit.size == 1.0 else 4)
    return text.rstrip("0").rstrip(".")


def fixed(value: float, decimals: int) -> str:
    """Value with a fixed number of decimals; negative ``decimals`` round to tens, hundreds and so on."""
    if decimals < 0:
        return _signed(f"{round(value, decimals):.0f}")
    return _signed(f"{value:.{decimals}f}")


def with_uncertainty(value: float | None, u: float | None) -> tuple[str, str]:
    """Value and expanded uncertainty U = k u (k = 2) as text, rounded together to two significant digits of U.

    ``u``: standard uncertainty in the unit of the value. Without it U is ``n/a`` and the value keeps three significant digits.
    """
    if not finite(value):
        return NOT_AVAILABLE, NOT_AVAILABLE
    if not finite(u) or u <= 0.0:
        return plain(value), NOT_AVAILABLE
    expanded = COVERAGE * u
    decimals = max(_decimals(expanded, 2), -6)
    if decimals > 9:
        return plain(value), plain(expanded, 2)
    return fixed(value, decimals), fixed(expanded, decimals)


def printable(text: object) -> str:
    """Text without the control characters that XML and HTML cannot hold; not escaped."""
    return _UNPRINTABLE.sub("\ufffd", str(text))


def _decimals(value: float, digits: int) -> int:
    # Rounding first: 0.0996 to two digits is 0.10, not 0.100.
    rounded = float(f"{value:.{digits - 1}e}")
    return digits - 1 - math.floor(math.log10(abs(rounded)))


def _signed(text: str) -> str:
    body = text.lstrip("-")
    is_zero = not any(c in "123456789" for c in body.split("e")[0])
    return f"−{body}" if text.startswith("-") and not is_zero else body
