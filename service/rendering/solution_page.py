"""From the values of a solution to its page: self-contained, no script, no request to anywhere."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from functools import cache

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from abbe.service.rendering.model import ParameterRow, RunRow
from abbe.service.rendering.numbers import COVERAGE, finite, plain, printable, tidy, with_uncertainty
from abbe.service.rendering.palette import style_rules
from abbe.service.rendering.plots.bands import motion_bands
from abbe.service.rendering.plots.bars import contribution_bars, uncertainty_bars
from abbe.service.rendering.plots.cells import common_step, correlation_plot, slice_plot
from abbe.service.rendering.plots.observability import gain_map, share_plot
from abbe.service.rendering.plots.residuals import common_range, residual_plot
from abbe.service.rendering.plots.signed import signed_rules
from abbe.service.rendering.solution_model import SolutionPage, TableLine

_MARKS = {"ok": "✔", "open": "◐", "bad": "✖"}


def render_solution(page: SolutionPage) -> str:
    """Self-contained HTML page of one solved campaign. Equal values give equal bytes.

    Parameters
    ----------
    page : SolutionPage
        What to say; texts may hold anything.
    """
    sign, word, text = page.verdict
    html = (
        _environment()
        .get_template("solution.html")
        .render(
            page=page,
            style=Markup(style_rules() + signed_rules()),  # noqa: S704 - our own constants
            verdict={"sign": sign, "mark": _MARKS[sign], "word": word, "text": text},
            coverage=tidy(COVERAGE),
            parameters=[_parameter(r) for r in page.parameters],
            setup=[_parameter(r) for r in page.setup],
            runs=[_run(r) for r in page.runs],
            budget=[{"words": b.words, "u": plain(b.u_um, 2), "share": f"{b.share:.0%}"} for b in page.budget],
            tables=[_table(t) for t in page.tables],
            pictures=_pictures(page),
        )
    )
    return printable(html)


@cache
def _environment() -> Environment:
    loader = PackageLoader("abbe.service.rendering")
    return Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)


def _pictures(page: SolutionPage) -> dict[str, list[Markup]]:
    units = list(dict.fromkeys(c.unit for c in page.motions))
    noise = {r.label: r.noise_um for r in page.runs}
    y_range = common_range(page.residuals, max((v for v in noise.values() if finite(v)), default=None))
    step = common_step(page.slices)
    slices = [slice_plot(s, step, key=f"slice-{i}", heading=f"U of the predicted vector, {s.at}") for i, s in enumerate(page.slices)]
    residuals = [residual_plot(s, noise_um=noise.get(s.label), y_range=y_range, key=f"residual-{i}") for i, s in enumerate(page.residuals)]
    return {
        "parameters": _trusted(uncertainty_bars(page.parameters)),
        "setup": _trusted(uncertainty_bars(page.setup, key="setup")),
        "ranking": _trusted([contribution_bars(page.contributions)] if page.contributions else []),
        "motions": _trusted(motion_bands([c for c in page.motions if c.unit == u], key=f"motions-{i}") for i, u in enumerate(units)),
        "slices": _trusted(slices),
        "shares": _trusted([share_plot(page.shares)] if page.shares else []),
        "gains": _trusted(gain_map(s, key=f"gain-{i}") for i, s in enumerate(page.gains)),
        "correlations": _trusted([correlation_plot(page.correlations)] if len(page.correlations.names) > 1 else []),
        "residuals": _trusted(residuals),
    }


def _trusted(pictures: Iterable[str]) -> list[Markup]:
    # The SVG writer has escaped every text; escaping again would show the reader the tags.
    return [Markup(p) for p in pictures]  # noqa: S704


def _parameter(row: ParameterRow) -> dict[str, str]:
    value, expanded = with_uncertainty(row.value, row.u)
    return {"name": row.name, "value": value, "u": expanded, "unit": row.unit, "note": row.note}


def _table(row: TableLine) -> dict[str, str]:
    figures = {k: "{} ± {}".format(*with_uncertainty(*getattr(row, f"{k}_um"))) for k in ("rms", "q95", "max")}
    return {"kind": row.kind, "entries": str(row.entries)} | figures


def _run(row: RunRow) -> dict[str, str]:
    figures: Sequence[float | None] = (row.residual_rms_um, row.noise_um)
    residual, noise = (plain(v) for v in figures)
    return {
        "label": row.label,
        "test": row.test,
        "points": str(row.points),
        "residual": residual,
        "noise": noise,
        "outliers": str(row.outliers),
    }
