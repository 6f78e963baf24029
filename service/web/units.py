"""Lengths in the reader's units: µm, mm and mm/min, or µin, in and in/min. For the screens only: stored data, JSON, CSV, reports and
addresses stay in SI, so a link means the same to every reader.

`shown` formats a number or an already rounded text, `rounded` a number with its uncertainty; `drawn_in` is the unit of a picture. Scripts
read symbol and size of the unit from their page. Not converted: pictures of reports (run, discovery, proposal), with axes in µm and mm,
and stored sentences (verdicts, advice, refusals, messages of a running job), which name their unit. Ratios such as µm/m have the same value
in µin/in and stay as they are; so do angles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from abbe.service.rendering.numbers import Unit, with_uncertainty
from abbe.service.web.formatting import number

METRIC, INCH = "mm", "inch"
SYSTEMS = (METRIC, INCH)


@dataclass(frozen=True, slots=True)
class _InchUnit:
    """The inch counterpart of a unit. ``decimals``: additional decimals that keep the resolution of a number."""

    unit: Unit
    decimals: int


_INCHES: Mapping[str, _InchUnit] = {
    "µm": _InchUnit(Unit("µin", 0.0254), -1),
    "mm": _InchUnit(Unit("in", 25.4), 2),
    "mm/min": _InchUnit(Unit("in/min", 25.4), 2),
}


def drawn_in(unit: str, system: str) -> Unit:
    """The reader's unit with its symbol and its size in ``unit``. Units other than lengths stay as they are."""
    other = _INCHES.get(unit) if system == INCH else None
    return Unit(unit) if other is None else other.unit


def unit_in(unit: str, system: str) -> str:
    """Symbol of the reader's unit."""
    return drawn_in(unit, system).sign


def converted(value: float, unit: str, system: str) -> float:
    """A value converted from ``unit`` to the reader's unit."""
    return value / drawn_in(unit, system).size


def rounded(value: float | None, u: float | None, unit: str, system: str) -> tuple[str, str]:
    """A value and U = 2 u in the reader's unit, rounded together to two significant digits of U; None becomes ``n/a``."""
    size = drawn_in(unit, system).size
    return with_uncertainty(None if value is None else value / size, None if u is None else u / size)


def shown(value: float | str | None, unit: str, system: str, decimals: int | None = None) -> str:
    """A number as text in the reader's unit, without the symbol of the unit.

    Parameters
    ----------
    value : float, str or None
        A number is rounded to ``decimals``, or as `number` does. A text that holds a rounded number keeps its resolution; any other text is
        unchanged. None becomes a dash.
    unit : str
        Unit of ``value``: ``"µm"``, ``"mm"``, ``"mm/min"``; others are not converted.
    system : str
        `METRIC` or `INCH`.
    decimals : int, optional
        Decimals in ``unit``; a value in inches gets as many as keep that resolution.
    """
    other = _INCHES.get(unit) if system == INCH else None
    if isinstance(value, str):
        return value if other is None else _converted_text(value, other)
    if value is None or decimals is None:
        return number(None if value is None else converted(value, unit, system))
    return f"{converted(value, unit, system):.{max(0, decimals + (0 if other is None else other.decimals))}f}"


def _converted_text(text: str, other: _InchUnit) -> str:
    """Convert a text that holds a rounded metric number to the inch unit, with the same resolution; any other text is unchanged."""
    try:
        number_read = float(text.replace("\u2212", "-"))
    except ValueError:
        return text
    decimals = max(0, len(text.partition(".")[2]) + other.decimals)
    sign = "+" if text.startswith("+") else ""
    return f"{number_read / other.unit.size:{sign}.{decimals}f}"
