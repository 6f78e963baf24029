"""Colours for values of either sign: eight bands with edges at -4 .. +4 steps, blue below zero, orange above.

Roles ``d1`` (far below zero) to ``d8`` (far above) get their colour from `signed_rules`, which a page with such pictures adds to its style.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import round_up, tick_text
from abbe.service.rendering.svg import XY, Svg

BANDS = 8
HALF = BANDS // 2
_LIGHT = ("#123a6e", "#2d6cab", "#6ba2cf", "#b9d5ea", "#f7d3ae", "#eba25a", "#c96a1b", "#833a00")
_DARK = ("#a9d6ff", "#66aee6", "#3a7bb0", "#254c6b", "#5e4227", "#a06430", "#dd9145", "#ffcf96")


def signed_rules() -> str:
    """CSS of the roles ``f-d1`` .. ``f-d8``: light by default and in print, dark where the reader's system asks for it."""

    def colours(values: tuple[str, ...]) -> str:
        return "".join(f"--d{i}:{v};" for i, v in enumerate(values, 1))

    rules = "\n".join(
        f"svg .f-d{i}{{fill:var(--d{i});stroke:none}}\nsvg .facet.f-d{i}{{stroke:var(--page);stroke-width:.35;stroke-linejoin:round}}"
        for i in range(1, BANDS + 1)
    )
    dark = f"@media screen and (prefers-color-scheme:dark){{:root{{{colours(_DARK)}}}}}"
    lines = "svg .level{fill:none;stroke:var(--ink);stroke-width:.8}\nsvg .level-zero{fill:none;stroke:var(--ink);stroke-width:1.8}"
    return f":root{{{colours(_LIGHT)}}}\n{dark}\n{rules}\n{lines}\n"


@dataclass(frozen=True, slots=True)
class SignedScale:
    """Bands of one width, ``step``, on both sides of zero."""

    step: float

    @classmethod
    def around(cls, *fields: NDArray[np.float64]) -> SignedScale:
        """Smallest step of the form 1, 2, 5 with which the bands hold all finite values of all fields."""
        sizes = [float(np.nanmax(np.abs(f))) for f in fields if np.isfinite(f).any()]
        largest = max(sizes, default=0.0)
        return cls(round_up(largest / HALF) if largest > 0.0 else 1.0)

    def style(self, value: float) -> str:
        """Role of a finite value."""
        band = int(np.clip(np.floor(value / self.step), -HALF, HALF - 1))
        return f"f-d{band + HALF + 1}"

    def levels(self) -> list[float]:
        """Edges between the bands, zero among them."""
        return [k * self.step for k in range(-HALF + 1, HALF)]

    def draw_bar(self, svg: Svg, at: XY, unit: str, cell: float = 40.0) -> None:
        """The bands with the numbers of their edges; ``at`` is the upper left corner."""
        x, y = at
        for band in range(BANDS):
            svg.rect((x + band * cell, y), (cell, 9.0), f"f-d{band + 1}")
        for edge in range(BANDS + 1):
            words = tick_text((edge - HALF) * self.step, self.step)
            svg.text((x + edge * cell, y + 23.0), words + (f" {unit}" if edge == BANDS else ""), "t-small", anchor="middle")


def extremes(values: Iterable[float]) -> tuple[float, float]:
    """Smallest and largest finite value; both zero when there is none."""
    array = np.asarray(list(values), dtype=np.float64)
    good = array[np.isfinite(array)]
    return (float(good.min()), float(good.max())) if good.size else (0.0, 0.0)
