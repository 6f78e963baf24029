"""Reports: plain values in, one self-contained HTML page out. No script, no file beside it, no request to anywhere."""

from abbe.service.rendering.html import render_report
from abbe.service.rendering.model import (
    ArrowField,
    Contribution,
    DemoReport,
    ParameterRow,
    PolarTrace,
    ResidualSeries,
    RunRow,
    SummaryRow,
    TableCurve,
)

__all__ = [
    "ArrowField",
    "Contribution",
    "DemoReport",
    "ParameterRow",
    "PolarTrace",
    "ResidualSeries",
    "RunRow",
    "SummaryRow",
    "TableCurve",
    "render_report",
]
