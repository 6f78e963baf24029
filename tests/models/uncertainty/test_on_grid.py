"""The uncertainty on a grid, from tables of its lines, is that of the same points one by one."""

import numpy as np
import pytest

from abbe.models.geometry.field import CORES, grid_lines
from abbe.models.geometry.volume import volume_frame
from abbe.models.solvers.joint import solve_joint
from abbe.models.uncertainty import on_grid
from abbe.models.uncertainty.prediction import predict_deviation
from abbe.models.uncertainty.sources import error_sources
from tests.experiments.campaigns.population import draw_case


@pytest.fixture(scope="module")
def sources():
    case = draw_case(10067, "laser_only")
    return error_sources(solve_joint(case.machine, case.runs[:10], order=4))


def grid(stroke_mm, counts):
    """Positions that are neither even nor sorted, X slowest."""
    rng = np.random.default_rng(4)
    lines = [rng.uniform(lo, hi, n) for (lo, hi), n in zip(stroke_mm, counts, strict=True)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def assert_same(sources, points, **how):
    """A grid in another order is none: its points are predicted one by one."""
    order = np.random.default_rng(5).permutation(len(points))
    assert grid_lines(points) is not None
    assert grid_lines(points[order]) is None
    on, by = predict_deviation(sources, points, **how), predict_deviation(sources, points[order], **how)
    scale = np.abs(by.covariance_mm2).max()
    assert np.abs(on.deviation_mm[order] - by.deviation_mm).max() < 1e-12
    assert np.abs(on.covariance_mm2[order] - by.covariance_mm2).max() < 1e-10 * scale
    assert np.abs(on.variance_mm2[:, order] - by.variance_mm2).max() < 1e-10 * scale
    assert on.expanded_mm[order] == pytest.approx(by.expanded_mm, rel=1e-8, abs=1e-12)
    assert on.variance_mm2.min() >= 0.0


@pytest.mark.parametrize("framed", [False, True])
@pytest.mark.parametrize("tool_mm", [None, np.array([12.0, -40.0, -155.0])])
def test_a_grid_is_predicted_as_its_points_are(sources, framed, tool_mm):
    machine = sources.solution.machine
    frame = volume_frame(machine) if framed else None
    assert_same(sources, grid(machine.stroke_mm, (7, 12, 9)), tool_mm=tool_mm, frame=frame)


def test_no_source_gives_a_negative_variance_where_the_frame_cancels_it(sources):
    """At the datum corner and in the middle of the volume some sources vanish but for rounding."""
    machine = sources.solution.machine
    lines = [np.linspace(lo, hi, 9) for lo, hi in machine.stroke_mm]
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    assert_same(sources, points, frame=volume_frame(machine))


def test_long_lines_are_worked_off_in_strips_by_two_threads(sources, monkeypatch):
    monkeypatch.setattr("abbe.models.geometry.field.SHARED", 1)
    monkeypatch.setattr(on_grid, "BLOCK", 40)
    assert CORES == 2
    assert_same(sources, grid(sources.solution.machine.stroke_mm, (9, 11, 6)))


def test_a_sheet_of_two_planes_is_predicted_too(sources):
    """Too thin for tables: that of its two long lines would be as large as the answer."""
    assert_same(sources, grid(sources.solution.machine.stroke_mm, (2, 20, 15)))
