"""Figures of a verification: the range and reversal of a diagonal, the rms of a helix, and what each of them leaves out."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.paths import diagonal_ends, straight_line
from abbe.models.solvers.observations import block_average
from abbe.models.verification import diagonal_figure, helix_figure, reversal_figure
from tests.models.solvers.truth import MACHINE, Truth


def test_figures_of_a_verification_do_not_feel_the_mounting():
    truth = Truth(4)
    start, end = diagonal_ends(MACHINE.stroke_mm + np.array([10.0, -10.0]), "pnp")
    run = truth.laser("v", straight_line(start, end, 21))
    f = diagonal_figure(run)
    line = np.linspace(start, end, 21)
    want = np.ptp(truth.deviation(line) @ (end - start) / np.linalg.norm(end - start))
    assert f.value_mm == pytest.approx(want, abs=3 * f.u_mm)
    near, far = truth.bar("a", np.array([270.0, 275.0, 54.0]), 154.0), truth.bar("b", np.array([270.0, 275.0, 54.0]), 154.0, 5e-3)
    a, b = helix_figure(block_average(near, 300)), helix_figure(block_average(far, 300))
    assert a.value_mm == pytest.approx(b.value_mm, abs=2 * a.u_mm)


def test_reversal_is_a_figure_of_its_own_beside_the_range_of_the_means():
    start, end = diagonal_ends(MACHINE.stroke_mm + np.array([10.0, -10.0]), "pnp")
    run = Truth(4).laser("v", straight_line(start, end, 21))
    assert run.beam is not None
    back = np.arange(len(run.deviation_mm)) > np.argmax(run.axes_mm @ run.beam)
    worn = replace(run, deviation_mm=run.deviation_mm - np.where(back, 8e-3, 0.0))
    before, after = reversal_figure(run), reversal_figure(worn)
    assert np.mean(after.deviation_mm) - np.mean(before.deviation_mm) == pytest.approx(8e-3)
    assert after.value_mm == pytest.approx(abs(np.mean(after.deviation_mm)))
    assert after.u_mm == pytest.approx(before.u_mm)
    assert diagonal_figure(worn).value_mm == pytest.approx(diagonal_figure(run).value_mm)


def test_a_drift_during_the_run_is_in_the_uncertainty_of_the_reversal():
    start, end = diagonal_ends(MACHINE.stroke_mm + np.array([10.0, -10.0]), "pnp")
    run = Truth(4).laser("v", straight_line(start, end, 21))
    drifting = replace(run, deviation_mm=run.deviation_mm + 4e-3 * (run.t_s - run.t_s[0]) / np.ptp(run.t_s))
    still, moved = reversal_figure(run), reversal_figure(drifting)
    shift = abs(np.mean(moved.deviation_mm) - np.mean(still.deviation_mm))
    assert shift > 1e-3
    assert moved.u_mm > shift / 2.0
    assert len(moved.position_mm) == 19, "at the ends the machine does not move between both readings"
