"""Lengths as the reader wants them: µm, mm and mm/min, or µin, in and in/min. For the screens only; what is stored, the JSON, the CSV and
the reports stay in SI, and so do addresses: a link means the same to every reader.

`shown` writes a number or one that was already rounded, `rounded` a number with its uncertainty, `drawn_in` tells a picture its unit;
scripts get sign and size of the unit with their page. Not converted: pictures of reports (run, discovery, proposal: their axes say µm and
mm) and sentences in words (verdicts, advice, refusals, messages of a running job), which name their unit. Ratios such as µm/m are the same
number in µin/in, and stay; so do angles.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from abbe.service.rendering.numbers import Unit, with_uncertainty
from abbe.service.web.words import number

METRIC, INCH = "mm", "inch"
SYSTEMS = (METRIC, INCH)


@dataclass(frozen=True, slots=True)
class _Other:
    """What a unit becomes. ``decimals``: more of them, so that a written number keeps its resolution."""

    unit: Unit
    decimals: int


_INCHES: Mapping[str, _Other] = {
    "µm": _Other(Unit("µin", 0.0254), -1),
    "mm": _Other(Unit("in", 25.4), 2),
    "mm/min": _Other(Unit("in/min", 25.4), 2),
}


def drawn_in(unit: str, system: str) -> Unit:
    """The reader's unit: its sign, and how many of ours it is. Units that are no length stay as they are."""
    other = _INCHES.get(unit) if system == INCH else None
    return Unit(unit) if other is None else other.unit


def unit_in(unit: str, system: str) -> str:
    """What stands behind a number of this unit."""
    return drawn_in(unit, system).sign


def converted(value: float, unit: str, system: str) -> float:
    """A number of a unit in the reader's unit."""
    return value / drawn_in(unit, system).size


def rounded(value: float | None, u: float | None, unit: str, system: str) -> tuple[str, str]:
    """A value and U = 2 u in the reader's unit, rounded together there: two significant digits of U.

    Parameters
    ----------
    value, u : float or None
        The value and its standard uncertainty, in ``unit``; what is missing is ``n/a``.
    unit, system : str
        As for `shown`.
    """
    size = drawn_in(unit, system).size
    return with_uncertainty(None if value is None else value / size, None if u is None else u / size)


def shown(value: float | str | None, unit: str, system: str, decimals: int | None = None) -> str:
    """A number for a screen, without its unit.

    Parameters
    ----------
    value : float, str or None
        A number gets as many digits as its size deserves. A text is one that was already rounded (with its uncertainty, say): it keeps its
        resolution, and is left alone if it is no number. None is a dash.
    unit : str
        What it is in: ``"µm"``, ``"mm"``, ``"mm/min"``, or anything else, which is not converted.
    system : str
        `METRIC` or `INCH`.
    decimals : int, optional
        So many for a number in ``unit``; in another unit as many as keep that resolution.
    """
    other = _INCHES.get(unit) if system == INCH else None
    if isinstance(value, str):
        return value if other is None else _again(value, other)
    if value is None or decimals is None:
        return number(None if value is None else converted(value, unit, system))
    return f"{converted(value, unit, system):.{max(0, decimals + (0 if other is None else other.decimals))}f}"


def _again(text: str, other: _Other) -> str:
    """A number that was rounded in our unit, in the other one."""
    try:
        read = float(text.replace("\u2212", "-"))
    except ValueError:
        return text
    decimals = max(0, len(text.partition(".")[2]) + other.decimals)
    sign = "+" if text.startswith("+") else ""
    return f"{read / other.unit.size:{sign}.{decimals}f}"
