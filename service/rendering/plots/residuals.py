"""Residual of one run, compared with the noise of the instrument."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.model import ResidualSeries
from abbe.service.rendering.numbers import COVERAGE, finite, plain
from abbe.service.rendering.svg import Svg

WIDTH, HEIGHT = 500.0, 215.0
MAX_POINTS = 900
"""Longer runs are drawn as an envelope of the lowest and highest residual per bin, so that no spike is lost."""


def residual_plot(series: ResidualSeries, *, noise_um: float | None, y_range: tuple[float, float] | None = None, key: str) -> str:
    """Residual against time or position along the path.

    ``noise_um``: standard deviation of the reading, drawn as a band of ± 2 standard deviations. ``y_range``: common range of several runs.
    """
    x, y = _paired(series)
    good = y[np.isfinite(y)]
    rms = float(np.sqrt(np.mean(good**2))) if good.size else math.nan
    figures = f"rms {plain(rms)} µm" + (f", noise {plain(noise_um)} µm" if finite(noise_um) else "")
    svg = Svg(
        WIDTH, HEIGHT, key, f"Residual of run {series.label}", f"Residual in µm against {series.x_label}: {figures}, {good.size} points."
    )
    svg.text((62.0, 16.0), series.label, "t-head")
    svg.text((WIDTH - 10.0, 16.0), figures, "t-small", anchor="end")
    panel = Panel(62.0, 26.0, WIDTH - 72.0, HEIGHT - 72.0, data_range(x.tolist(), margin=0.0), y_range or common_range([series], noise_um))
    band = [max(min(s * COVERAGE * noise_um, panel.y_range[1]), panel.y_range[0]) for s in (1.0, -1.0)] if finite(noise_um) else []
    if band:
        svg.rect((panel.left, panel.y(band[0])), (panel.width, panel.y(band[1]) - panel.y(band[0])), "band")
    panel.draw_y(svg, "residual in µm", count=4)
    panel.draw_x(svg, series.x_label)
    if good.size > MAX_POINTS:
        _draw_envelope(svg, panel, x, y)
    else:
        for xi, yi in zip(x.tolist(), y.tolist(), strict=True):
            svg.dot(panel.at(xi, yi), 1.5, "f-c2")
    for edge in band:  # drawn again above dense data
        svg.line((panel.left, panel.y(edge)), (panel.left + panel.width, panel.y(edge)), "band-edge")
    panel.draw_frame(svg)
    return svg.render()


def common_range(series: Sequence[ResidualSeries], noise_um: float | None = None) -> tuple[float, float]:
    """Range of the ordinate, symmetric about zero, that holds all runs and the noise band."""
    largest = 1.3 * COVERAGE * noise_um if finite(noise_um) else 0.0
    for one in series:
        y = np.asarray(one.residual_um, dtype=np.float64)
        y = y[np.isfinite(y)]
        largest = max(largest, float(np.abs(y).max()) if y.size else 0.0)
    return (-1.06 * largest, 1.06 * largest) if largest > 0.0 else (-1.0, 1.0)


def _paired(series: ResidualSeries) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    x, y = (np.asarray(v, dtype=np.float64).ravel() for v in (series.x, series.residual_um))
    n = min(x.size, y.size)
    return x[:n], y[:n]


def _draw_envelope(svg: Svg, panel: Panel, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    keep = np.isfinite(x) & np.isfinite(y)
    x, y = x[keep], y[keep]
    bins = int(panel.width)
    place = np.clip(((x - panel.x_range[0]) / (panel.x_range[1] - panel.x_range[0]) * bins).astype(np.int64), 0, bins - 1)
    low, high = np.full(bins, np.inf), np.full(bins, -np.inf)
    np.minimum.at(low, place, y)
    np.maximum.at(high, place, y)
    for i in np.flatnonzero(np.isfinite(low)):
        px = panel.left + float(i) + 0.5
        svg.line((px, panel.y(float(low[i])) + 0.5), (px, panel.y(float(high[i])) - 0.5), "s-c2 thin")
