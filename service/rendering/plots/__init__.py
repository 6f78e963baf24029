"""Plots of the report: each turns plain values into one ``<svg>`` element."""

from abbe.service.rendering.plots.bars import contribution_bars, uncertainty_bars
from abbe.service.rendering.plots.curves import diagonal_plot
from abbe.service.rendering.plots.polar import polar_plot
from abbe.service.rendering.plots.residuals import residual_plot
from abbe.service.rendering.plots.tables import table_plot
from abbe.service.rendering.plots.volume import volume_arrows, volume_pair

__all__ = [
    "contribution_bars",
    "diagonal_plot",
    "polar_plot",
    "residual_plot",
    "table_plot",
    "uncertainty_bars",
    "volume_arrows",
    "volume_pair",
]
