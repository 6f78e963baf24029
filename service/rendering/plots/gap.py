"""The gap, measured minus simulated: of every run, along one run, and over the volume; before and after effects are added to the model."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from abbe.service.domain.finding import RunResidual
from abbe.service.rendering.axes import Panel, bar_panel, data_range
from abbe.service.rendering.model import PlaceMap, ResidualTrace
from abbe.service.rendering.numbers import COVERAGE, plain
from abbe.service.rendering.svg import Svg

WIDE, HALF = 1010.0, 500.0
ROW, TOP, BOTTOM, LABELS = 20.0, 52.0, 46.0, 190.0
TRACE_HEIGHT = 400.0
MAX_POINTS = 1500
STEPS = (1.5, 2.5, 4.0, 7.0)
"""Limits between the five colours of a cell: rms of the gap divided by the noise."""


def gap_bars(runs: Mapping[str, RunResidual], *, key: str = "gap") -> str:
    """One row per run: gap before (upper bar) and after (lower bar), and the noise floor as a tick. Sealed runs are left out."""
    rows = [
        (label, r, r.rms_before_um, r.rms_after_um)
        for label, r in runs.items()
        if r.rms_before_um is not None and r.rms_after_um is not None
    ]
    summary = "; ".join(f"{label} {plain(before)} to {plain(after)} µm, noise {plain(r.floor_um)} µm" for label, r, before, after in rows)
    svg = Svg(WIDE, TOP + ROW * max(len(rows), 1) + BOTTOM, key, "Gap of every run before and after", summary or "no run was judged")
    svg.text((10.0, 18.0), "rms of measured minus simulated, every run", "t-head")
    svg.legend((LABELS, 38.0), [("s-c1", "before"), ("s-c2", "after"), ("band-edge", "noise floor")])
    values = [v for _, r, before, after in rows for v in (before, after, r.floor_um)]
    panel = bar_panel(LABELS, TOP, (WIDE - LABELS - 16.0, ROW * max(len(rows), 1)), values)
    panel.draw_x(svg, "rms in µm")
    for i, (label, row, before, after) in enumerate(rows):
        y = TOP + ROW * i
        svg.text((LABELS - 8.0, y + 14.0), f"{label} {row.role}"[:30], "" if row.role == "identify" else "t-soft", anchor="end")
        tip = f"{label}, {row.test}, {row.role}: {plain(before)} → {plain(after)} µm, noise {plain(row.floor_um)} µm"
        panel.draw_bar(svg, before, y + 5.5, 7.0, "f-c1", tip)
        panel.draw_bar(svg, after, y + 13.5, 7.0, "f-c2", tip)
        at = panel.x(row.floor_um)
        svg.line((at, y), (at, y + ROW - 1.0), "band-edge")
    panel.draw_frame(svg)
    return svg.render()


def trace_plot(trace: ResidualTrace, *, key: str) -> str:
    """Two panels with one scale: measured minus simulated before, and after. Band: two standard deviations of the noise."""
    size = np.abs(np.concatenate([trace.before_um, trace.after_um, [1.3 * COVERAGE * trace.noise_um]]))
    top = float(size[np.isfinite(size)].max()) * 1.06 or 1.0
    figures = f"rms {plain(_rms(trace.before_um))} µm before, {plain(_rms(trace.after_um))} µm after, noise {plain(trace.noise_um)} µm"
    svg = Svg(WIDE, TRACE_HEIGHT, key, f"Gap of run {trace.label} against {trace.x_label}", figures)
    svg.text((68.0, 18.0), f"{trace.label}{': ' + trace.why if trace.why else ''}", "t-head")
    svg.text((WIDE - 10.0, 18.0), figures, "t-small", anchor="end")
    height = (TRACE_HEIGHT - 30.0 - 30.0 - 46.0) / 2.0
    x_range = data_range(trace.x.tolist(), margin=0.01)
    for i, (word, y, style) in enumerate((("before", trace.before_um, "f-c1"), ("after", trace.after_um, "f-c2"))):
        panel = Panel(68.0, 30.0 + i * (height + 30.0), WIDE - 78.0, height, x_range, (-top, top))
        edge = COVERAGE * trace.noise_um
        svg.rect((panel.left, panel.y(edge)), (panel.width, panel.y(-edge) - panel.y(edge)), "band")
        panel.draw_y(svg, "µm", count=4)
        panel.draw_x(svg, trace.x_label if i else "", numbers=bool(i))
        for k in thinned(y):
            svg.dot(panel.at(float(trace.x[k]), float(y[k])), 1.4, style)
        svg.text((panel.left + 8.0, panel.top + 15.0), word, "t-halo")
        panel.draw_frame(svg)
    return svg.render()


def place_plot(place: PlaceMap, *, key: str) -> str:
    """Cells of one plane, coloured by their gap divided by the noise; a ring marks the located area."""
    heading = f"Where the gap is, {place.x_axis} and {place.y_axis}"
    worst = float(place.times_noise.max()) if place.times_noise.size else math.nan
    svg = Svg(HALF, 380.0, key, heading, f"rms of the gap over its noise, up to {plain(worst, 2)}")
    svg.text((10.0, 18.0), heading, "t-head")
    limits = ("1", *(plain(v, 2) for v in STEPS))
    svg.legend((10.0, 38.0), [(f"s-seq{i + 1}", f"> {limits[i]} × noise") for i in range(0, 5, 2)])
    panel = Panel(
        62.0,
        50.0,
        HALF - 76.0,
        380.0 - 50.0 - 46.0,
        data_range(place.x_mm.tolist(), margin=0.08),
        data_range(place.y_mm.tolist(), margin=0.08),
    )
    panel.draw_x(svg, f"{place.x_axis} in mm")
    panel.draw_y(svg, f"{place.y_axis} in mm")
    for x, y, times in zip(place.x_mm.tolist(), place.y_mm.tolist(), place.times_noise.tolist(), strict=True):
        level = 1 + sum(times > limit for limit in STEPS)
        svg.dot(panel.at(x, y), 2.0 + level, f"f-seq{level}", f"({plain(x)}, {plain(y)}) mm: {plain(times, 2)} × noise")
    if place.spot is not None:
        x, y, radius = place.spot
        svg.circle(panel.at(x, y), max(abs(panel.x(x + radius) - panel.x(x)), 9.0), "key")
    panel.draw_frame(svg)
    return svg.render()


def thinned(y: NDArray[np.float64]) -> Sequence[int]:
    """Indices of evenly spaced points and of the largest value per bin, so that no spike is lost."""
    if y.size <= MAX_POINTS:
        return range(y.size)
    edges = np.linspace(0, y.size, MAX_POINTS // 2 + 1).astype(int)
    keep = {int(a) for a in edges[:-1]} | {int(a + np.argmax(np.nan_to_num(np.abs(y[a:b])))) for a, b in pairwise(edges)}
    return sorted(keep)


def _rms(y: NDArray[np.float64]) -> float:
    good = y[np.isfinite(y)]
    return float(np.sqrt(np.mean(good**2))) if good.size else math.nan
