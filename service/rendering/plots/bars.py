"""Horizontal bars: contributions of the errors, and uncertainty of each parameter."""

from __future__ import annotations

from collections.abc import Sequence

from abbe.service.rendering.axes import Panel, data_range
from abbe.service.rendering.model import Contribution, ParameterRow
from abbe.service.rendering.numbers import COVERAGE, UM, Unit, finite, plain, with_uncertainty
from abbe.service.rendering.svg import Svg

WIDTH, ROW, TOP, BOTTOM = 500.0, 22.0, 34.0, 46.0
LABELS = 150.0
FIGURES = 130.0
"""Width of the column for value and uncertainty of a ranking."""


def contribution_bars(
    rows: Sequence[Contribution], *, key: str = "ranking", heading: str = "Rank of error contributions", unit: Unit = UM
) -> str:
    """Contributions with their expanded uncertainty (k = 2), largest first, those without a number last. ``unit``: display unit."""
    ranked = sorted((_in_unit(r, unit) for r in rows), key=lambda r: -abs(r.value_um) if finite(r.value_um) else 1.0)
    summary = "; ".join(f"{r.name} {_rounded(r)} {unit.sign}" for r in ranked)
    svg = Svg(WIDTH, TOP + ROW * max(len(ranked), 1) + BOTTOM, key, heading, f"{heading}: {summary}.")
    svg.text((10.0, 18.0), heading, "t-head")
    ends = [abs(r.value_um) + COVERAGE * (r.u_um if finite(r.u_um) else 0.0) for r in ranked if finite(r.value_um)]
    panel = Panel(LABELS, TOP, WIDTH - LABELS - FIGURES, ROW * max(len(ranked), 1), (0.0, data_range(ends, zero=True)[1]), (0.0, 1.0))
    panel.draw_x(svg, f"contribution in {unit.sign}", count=4)
    for i, row in enumerate(ranked):
        y = TOP + ROW * (i + 0.5)
        svg.text((LABELS - 8.0, y + 4.0), row.name[:24], anchor="end")
        svg.text((WIDTH - FIGURES + 14.0, y + 4.0), f"{_rounded(row)} {unit.sign}", "t-soft")
        if finite(row.value_um):
            end = panel.x(abs(row.value_um))
            svg.rect((LABELS, y - 7.0), (end - LABELS, 14.0), "f-c2")
            if finite(row.u_um) and row.u_um > 0.0:
                _whisker(svg, panel, row, y)
    return svg.render()


def _in_unit(row: Contribution, unit: Unit) -> Contribution:
    """The contribution in the display unit."""
    value, u = (v / unit.size if finite(v) else v for v in (row.value_um, row.u_um))
    return Contribution(row.name, value, u)


def _rounded(row: Contribution) -> str:
    """Value and U (k = 2), rounded to the uncertainty; the value alone without an uncertainty."""
    if row.value_um is not None and row.u_um is not None and finite(row.value_um) and finite(row.u_um) and row.u_um > 0.0:
        return "{} ± {}".format(*with_uncertainty(row.value_um, row.u_um))
    return plain(row.value_um)


def _whisker(svg: Svg, panel: Panel, row: Contribution, y: float) -> None:
    """Whisker of U, cut off at zero because a contribution is never negative."""
    value, u = abs(row.value_um or 0.0), COVERAGE * (row.u_um or 0.0)
    low, high = panel.x(max(value - u, 0.0)), panel.x(value + u)
    svg.error_bar((0.5 * (low + high), y), 0.5 * (high - low), horizontal=True)


def uncertainty_bars(rows: Sequence[ParameterRow], *, key: str = "parameters") -> list[str]:
    """Parameters with whiskers of U (k = 2), one picture per unit. Parameters without a value or an uncertainty are left out."""
    units: dict[str, list[ParameterRow]] = {}
    for row in rows:
        if finite(row.value) and finite(row.u):
            units.setdefault(row.unit, []).append(row)
    return [_one_unit(unit, group, f"{key}-{i}") for i, (unit, group) in enumerate(units.items())]


def _one_unit(unit: str, rows: Sequence[ParameterRow], key: str) -> str:
    summary = "; ".join("{} {} ± {}".format(r.name, *with_uncertainty(r.value, r.u)) for r in rows)
    svg = Svg(WIDTH, TOP + ROW * len(rows) + BOTTOM, key, f"Parameters in {unit}", f"Values with U (k = 2) in {unit}: {summary}.")
    svg.text((10.0, 18.0), f"Parameters in {unit}, whiskers U (k = 2)", "t-head")
    ends = [v for r in rows if finite(r.value) and finite(r.u) for v in (r.value - COVERAGE * r.u, r.value + COVERAGE * r.u)]
    panel = Panel(LABELS, TOP, WIDTH - LABELS - 16.0, ROW * len(rows), data_range(ends, zero=True), (0.0, 1.0))
    panel.draw_x(svg, f"value in {unit}")
    zero = panel.x(0.0)
    svg.line((zero, TOP), (zero, TOP + panel.height), "zero")
    for i, row in enumerate(rows):
        if not (finite(row.value) and finite(row.u)):
            continue
        y = TOP + ROW * (i + 0.5)
        at = (panel.x(row.value), y)
        svg.text((LABELS - 8.0, y + 4.0), row.name[:24], anchor="end")
        svg.error_bar(at, panel.x(COVERAGE * row.u) - zero, horizontal=True)
        svg.dot(at, 3.6, "f-c2", f"{row.name}: {plain(row.value)} {unit}, u {plain(row.u, 2)} {unit}")
    panel.draw_frame(svg)
    return svg.render()
