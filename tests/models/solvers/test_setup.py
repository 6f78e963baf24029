"""What a run states about its set-up reaches the solution: bar length, calibration, tool."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.compensation.additive import mean_linear
from abbe.models.geometry.volume import remove_rigid, volume_grid
from abbe.models.solvers.assessment import observability
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observe import setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.service.errors import MeasurementFault
from abbe.service.runs.observations import run_data
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth, linear_parameters
from tests.run_documents import run_of

LONG = np.array([0.0, 0.0, -240.0])


def bars_alone(truth, length_mm, **stated):
    runs = tuple(replace(r, **stated) for r in truth.helices(length_mm=length_mm))
    return runs, solve_joint(MACHINE, runs, order=3, sigma_mm=SIGMA, floor_mm=FLOOR)


@pytest.mark.parametrize("stated", [{"u_length_mm": None, "length_calibrated": None}, {"length_calibrated": False}])
def test_an_uncalibrated_bar_lends_no_scale(stated):
    truth = Truth(1)
    runs, s = bars_alone(truth, 0.06, **stated)
    assert setup_unknowns(runs, Priors()).prior_sd.max() == Priors().bar_unknown_mm
    grid = volume_grid(MACHINE.stroke_mm, 11)
    want = linear_parameters(grid, truth.deviation(grid))[:3]
    for p, true in zip(mean_linear(s)[:3], want, strict=True):
        # 60 um on 165 mm are 360 um/m, so only the scales' own typical size is left, which their differences tell: seen 28e-6
        assert p.u > 20e-6
        assert abs(p.value - true) < 3 * p.u


def test_a_calibrated_bar_carries_its_stated_uncertainty_into_the_scales():
    found = {u: mean_linear(bars_alone(Truth(1), 1e-3, u_length_mm=u)[1])[0].u for u in (5e-4, 2e-3, 1e-2)}
    assert found[5e-4] < found[2e-3] < found[1e-2]
    assert found[2e-3] > 0.5 * 2e-3 / 165.0  # of the bar that most helices used; the longer one adds its own statement
    assert found[1e-2] > 15e-6  # 10 um on 165 mm and the scales' own typical size, both


def test_two_statements_about_one_bar_give_the_wider():
    a, b = Truth(1).helices()[1:3]
    setup = setup_unknowns((replace(a, u_length_mm=1e-3), replace(b, u_length_mm=4e-3)), Priors())
    assert setup.prior_sd[setup.names.index("bar_length_165")] == 4e-3


def test_a_second_tool_is_modelled_and_tells_what_one_tool_cannot():
    truth = Truth(2)
    one, bars = truth.campaign(), tuple(truth.helices())
    long = tuple(replace(r, label=f"t{r.label}", setup=f"t{r.setup}") for r in truth.helices(LONG))
    first = solve_joint(MACHINE, one, order=5, sigma_mm=SIGMA, floor_mm=FLOOR)
    both = solve_joint(MACHINE, one + long, order=5, sigma_mm=SIGMA, floor_mm=FLOOR)
    assert (first.tool_count, both.tool_count) == (1, 2)
    alone, with_long = (observability(MACHINE, runs, terms=5).rank for runs in (bars, bars + long))  # step diagonals show angles, too
    assert with_long > alone
    grid = volume_grid(MACHINE.stroke_mm, 7)

    def error(solution, tool_mm):
        gap = remove_rigid(grid, truth.deviation(grid, None, LONG) - solution.deviation_mm(grid, tool_mm))
        return np.sqrt(np.mean(np.sum(gap**2, axis=1)))

    assert error(both, LONG) < error(first, LONG)
    assert error(both, LONG) < 0.8 * error(both, None)


def stored_run(**setup):
    rng = np.random.default_rng(0)
    p = np.array([300.0, 250.0, 100.0]) + 150.0 * np.array([0.6, 0.8, 0.0]) + rng.normal(0, 1e-3, (20, 3))
    columns = {f"{c}_mm": p[:, k].tolist() for k, c in enumerate("xyz")}
    columns |= {"t_s": list(range(20)), "deviation_mm": [0.0] * 20}
    setup = {"setup_id": "A", "centre_mm": [300, 250, 100], "radius_mm": 150} | setup
    return run_of({"run_id": "r1", "test": "ballbar_helix", "role": "identify", "setup": setup, "columns": columns})


def test_the_stored_set_up_is_carried_and_its_absence_too():
    full = run_data(stored_run(u_length_mm=1e-3, length_calibrated=True, tool_mm=[1, 2, -3]))
    assert (full.u_length_mm, full.length_calibrated) == (1e-3, True)
    assert full.tool_mm is not None
    assert full.tool_mm.tolist() == [1.0, 2.0, -3.0]
    bare = run_data(stored_run())
    assert (bare.u_length_mm, bare.length_calibrated, bare.tool_mm) == (None, None, None)


@pytest.mark.parametrize("setup", [{"tool_mm": [1, 2]}, {"tool_mm": [0, 0, float("nan")]}, {"u_length_mm": -1e-3}])
def test_a_set_up_that_is_none_names_its_run(setup):
    with pytest.raises(MeasurementFault, match=r"run r1: (tool_mm|u_length_mm)"):
        run_data(stored_run(**setup))
