"""Reports: plain values in, one self-contained HTML page out. No script, no file beside it, no request to anywhere."""

from abbe.service.report.html import render_report
from abbe.service.report.model import (
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
