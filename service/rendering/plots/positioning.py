"""A bidirectional positioning test as ISO 230-2 draws it: mean deviations of both directions with bars of two standard deviations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.svg import Svg

WIDTH, HEIGHT = 700.0, 300.0
Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class PositioningCurves:
    """Position in mm; mean deviations and standard deviations of both directions in µm (None: no repeats), shape (m,)."""

    label: str
    x_label: str
    position_mm: Array
    forward_um: Array
    backward_um: Array
    s_forward_um: Array | None = None
    s_backward_um: Array | None = None


def positioning_plot(curves: PositioningCurves, *, key: str, figures: str = "") -> str:
    """Means of both directions against the position, with bars of ± two standard deviations. ``figures``: text for the heading."""
    sides = (
        (curves.forward_um, curves.s_forward_um, "c2", "moving in +"),
        (curves.backward_um, curves.s_backward_um, "c1", "moving in −"),
    )
    ends = [v for y, s, _, _ in sides for v in (y if s is None else np.concatenate([y - 2.0 * s, y + 2.0 * s])).tolist()]
    svg = Svg(WIDTH, HEIGHT, key, f"Positioning {curves.label}", f"Mean deviation of both directions against {curves.x_label}. {figures}")
    svg.text((66.0, 16.0), curves.label, "t-head")
    svg.text((WIDTH - 10.0, 16.0), figures, "t-small", anchor="end")
    x_range = data_range(curves.position_mm.tolist(), margin=0.04)
    panel = Panel(66.0, 26.0, WIDTH - 76.0, HEIGHT - 96.0, x_range, data_range(ends, zero=True))
    panel.draw_y(svg, "deviation in µm")
    panel.draw_x(svg, curves.x_label)
    for k, (y, s, role, _) in enumerate(sides):
        points = [panel.at(float(a), float(b)) for a, b in zip(curves.position_mm, y, strict=True)]
        svg.polyline(points, f"s-{role}" + (" dash" if k else ""))
        for at, half in zip(points, np.zeros(y.size) if s is None else 2.0 * s, strict=True):
            svg.dot(at, 2.2, f"f-{role}")
            if half > 0.0:
                # Shift the two directions so that neither hides the other.
                svg.error_bar((at[0] + (3.0 if k else -3.0), at[1]), float(panel.y(0.0) - panel.y(float(half))), cap=2.5)
    panel.draw_frame(svg)
    svg.legend((66.0, HEIGHT - 8.0), [(f"s-{role}" + (" dash" if k else ""), name) for k, (_, _, role, name) in enumerate(sides)])
    return svg.render()
