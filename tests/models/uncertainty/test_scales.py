"""A ball-bar of unknown length tells everything but the common scale, a laser along diagonals everything but the axes' scales."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import rigid_design, volume_frame, volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.uncertainty.prediction import predict_deviation
from abbe.models.uncertainty.scales import scale_projection, without_scales
from abbe.models.uncertainty.sources import error_sources
from tests.experiments.campaigns.population import draw_case


@pytest.fixture(scope="module")
def bar():
    """Twenty runs of a bar of unknown length on one machine: the bar's of three campaigns, each with set-ups of its own."""
    kinds = ("two_tool", "ballbar_only", "joint")
    case = draw_case(8, kinds[0])
    runs = [
        replace(run, label=kind + run.label, setup=kind + run.setup, length_calibrated=False, u_length_mm=None)
        for kind in kinds
        for run in draw_case(8, kind).runs
        if run.kind == "bar"
    ]
    return case, solve_joint(case.machine, tuple(runs), order=4)


def _left(points, field, stretch):
    """What the best-fit rigid motion and the given stretches of each axis, shape (3, n), leave of a field, by least squares."""
    away = points - points.mean(axis=0)
    columns = np.concatenate([rigid_design(points), away[:, :, None] * stretch], axis=2).reshape(3 * len(points), -1)
    return field.ravel() - columns @ np.linalg.lstsq(columns, field.ravel(), rcond=None)[0]


@pytest.mark.parametrize(("scales", "stretch"), [("common", np.ones((3, 1))), ("axes", np.eye(3))])
def test_the_projected_map_is_the_map_without_its_best_fit_scales(bar, scales, stretch):
    case, s = bar
    points = volume_grid(case.machine.stroke_mm, 5)
    turn = scale_projection(case.machine, s.terms, scales)
    field = design(case.machine, s.terms, points)
    projected = field @ turn @ s.coefficients
    rigid = _left(points, projected, np.zeros((3, 1)))
    assert np.allclose(rigid, _left(points, field @ s.coefficients, stretch), atol=1e-10)  # mm
    assert np.allclose(turn @ turn, turn, atol=1e-9)  # nothing is left to take out


def test_without_the_common_scale_the_truth_is_inside_a_much_smaller_uncertainty(bar):
    case, s = bar
    points = volume_grid(case.machine.stroke_mm, 5)
    whole = error_sources(s)
    free = without_scales(whole, "common")
    frame = volume_frame(case.machine)
    known, rest = (predict_deviation(one, points, frame=frame) for one in (whole, free))
    assert np.sum(rest.u_mm**2) < 0.6 * np.sum(known.u_mm**2)
    assert np.allclose(free.solution.coefficients, free.coefficients[: len(s.terms)])
    truth = case.truth.deviation_mm(points)
    off = rest.deviation_mm.ravel() - _left(points, truth, np.ones((3, 1)))
    assert np.mean(np.abs(off) <= rest.expanded_mm.ravel()) > 0.9


def test_a_model_without_scales_has_none_to_leave_out(bar):
    case, s = bar
    with pytest.raises(ValueError, match=r"no term EXX\.1"):
        scale_projection(case.machine, tuple(t for t in s.terms if t.motion != "EXX"), "common")
