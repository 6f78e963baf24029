"""What may be compensated, what a budget says, what repeats tell: rules that are checked by hand-made numbers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from abbe.models.solvers.observations import RunData
from abbe.models.uncertainty.inputs import StatedInputs
from abbe.models.uncertainty.prediction import Prediction, budget_over, compensable_mask, worst_point
from tests.experiments.mathematics.repeatability import machine_repeatability


def prediction(deviation, variances, dof=np.inf, names=("bar_noise", "prior")):
    """Sources with independent components; ``variances``: (sources, m, 3)."""
    v = np.asarray(variances, float)
    d = np.asarray(deviation, float)
    covariance = np.einsum("mi,ij->mij", v.sum(axis=0), np.eye(3))
    return Prediction(np.zeros_like(d), d, covariance, names, v, np.full(d.shape, dof), 0.95)


def test_a_component_may_be_compensated_where_it_exceeds_its_expanded_uncertainty():
    """u = 1 um in each component: 1.9 um is not known well enough at k = 1.96, 2.1 um is; with k = 3 neither is."""
    one = np.full((1, 2, 3), 1e-6)
    p = prediction([[1.9e-3, 0.0, 0.0], [2.1e-3, -2.1e-3, 0.1e-3]], one, names=("bar_noise",))
    mask = compensable_mask(p)
    assert mask.components.tolist() == [[False, False, False], [True, True, False]]
    assert mask.points.tolist() == [False, True]
    assert mask.share == 0.5
    assert "1 of 2 points" in mask.text()
    assert "k = 1.96" in mask.text()
    assert not compensable_mask(p, k=3.0).points.any()
    assert not compensable_mask(p, smallest_mm=5e-3).points.any()
    assert "everywhere" in compensable_mask(p, k=1.0).text()


def test_a_point_is_judged_along_its_own_deviation():
    """Well known across, badly along: the deviation points where nothing is known."""
    p = prediction([[5e-3, 0, 0], [0, 5e-3, 0]], [[[16e-6, 1e-8, 1e-8]] * 2], names=("prior",))
    assert compensable_mask(p).points.tolist() == [False, True]


def test_few_degrees_of_freedom_make_the_mask_wider():
    one = np.full((1, 1, 3), 1e-6)
    assert compensable_mask(prediction([[3e-3, 0, 0]], one, 60.0, ("bar_noise",))).points[0]
    assert not compensable_mask(prediction([[3e-3, 0, 0]], one, 3.0, ("bar_noise",))).points[0]


def test_nothing_is_compensated_where_nothing_deviates():
    assert not compensable_mask(prediction([[0.0, 0, 0]], np.zeros((1, 1, 3)), names=("prior",))).points.any()


@pytest.mark.parametrize("arguments", [{"k": 0.0}, {"k": -1.0}, {"smallest_mm": -1.0}])
def test_a_mask_without_sense_is_refused(arguments):
    with pytest.raises(ValueError, match="compensable mask"):
        compensable_mask(prediction([[1.0, 0, 0]], np.ones((1, 1, 3)), names=("prior",)), **arguments)


def test_a_budget_adds_up_and_names_the_largest_source_first():
    p = prediction(np.zeros((2, 3)), [np.full((2, 3), 1e-6), np.array([[3e-6] * 3, [9e-6] * 3])])
    b = budget_over(prediction(np.zeros((1, 3)), [np.full((1, 3), 1e-6), np.full((1, 3), 9e-6)]))
    assert [line.name for line in b.lines] == ["prior", "bar_noise"]
    assert b.u_mm == pytest.approx(np.sqrt(30e-6))
    assert b.line("prior").share == pytest.approx(0.9)
    assert sum(line.share for line in b.lines) == pytest.approx(1.0)
    assert b.expanded_mm == pytest.approx(1.96 * np.sqrt(10e-6), rel=1e-4)
    assert budget_over(p).u_mm == pytest.approx(np.sqrt((30e-6 + 12e-6) / 2))
    assert worst_point(p) == 1
    assert "typical size of errors" in b.text().splitlines()[1]
    assert "k = 1.96" in b.text()
    with pytest.raises(KeyError):
        b.line("laser_noise")


@given(st.lists(st.lists(st.floats(0.0, 1e-4), min_size=6, max_size=6), min_size=1, max_size=2))
def test_shares_of_any_budget_add_up_to_one_and_squares_to_the_total(rows):
    v = np.array(rows).reshape(len(rows), 2, 3)
    b = budget_over(prediction(np.zeros((2, 3)), v, names=("bar_noise", "prior")[: len(rows)]))
    assert sum(line.u_mm**2 for line in b.lines) == pytest.approx(b.u_mm**2, abs=1e-18)
    if b.u_mm > 0:
        assert sum(line.share for line in b.lines) == pytest.approx(1.0)


def repeated(scatter_mm, sensor_mm, cycles=6, seed=0):
    """A laser that goes up and down an axis: lost motion, zero, drift, a smooth error, scatter of machine and sensor."""
    rng = np.random.default_rng(seed)
    up = np.linspace(0.0, 400.0, 21)
    x = np.tile(np.concatenate([up, up[::-1]]), cycles)
    sign = np.tile(np.repeat([1.0, -1.0], 21), cycles)
    t = 2.0 * np.arange(x.size)
    y = 4e-3 * np.sin(x / 90.0) - 1.5e-3 * sign + 2e-4 + 3e-6 * t + rng.normal(0, np.hypot(scatter_mm, sensor_mm), x.size)
    axes = np.column_stack([x, 0 * x, 0 * x])
    return RunData("l", "l", "laser", axes, y, np.column_stack([sign, 0 * x, 0 * x]), t, np.ones(x.size), beam=np.array([1.0, 0, 0]))


def test_repeatability_is_the_scatter_of_equal_approaches_without_the_sensor():
    found = machine_repeatability((repeated(8e-4, 3e-4),), "laser", 3e-4)
    assert found is not None
    assert found.dof == 6 * 42 - 42 - 1  # a zero is no more than a shift of all places
    assert found.machine_mm == pytest.approx(8e-4, rel=0.12)
    assert found.reading_mm == pytest.approx(np.hypot(8e-4, 3e-4), rel=0.12)


def test_a_sensor_that_explains_all_scatter_leaves_a_machine_that_repeats():
    found = machine_repeatability((repeated(0.0, 3e-4),), "laser", 4e-4)
    assert found is not None
    assert found.machine_mm == 0.0


def test_no_repeats_no_figure():
    once = repeated(1e-3, 0.0, cycles=1)
    assert machine_repeatability((once,), "laser", 0.0) is None
    assert machine_repeatability((once,), "bar", 0.0) is None
    with pytest.raises(ValueError, match="negative"):
        machine_repeatability((once,), "laser", -1.0)


@pytest.mark.parametrize(
    "wrong",
    [
        {"u_wavelength": -1e-6},
        {"u_scale_temperature_k": np.nan},
        {"orders_above": -1},
        {"repeatability_dof": 0.0},
        {"repeatability_mm": np.inf},
    ],
)
def test_inputs_without_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="uncertainty inputs"):
        StatedInputs(**wrong)
