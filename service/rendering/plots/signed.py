"""Colours for signed values: eight bands with edges at -4 .. +4 steps, blue below zero, orange above.

Roles ``d1`` (far below zero) to ``d8`` (far above) have their colours in `abbe.service.rendering.palette`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import round_up, tick_text
from abbe.service.rendering.palette import BANDS
from abbe.service.rendering.svg import XY, Svg

HALF = BANDS // 2


@dataclass(frozen=True, slots=True)
class SignedScale:
    """Bands of one width, ``step``, on both sides of zero."""

    step: float

    @classmethod
    def around(cls, *fields: NDArray[np.float64]) -> SignedScale:
        """Scale with the smallest step of the form 1, 2, 5 that covers all finite values of all fields."""
        sizes = [float(np.nanmax(np.abs(f))) for f in fields if np.isfinite(f).any()]
        largest = max(sizes, default=0.0)
        return cls(round_up(largest / HALF) if largest > 0.0 else 1.0)

    def style(self, value: float) -> str:
        """Role of a finite value."""
        band = int(np.clip(np.floor(value / self.step), -HALF, HALF - 1))
        return f"f-d{band + HALF + 1}"

    def levels(self) -> list[float]:
        """Edges between the bands, including zero."""
        return [k * self.step for k in range(-HALF + 1, HALF)]

    def draw_bar(self, svg: Svg, at: XY, unit: str, cell: float = 40.0) -> None:
        """The bands with the numbers of their edges; ``at`` is the upper left corner."""
        x, y = at
        for band in range(BANDS):
            svg.rect((x + band * cell, y), (cell, 9.0), f"f-d{band + 1}")
        for edge in range(BANDS + 1):
            label = tick_text((edge - HALF) * self.step, self.step)
            svg.text((x + edge * cell, y + 23.0), label + (f" {unit}" if edge == BANDS else ""), "t-small", anchor="middle")


def extremes(values: Iterable[float]) -> tuple[float, float]:
    """Smallest and largest finite value; both zero when there is none."""
    array = np.asarray(list(values), dtype=np.float64)
    good = array[np.isfinite(array)]
    return (float(good.min()), float(good.max())) if good.size else (0.0, 0.0)
