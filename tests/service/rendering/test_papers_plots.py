"""Pictures of the papers: level lines are where they should be, colours know the sign, facets are drawn far to near."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest

from abbe.service.rendering.plots.curves import ComparedReadings, comparison_plot
from abbe.service.rendering.plots.isometric import VIEW, Paper, ViewWindow, depth, lobing_plot, surface_plot
from abbe.service.rendering.plots.maps import SignedScale, Surface, contour_plot, level_lines
from abbe.service.rendering.plots.volume import deformed_grid


def test_level_line_of_a_cone_is_one_closed_circle():
    x = np.linspace(-1, 1, 61)
    field = np.hypot(*np.meshgrid(x, x))
    (line,) = level_lines(x, x, field, 0.5)
    assert line[0] == pytest.approx(line[-1])
    radius = np.hypot(*np.array(line).T)
    assert radius == pytest.approx(0.5, abs=1e-3)
    length = np.linalg.norm(np.diff(np.array(line), axis=0), axis=1).sum()
    assert length == pytest.approx(np.pi, rel=2e-3)


def test_level_line_of_a_plane_is_exact_and_open():
    x, y = np.linspace(0, 3, 7), np.linspace(0, 2, 5)
    field = 2.0 * x[None, :] - y[:, None]
    (line,) = level_lines(x, y, field, 1.3)
    points = np.array(line)
    assert 2.0 * points[:, 0] - points[:, 1] == pytest.approx(1.3)
    assert points[:, 1].min() == pytest.approx(0.0)
    assert points[:, 1].max() == pytest.approx(2.0)


def test_a_saddle_gives_two_lines_and_gaps_are_left_out():
    x = np.linspace(-1, 1, 4)
    field = x[None, :] * x[:, None]
    assert len(level_lines(x, x, field, 0.05)) == 2
    field[1, 1] = np.nan
    assert all(np.isfinite(np.array(line)).all() for line in level_lines(x, x, field, 0.05))
    assert level_lines(x, x, np.full((4, 4), 2.0), 1.0) == []


@pytest.mark.parametrize(("value", "role"), [(-1e9, 1), (-3.5, 1), (-0.01, 4), (0.0, 5), (0.99, 5), (3.2, 8), (1e9, 8)])
def test_bands_know_the_sign(value, role):
    assert SignedScale(1.0).style(value) == f"f-d{role}"


def test_the_scale_holds_all_values():
    scale = SignedScale.around(np.array([-7.0, 2.0]), np.array([np.nan, 9.0]))
    assert 4 * scale.step >= 9.0
    assert scale.step == pytest.approx(5.0)
    assert SignedScale.around(np.zeros(3)).step == 1.0


def test_isometric_view_is_a_rotation_and_the_box_fits():
    assert np.allclose(VIEW @ VIEW.T, np.eye(3))
    low, high = np.array([0.0, -5.0, 2.0]), np.array([10.0, 5.0, 4.0])
    paper = Paper.around(low, high, ViewWindow((50.0, 60.0), 80.0, 90.0))
    corners = np.array([paper(np.array([a, b, c])) for a in (0, 10) for b in (-5, 5) for c in (2, 4)])
    assert np.ptp(corners, axis=0) == pytest.approx([80.0, min(90.0, np.ptp(corners[:, 1]))])
    assert depth(np.array([[1.0, 0, 0]])) > depth(np.array([[0.0, 1, 0]]))


def surface() -> Surface:
    x = np.linspace(-1, 1, 21)
    return Surface(x, x, 30.0 * x[None, :] * x[:, None] - 5.0, "X in mm", "Y in mm", "µm")


def sound(svg: str) -> ET.Element:
    root = ET.fromstring(svg)
    numbers = [float(v) for v in re.findall(r"-?\d+\.?\d*", " ".join(p.get("points", "") for p in root.iter("polygon")))]
    assert all(np.isfinite(numbers))
    return root


def test_surface_is_drawn_from_far_to_near_with_numbers_on_the_scale():
    s = surface()
    svg = surface_plot(s, SignedScale.around(s.values), key="k", heading="H")
    root = sound(svg)
    facets = [p for p in root.iter("polygon") if "facet" in p.get("class")]
    assert len(facets) == 20 * 20
    # the farthest corner of the floor is x small, y large: upper left in space, drawn first
    first, last = (np.mean([float(c.split(",")[1]) for c in f.get("points").split()]) for f in (facets[0], facets[-1]))
    assert first < last
    assert "X in mm" in svg
    assert "µm" in svg
    assert "−40" in svg


def test_contours_cover_the_panel_and_say_their_step():
    s = surface()
    scale = SignedScale.around(s.values)
    svg = contour_plot(s, scale, key="k", heading="H", dots=[(0.0, 0.0)])
    sound(svg)
    assert f"one line every {scale.step:g} µm" in svg
    assert "level-zero" in svg


def test_lobing_survives_values_that_are_missing():
    phi, theta = np.radians(np.arange(0, 91, 18.0)), np.radians(np.arange(0, 361, 18.0))
    values = 5.0 * np.sin(phi)[:, None] ** 2 * np.cos(3 * theta)[None, :]
    values[2, 3] = np.nan
    root = sound(lobing_plot(phi, theta, values, SignedScale.around(values), key="k", heading="H"))
    assert len([p for p in root.iter("polygon") if "facet" in p.get("class")]) == 5 * 20 - 4


def test_deformed_grid_states_its_magnification_and_draws_it():
    line = np.linspace(0.0, 100.0, 3)
    grid = np.stack(np.meshgrid(line, line, line, indexing="ij"), axis=-1)
    shift = np.zeros_like(grid)
    shift[..., 2] = 10.0  # everything 10 um up
    svg = deformed_grid(grid, shift, key="k", heading="H")
    drawn = float(re.search(r"errors drawn (\d+) ×", svg)[1])
    assert drawn * 0.010 <= 0.14 * np.linalg.norm([100, 100, 100])
    root = sound(svg)
    tops = [
        min(float(pair.split(",")[1]) for p in root.iter("polyline") if p.get("class") == style for pair in p.get("points").split())
        for style in ("hidden-edge", "s-c2")
    ]
    assert tops[1] < tops[0]  # up on paper is a smaller y
    assert "nan" not in deformed_grid(grid, np.zeros_like(grid), key="k", heading="H")


def test_comparison_reports_the_largest_distance():
    x = np.array([0.0, 10.0, 20.0])
    data = ComparedReadings("X in mm", x, "readings", np.array([0.0, 3.0, -4.0]), (("line", np.zeros(3)), ("other", x)))
    svg = comparison_plot(data, key="k", heading="H")
    sound(svg)
    assert "largest 4.00 µm" in svg
