"""Horizontal bars: contributions of errors, uncertainty of parameters, figures before and after, information from the readings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.service.rendering.axes import Panel, bar_panel, data_range
from abbe.service.rendering.model import Contribution, MotionShare, ParameterRow
from abbe.service.rendering.numbers import COVERAGE, UM, Unit, finite, plain, with_uncertainty
from abbe.service.rendering.svg import Svg

WIDTH, ROW, TOP, BOTTOM = 500.0, 22.0, 34.0, 46.0
LABELS = 150.0
SETUP_LABELS = 192.0
"""Width of the column for names of parameters, set-up parameters included, in the longest language."""
FIGURES = 130.0
"""Width of the column for value and uncertainty of a ranking."""
STATUS_STYLES = {"observed": "f-c1", "weak": "f-c3"}
PAIR_STYLES = ("f-c1", "f-c2")


def contribution_bars(
    rows: Sequence[Contribution], *, key: str = "ranking", heading: str = "Rank of error contributions", unit: Unit = UM
) -> str:
    """Contributions with their expanded uncertainty (k = 2), largest first, those without a number last. ``unit``: display unit."""
    ranked = sorted((_in_unit(r, unit) for r in rows), key=lambda r: -abs(r.value_um) if finite(r.value_um) else 1.0)
    summary = "; ".join(f"{r.name} {_rounded(r)} {unit.sign}" for r in ranked)
    height = ROW * max(len(ranked), 1)
    svg = Svg(WIDTH, TOP + height + BOTTOM, key, heading, f"{heading}: {summary}.")
    svg.text((10.0, 18.0), heading, "t-head")
    ends = [abs(r.value_um) + COVERAGE * (r.u_um if finite(r.u_um) else 0.0) for r in ranked if finite(r.value_um)]
    panel = bar_panel(LABELS, TOP, (WIDTH - LABELS - FIGURES, height), ends)
    panel.draw_x(svg, f"contribution in {unit.sign}", count=4)
    for i, row in enumerate(ranked):
        y = TOP + ROW * (i + 0.5)
        svg.text((LABELS - 8.0, y + 4.0), row.name[:24], anchor="end")
        svg.text((WIDTH - FIGURES + 14.0, y + 4.0), f"{_rounded(row)} {unit.sign}", "t-soft")
        _draw_size(svg, panel, (row.value_um, row.u_um), y, 14.0, "f-c2")
    return svg.render()


def _draw_size(svg: Svg, panel: Panel, known: tuple[float | None, float | None], y: float, height: float, style: str) -> None:
    """Bar of a value's size with the whisker of its U; nothing if the value is unknown."""
    value, u = known
    if finite(value):
        panel.draw_bar(svg, abs(value), y, height, style)
        if finite(u) and u > 0.0:
            panel.draw_whisker(svg, abs(value), COVERAGE * u, y)


def _in_unit(row: Contribution, unit: Unit) -> Contribution:
    """The contribution in the display unit."""
    value, u = (v / unit.size if finite(v) else v for v in (row.value_um, row.u_um))
    return Contribution(row.name, value, u)


def _rounded(row: Contribution) -> str:
    """Value and U (k = 2), rounded to the uncertainty; the value alone without an uncertainty."""
    if row.value_um is not None and row.u_um is not None and finite(row.value_um) and finite(row.u_um) and row.u_um > 0.0:
        return "{} ± {}".format(*with_uncertainty(row.value_um, row.u_um))
    return plain(row.value_um)


def uncertainty_bars(rows: Sequence[ParameterRow], *, key: str = "parameters") -> list[str]:
    """Parameters with whiskers of U (k = 2), one picture per unit. Parameters without a value or an uncertainty are left out."""
    units: dict[str, list[tuple[str, float, float]]] = {}
    for row in rows:
        if finite(row.value) and finite(row.u):
            units.setdefault(row.unit, []).append((row.name, row.value, row.u))
    return [_one_unit(unit, group, f"{key}-{i}") for i, (unit, group) in enumerate(units.items())]


def _one_unit(unit: str, rows: Sequence[tuple[str, float, float]], key: str) -> str:
    summary = "; ".join("{} {} ± {}".format(name, *with_uncertainty(value, u)) for name, value, u in rows)
    svg = Svg(WIDTH, TOP + ROW * len(rows) + BOTTOM, key, f"Parameters in {unit}", f"Values with U (k = 2) in {unit}: {summary}.")
    svg.text((10.0, 18.0), f"Parameters in {unit}, whiskers U (k = 2)", "t-head")
    ends = [v for _, value, u in rows for v in (value - COVERAGE * u, value + COVERAGE * u)]
    panel = Panel(SETUP_LABELS, TOP, WIDTH - SETUP_LABELS - 16.0, ROW * len(rows), data_range(ends, zero=True), (0.0, 1.0))
    panel.draw_x(svg, f"value in {unit}")
    zero = panel.x(0.0)
    svg.line((zero, TOP), (zero, TOP + panel.height), "zero")
    for i, (name, value, u) in enumerate(rows):
        at = (panel.x(value), TOP + ROW * (i + 0.5))
        svg.text((SETUP_LABELS - 8.0, at[1] + 4.0), name[:24], anchor="end")
        svg.error_bar(at, panel.x(COVERAGE * u) - zero, horizontal=True)
        svg.dot(at, 3.6, "f-c2", f"{name}: {plain(value)} {unit}, u {plain(u, 2)} {unit}")
    panel.draw_frame(svg)
    return svg.render()


@dataclass(frozen=True, slots=True)
class Pair:
    """One figure: two values with their standard uncertainties, µm; None: no value on that side."""

    name: str
    first: tuple[float, float] | None
    second: tuple[float, float] | None


def paired_bars(pairs: Sequence[Pair], names: tuple[str, str], *, key: str, heading: str, unit: Unit = UM) -> str:
    """Pairs of bars from top to bottom, with whiskers of U. ``names``: names of the first and the second bar; ``unit``: display unit."""
    width, row, top, labels = 640.0, 46.0, 58.0, 170.0
    shown = [(p.name, [None if v is None else (v[0] / unit.size, v[1] / unit.size) for v in (p.first, p.second)]) for p in pairs]
    summary = "; ".join(f"{name}: {_stated(sides[0], unit)}, {_stated(sides[1], unit)}" for name, sides in shown)
    svg = Svg(width, top + row * len(pairs) + BOTTOM, key, heading, f"{heading}; {names[0]}, {names[1]}: {summary}.")
    svg.text((10.0, 18.0), heading, "t-head")
    for k, name in enumerate(names):
        svg.rect((labels + k * 200.0, 30.0), (14.0, 12.0), PAIR_STYLES[k])
        svg.text((labels + k * 200.0 + 20.0, 41.0), name[:28], "t-small")
    ends = [abs(side[0]) + COVERAGE * side[1] for _, sides in shown for side in sides if side is not None]
    panel = bar_panel(labels, top, (width - labels - FIGURES, row * max(len(pairs), 1)), ends)
    panel.draw_x(svg, unit.sign, count=4)
    for i, (name, sides) in enumerate(shown):
        y = top + row * (i + 0.5)
        svg.text((labels - 8.0, y + 4.0), name[:24], anchor="end")
        for side, shift, style in zip(sides, (-10.0, 10.0), PAIR_STYLES, strict=True):
            svg.text((width - FIGURES + 14.0, y + shift + 4.0), _stated(side, unit), "t-soft")
            _draw_size(svg, panel, side or (None, None), y + shift, 12.0, style)
    return svg.render()


def _stated(side: tuple[float, float] | None, unit: Unit) -> str:
    return "–" if side is None else "{} ± {} {}".format(*with_uncertainty(*side), unit.sign)


def share_plot(
    rows: Sequence[MotionShare], *, key: str = "shares", heading: str = "Information of the readings about each error motion"
) -> str:
    """Share of information from readings per error motion, with its status, in the given order; the bar is empty if not observable."""
    width, row_height, top, labels, texts = 500.0, 20.0, 54.0, 64.0, 118.0
    kept = [r.name for r in rows if r.status == "observed"]
    count = f"{len(kept)} of {len(rows)} can have a compensation table of their own"
    height = row_height * max(len(rows), 1)
    svg = Svg(width, top + height + 50.0, key, heading, f"{heading}: {count}: {', '.join(kept) or 'none'}.")
    svg.text((10.0, 18.0), heading, "t-head")
    svg.text((10.0, 38.0), count, "t-soft")
    panel = Panel(labels, top, width - labels - texts, height, (0.0, 100.0), (0.0, 1.0))
    panel.draw_x(svg, "share of the information that comes from readings, in %", count=5)
    for i, row in enumerate(rows):
        y = top + row_height * (i + 0.5)
        svg.text((labels - 8.0, y + 4.0), row.name, anchor="end")
        svg.text((width - texts + 10.0, y + 4.0), row.status, "t-soft")
        tip = f"{row.name}: {plain(100.0 * row.share)} % from readings, {row.status}"
        panel.draw_bar(svg, 100.0 * row.share, y, 12.0, STATUS_STYLES.get(row.status, "frame"), tip)
    panel.draw_frame(svg)
    return svg.render()
