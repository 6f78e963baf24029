"""Plots of the report: each takes plain values and gives one ``<svg>`` element."""

from abbe.service.report.plots.bars import contribution_bars, uncertainty_bars
from abbe.service.report.plots.diagonals import diagonal_plot
from abbe.service.report.plots.polar import polar_plot
from abbe.service.report.plots.residuals import residual_plot
from abbe.service.report.plots.tables import table_plot
from abbe.service.report.plots.volume import volume_arrows, volume_pair

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
