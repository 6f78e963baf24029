"""Observability: share of each error motion that comes from the readings, and gain of the reading noise over the volume."""

from __future__ import annotations

from collections.abc import Sequence

from abbe.service.rendering.axes import Panel
from abbe.service.rendering.model import MotionShare, Slice
from abbe.service.rendering.numbers import plain
from abbe.service.rendering.plots.contours import contour_plot
from abbe.service.rendering.plots.facets import Surface
from abbe.service.rendering.plots.signed import SignedScale
from abbe.service.rendering.svg import Svg

WIDTH, ROW, TOP, BOTTOM = 500.0, 20.0, 54.0, 50.0
LABELS, WORDS = 64.0, 118.0
STYLES = {"observed": "f-c1", "weak": "f-c3"}


def share_plot(rows: Sequence[MotionShare], *, key: str = "shares", heading: str = "What the readings tell of each error motion") -> str:
    """Share of information from readings per error motion, with its status, in the given order; the bar is empty if not observable."""
    kept = [r.name for r in rows if r.status == "observed"]
    summary = f"{len(kept)} of {len(rows)} may stand in a table of their own: {', '.join(kept) or 'none'}"
    svg = Svg(WIDTH, TOP + ROW * max(len(rows), 1) + BOTTOM, key, heading, f"{heading}: {summary}.")
    svg.text((10.0, 18.0), heading, "t-head")
    svg.text((10.0, 38.0), f"{len(kept)} of {len(rows)} may stand in a table of their own", "t-soft")
    panel = Panel(LABELS, TOP, WIDTH - LABELS - WORDS, ROW * max(len(rows), 1), (0.0, 100.0), (0.0, 1.0))
    panel.draw_x(svg, "share of what is known, from readings, in %", count=5)
    for i, row in enumerate(rows):
        y = TOP + ROW * (i + 0.5)
        svg.text((LABELS - 8.0, y + 4.0), row.name, anchor="end")
        svg.text((WIDTH - WORDS + 10.0, y + 4.0), row.status, "t-soft")
        end, percent = panel.x(100.0 * row.share), plain(100.0 * row.share)
        tip = f"{row.name}: {percent} % from readings, {row.status}"
        svg.rect((LABELS, y - 6.0), (end - LABELS, 12.0), STYLES.get(row.status, "frame"), tip)
    panel.draw_frame(svg)
    return svg.render()


def gain_map(found: Slice, *, key: str, heading: str = "Noise gain") -> str:
    """Micrometres of predicted deviation per micrometre of reading noise over one plane of the volume, with level lines.

    ``found.values`` has no unit; more than ten nodes per side look smooth.
    """
    labels = (f"{found.x_axis} in mm", f"{found.y_axis} in mm")
    surface = Surface(found.x_mm, found.y_mm, found.values, *labels, "µm per µm")
    return contour_plot(surface, SignedScale.around(found.values), key=key, heading=f"{heading}, {found.at}")
