"""The four body diagonals before and after, on one ordinate (ISO 230-6)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.model import Floats
from abbe.service.rendering.numbers import plain
from abbe.service.rendering.svg import Svg

WIDTH, CELL_HEIGHT = 1010.0, 150.0
LEFT, GAP, TOP, BOTTOM = 68.0, 46.0, 44.0, 48.0
COLUMNS = 2

Curves = Mapping[str, tuple[Floats, Floats]]


def diagonal_plot(before: Curves, after: Curves, *, key: str = "diagonals") -> str:
    """Deviation along each diagonal before and after the correction.

    Curves: position in mm and deviation in µm by name of the diagonal, e.g. ``ppp``; one curve may run out and back.
    """
    names = list(dict.fromkeys([*before, *after]))
    rows = max(1, math.ceil(len(names) / COLUMNS))
    height = TOP + rows * CELL_HEIGHT + (rows - 1) * GAP + BOTTOM
    summary = "; ".join(f"{n}: range {_spread(before, n)} before, {_spread(after, n)} after" for n in names)
    svg = Svg(WIDTH, height, key, "Body diagonals", f"Deviation along the body diagonals. {summary}.")
    svg.legend((LEFT, 18.0), [("s-c1 dash", "before correction"), ("s-c2", "after correction")])
    everything = [float(v) for curves in (before, after) for _, y in curves.values() for v in y]
    y_range = data_range(everything, zero=True)
    width = (WIDTH - LEFT - 10.0 - (COLUMNS - 1) * 24.0) / COLUMNS
    for i, name in enumerate(names):
        row, column = divmod(i, COLUMNS)
        curves = [(c[name], style) for c, style in ((before, "s-c1 dash"), (after, "s-c2")) if name in c]
        x_range = data_range((float(v) for (x, _), _ in curves for v in x), margin=0.02)
        panel = Panel(LEFT + column * (width + 24.0), TOP + row * (CELL_HEIGHT + GAP), width, CELL_HEIGHT, x_range, y_range)
        panel.draw_y(svg, "deviation in µm" if column == 0 else "", count=5, numbers=column == 0)
        panel.draw_x(svg, "along the diagonal in mm" if row == rows - 1 else "")
        for (x, y), style in curves:
            svg.polyline(_pixels(panel, x, y), style)
        panel.draw_frame(svg)
        svg.text((panel.left, panel.top - 7.0), name, "t-head")
        figures = f"range {_spread(before, name)} → {_spread(after, name)}"
        svg.text((panel.left + panel.width, panel.top - 7.0), figures, "t-small", anchor="end")
    return svg.render()


def _pixels(panel: Panel, x: Floats, y: Floats) -> Sequence[tuple[float, float]]:
    return [panel.at(float(a), float(b)) for a, b in zip(x, y, strict=False)]


def _spread(curves: Curves, name: str) -> str:
    if name not in curves:
        return "n/a"
    values = np.asarray(curves[name][1], dtype=np.float64)
    values = values[np.isfinite(values)]
    return f"{plain(float(np.ptp(values)))} µm" if values.size else "n/a"
