"""Numbers, ticks, colours and the drawing decisions that a reader would be misled by."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from abbe.service.rendering import palette
from abbe.service.rendering.axes import data_range, nice_step, tick_text, ticks
from abbe.service.rendering.model import ArrowField, Contribution, ParameterRow, ResidualSeries, TableCurve
from abbe.service.rendering.numbers import plain, tidy, with_uncertainty
from abbe.service.rendering.plots import contribution_bars, residual_plot, table_plot, uncertainty_bars, volume_arrows, volume_pair
from abbe.service.rendering.plots.volume import MAX_ARROWS, common_scale
from abbe.service.rendering.svg import Svg


@pytest.mark.parametrize(
    ("value", "u", "expected"),
    [
        (41.31, 0.52, ("41.3", "1.0")),
        (18.204, 0.31, ("18.20", "0.62")),
        (-0.04, 0.498, ("0.0", "1.0")),
        (12345.0, 60.0, ("12340", "120")),
        (1.0, 0.0, ("1.00", "n/a")),
        (1.0, None, ("1.00", "n/a")),
        (math.nan, 1.0, ("n/a", "n/a")),
        (-3.0, 0.05, ("−3.00", "0.10")),
    ],
)
def test_value_and_uncertainty_are_rounded_together(value: float, u: float | None, expected: tuple[str, str]) -> None:
    assert with_uncertainty(value, u) == expected


@pytest.mark.parametrize(("value", "expected"), [(0.0, "0"), (-0.0001234, "−0.000123"), (1e-9, "1.00e-09"), (999.6, "1000"), (None, "n/a")])
def test_plain_numbers(value: float | None, expected: str) -> None:
    assert plain(value) == expected


def test_set_values_keep_the_digits_they_were_given() -> None:
    assert [tidy(v) for v in (600.0, 0.1, 12.5, 2.0, None)] == ["600", "0.1", "12.5", "2", "n/a"]


def test_ticks_are_round_and_inside() -> None:
    for span in (3e-5, 0.7, 12.0, 870.0, 4.4e6):
        step = nice_step(span)
        assert f"{step:e}"[0] in "125"
        marks = ticks(-0.3 * span, 0.7 * span)
        assert 3 <= len(marks) <= 8
        assert all(-0.3 * span - 1e-9 * span <= m <= 0.7 * span + 1e-9 * span for m in marks)
        assert len({tick_text(m, step) for m in marks}) == len(marks)


def test_ranges_of_odd_data() -> None:
    assert data_range([]) == (0.0, 1.0)
    assert data_range([math.nan, None]) == (0.0, 1.0)
    low, high = data_range([5.0, 5.0])
    assert low < 5.0 < high
    assert data_range([2.0, 3.0], zero=True)[0] < 0.0 < 3.0


@pytest.mark.parametrize("values", [palette.LIGHT, palette.DARK], ids=["light", "dark"])
def test_contrast_meets_aa(values: dict[str, str]) -> None:
    for role in ("ink", "soft", *(f"c{i}" for i in range(1, 6))):
        for ground in ("page", "panel"):
            assert palette.contrast(values[role], values[ground]) >= 4.5, (role, ground)
    for role in ("frame", *(f"seq{i}" for i in range(1, 6))):
        assert palette.contrast(values[role], values["page"]) >= 3.0, role


@pytest.mark.parametrize("values", [palette.LIGHT, palette.DARK], ids=["light", "dark"])
def test_arrow_colours_stand_out_more_the_longer_the_arrow(values: dict[str, str]) -> None:
    contrasts = [palette.contrast(values[f"seq{i}"], values["page"]) for i in range(1, 6)]
    assert contrasts == sorted(contrasts)


def test_every_style_in_a_picture_is_defined() -> None:
    rules = palette.style_rules()
    assert rules.count("@media screen and (prefers-color-scheme:dark)") == 1
    field = ArrowField(np.array(list(itertools.product((0.0, 1.0), repeat=3))), np.arange(24.0).reshape(8, 3))
    for name in re.findall(r'class="([^"]+)"', "".join(volume_pair(field, field))):
        for part in name.split():
            assert f".{part}{{" in rules, part


def test_before_and_after_share_one_scale() -> None:
    grid = np.array(list(itertools.product((0.0, 300.0, 600.0), repeat=3)))
    before, after = ArrowField(grid, np.full(grid.shape, 10.0)), ArrowField(grid, np.full(grid.shape, 1.0))
    first, second = (ET.fromstring(s) for s in volume_pair(before, after))
    assert [t.text for t in first.iter("text") if t.text and "drawn" in t.text] == [
        t.text for t in second.iter("text") if t.text and "drawn" in t.text
    ]
    assert common_scale(before, after) == common_scale(before)


def test_an_arrow_points_where_the_tool_goes() -> None:
    grid = np.array(list(itertools.product((0.0, 500.0), repeat=3)))
    for axis, (right, up) in enumerate(((1, -1), (1, 1), (0, 1))):
        error = np.zeros(grid.shape)
        error[:, axis] = 20.0
        field = ArrowField(grid, error)
        picture = ET.fromstring(volume_arrows(field, common_scale(field), key="k", heading="h"))
        line = next(g.find("line") for g in picture.iter("g"))
        assert line is not None
        dx, dy = (float(line.get(b, "")) - float(line.get(a, "")) for a, b in (("x1", "x2"), ("y1", "y2")))
        assert np.sign(round(dx, 1)) == right
        assert np.sign(round(-dy, 1)) == up


def test_many_nodes_are_thinned_but_all_are_counted() -> None:
    grid = np.array(list(itertools.product(np.linspace(0.0, 500.0, 12), repeat=3)))
    field = ArrowField(grid, np.full(grid.shape, 5.0))
    text = volume_arrows(field, common_scale(field), key="k", heading="h")
    assert text.count("<g>") <= MAX_ARROWS
    assert "over 1728 nodes" in text


def test_no_spike_is_lost_in_a_dense_run() -> None:
    y = np.zeros(50_000)
    y[31_415] = 7.0
    picture = ET.fromstring(residual_plot(ResidualSeries("r", "t in s", np.arange(50_000.0), y), noise_um=0.1, key="r"))
    tops = [min(float(e.get("y1", "")), float(e.get("y2", ""))) for e in picture.iter("line") if e.get("class", "").startswith("s-c2")]
    assert min(tops) < sorted(tops)[1] - 50.0
    assert len(tops) < 1000


def test_table_levels_show_only_when_they_can_be_told_apart() -> None:
    fine, coarse = ([TableCurve("X", "X", [0.0, 10.0], [0.0, top])] for top in (40.0, 0.8))
    assert "dots" not in table_plot(fine, lsb_um=0.1)
    assert "dots" in table_plot(coarse, lsb_um=0.1)


def test_contributions_are_ranked() -> None:
    text = contribution_bars([Contribution("small", 1.0), Contribution("none", None), Contribution("large", -5.0)])
    assert text.index(">large<") < text.index(">small<") < text.index(">none<")


def test_units_never_share_an_axis() -> None:
    rows = [ParameterRow("a", 1.0, 0.1, "µm"), ParameterRow("b", 1.0, 0.1, "µrad"), ParameterRow("c", 2.0, 0.1, "µm")]
    assert len(uncertainty_bars(rows)) == 2
    assert uncertainty_bars([dataclasses.replace(rows[0], u=None)]) == []


def test_a_gap_in_the_data_is_a_gap_in_the_line() -> None:
    svg = Svg(10, 10, "k", "t")
    svg.polyline([(0, 0), (1, 1), (math.nan, 2), (3, 3), (4, 4), (math.inf, 1), (5, 5)], "s-c1")
    assert svg.render().count("<polyline") == 2
    assert svg.render().count("<circle") == 1
