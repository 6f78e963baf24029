"""A table that acted and that nobody has: how large its effect on the readings is assumed to be, and what it does to the uncertainty."""

import os
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.compensation.nine_tables import nine_tables
from abbe.models.compensation.tables import quantise
from abbe.models.geometry.volume import volume_frame, volume_grid
from abbe.models.solvers.joint import solve_joint
from abbe.models.uncertainty.prediction import predict_deviation
from abbe.models.uncertainty.sources import error_sources
from abbe.service.identification.removal import effect_mm, reading_patterns_mm, removed_table, with_unknown_table
from tests.experiments.campaigns.population import draw_case

ORDER = 6


@pytest.mark.parametrize("seed", [1, 6] if os.environ.get("ABBE_TEST_LONG") == "1" else [1])
def test_a_real_table_is_of_the_size_that_is_drawn_and_the_uncertainty_includes_it(seed: int) -> None:
    """The machine is corrected by its own table and measured again; its lost motion absorbs a part of what the table moves."""
    case = draw_case(seed, "joint")
    before = solve_joint(case.machine, case.runs, order=ORDER)
    table = quantise(nine_tables(before, (25, 21, 19)), 1e-4)
    effect = effect_mm(case.runs, removed_table(table, case.truth.rig.draws.backlash_mm))
    ends = np.cumsum([run.deviation_mm.size for run in case.runs])[:-1]
    measured = tuple(replace(run, deviation_mm=run.deviation_mm + own) for run, own in zip(case.runs, np.split(effect, ends), strict=True))
    after = solve_joint(case.machine, measured, order=ORDER)
    drawn = reading_patterns_mm(after)
    assert 0.5 < drawn.std() / effect.std() < 2.0

    wider = with_unknown_table(after)
    assert np.array_equal(wider.coefficients, after.coefficients)
    at = volume_grid(case.machine.stroke_mm, 5)
    plain, told = (predict_deviation(error_sources(one), at, frame=volume_frame(case.machine)) for one in (after, wider))
    by_table = told.variance_mm2[told.names.index("table")]
    assert np.allclose(told.u_mm**2 - plain.u_mm**2, by_table, atol=1e-12)  # a source of its own beside the same others
    moved = predict_deviation(error_sources(before), at, frame=volume_frame(case.machine)).deviation_mm - told.deviation_mm
    assert 0.2 < np.sqrt(by_table.mean() / np.mean(moved**2)) < 5.0
    assert (np.sqrt(wider.estimate.covariance.diagonal()) <= wider.prior_sd * (1.0 + 1e-9)).all()  # never less sure than before any reading
