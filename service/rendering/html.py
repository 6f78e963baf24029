"""From the values of a report to its page: formats numbers, draws plots, fills the template."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering import plots
from abbe.service.rendering.model import SETUP_NOTE, DemoReport, ParameterRow, RunRow, SummaryRow
from abbe.service.rendering.numbers import COVERAGE, NOT_AVAILABLE, finite, plain, printable, tidy, with_uncertainty
from abbe.service.rendering.palette import style_rules
from abbe.service.rendering.plots.residuals import common_range

_VERDICTS = {True: ("ok", "✔", "Accepted"), False: ("bad", "✖", "Not accepted"), None: ("open", "◐", "Undecided")}
_MARKS = re.compile(r"^[\s✔✖◐✓✗]+")


def render_report(report: DemoReport) -> str:
    """Self-contained HTML page of one measure-correct-verify cycle.

    Parameters
    ----------
    report : DemoReport
        What to say. Missing numbers (None, NaN) are shown as ``n/a``; texts may hold anything.

    Returns
    -------
    str
        The page. Equal reports give equal bytes.
    """
    sign, mark, word = _VERDICTS[report.accepted]
    page = (
        _environment()
        .get_template("report.html")
        .render(
            report=report,
            style=Markup(style_rules()),  # noqa: S704 - our own constants
            verdict={"sign": sign, "mark": mark, "word": word, "text": _MARKS.sub("", report.verdict)},
            coverage=tidy(COVERAGE),
            lsb=tidy(report.table_lsb_um),
            machine={key: _words(value) for key, value in report.machine.items()},
            summary=[_summary(row) for row in report.summary],
            parameters=[_parameter(row) for row in report.parameters if row.note != SETUP_NOTE],
            setup=[_parameter(row) for row in report.parameters if row.note == SETUP_NOTE],
            runs=[_run(row) for row in report.runs],
            pictures=_pictures(report),
        )
    )
    return printable(page)


@cache
def _environment() -> Environment:
    return Environment(
        loader=PackageLoader("abbe.service.rendering"), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )


def _pictures(report: DemoReport) -> dict[str, list[Markup]]:
    """Every plot for which there are data, by section."""
    noise = {row.label: row.noise_um for row in report.runs}
    loudest = max((v for v in noise.values() if finite(v)), default=None)
    y_range = common_range(report.residuals, loudest)
    residuals = (
        plots.residual_plot(s, noise_um=noise.get(s.label), y_range=y_range, key=f"residual-{i}") for i, s in enumerate(report.residuals)
    )
    diagonals = report.diagonals_before or report.diagonals_after
    return {
        "volume": _trusted(plots.volume_pair(report.arrows_before, report.arrows_after)),
        "diagonals": _trusted([plots.diagonal_plot(report.diagonals_before, report.diagonals_after)] if diagonals else []),
        "ranking": _trusted([plots.contribution_bars(report.contributions)] if report.contributions else []),
        "polar": _trusted([plots.polar_plot(report.polar)] if report.polar else []),
        "parameters": _trusted(plots.uncertainty_bars([p for p in report.parameters if p.note != SETUP_NOTE])),
        "setup": _trusted(plots.uncertainty_bars([p for p in report.parameters if p.note == SETUP_NOTE], key="setup")),
        "tables": _trusted([plots.table_plot(report.tables, lsb_um=report.table_lsb_um)] if report.tables else []),
        "residuals": _trusted(residuals),
    }


def _trusted(pictures: Iterable[str]) -> list[Markup]:
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    return [Markup(p) for p in pictures]  # noqa: S704


def _summary(row: SummaryRow) -> dict[str, str]:
    before, u_before = with_uncertainty(row.before, row.u_before)
    after, u_after = with_uncertainty(row.after, row.u_after)
    factor = row.factor if row.factor is not None else _factor(row.before, row.after)
    return {
        "name": row.name,
        "unit": row.unit,
        "before": before,
        "u_before": u_before,
        "after": after,
        "u_after": u_after,
        "factor": f"{plain(factor, 2)} ×" if finite(factor) else NOT_AVAILABLE,
        "source": row.source,
    }


def _factor(before: float | None, after: float | None) -> float | None:
    return before / after if finite(before) and finite(after) and after != 0.0 else None


def _parameter(row: ParameterRow) -> dict[str, str]:
    value, expanded = with_uncertainty(row.value, row.u)
    return {"name": row.name, "value": value, "u": expanded, "unit": row.unit, "note": row.note}


def _run(row: RunRow) -> dict[str, str]:
    return {
        "label": row.label,
        "test": row.test,
        "role": row.role,
        "points": str(row.points),
        "residual": plain(row.residual_rms_um),
        "noise": plain(row.noise_um),
        "outliers": str(row.outliers),
    }


def _words(value: object) -> str:
    """Value of the machine description in words: ``{"X": [0, 600]}`` becomes ``X 0 … 600``."""
    if isinstance(value, Mapping):
        return ", ".join(f"{key} {_words(item)}" for key, item in value.items())
    if isinstance(value, list | tuple):
        return (" … " if len(value) == 2 else ", ").join(_words(item) for item in value)
    if isinstance(value, float):
        return tidy(value)
    return str(value)
