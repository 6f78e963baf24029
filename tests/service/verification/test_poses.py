"""A pose of an artefact that the solution did not use shows the deviation of the machine there, with U."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.errors import MeasurementFault
from abbe.service.identification.solve import solve_runs
from abbe.service.verification.verify import decide, figure_rows, pose_figures
from tests.artefact_campaign import campaign, error_mm


@pytest.fixture(scope="module")
def solved_and_last(tmp_path_factory):
    found = from_folder(campaign(tmp_path_factory.mktemp("plate")))
    *used, last = found.runs
    return solve_runs(found.site, used), replace(last, role="holdout")


def corrected(run):
    """The same pose as a machine without errors would find it."""
    e = error_mm(*run.columns.q_mm[:, :2].T)
    own = np.column_stack([e, np.zeros(len(e))]) @ run.setup.pose.matrix
    further = {**run.columns.further} | {
        f"deviation_{a}_mm": run.columns.further[f"deviation_{a}_mm"] + own[:, k] for k, a in enumerate("xy")
    }
    return replace(run, columns=replace(run.columns, further=further))


def test_the_figure_is_the_deviation_without_the_rigid_motion(solved_and_last):
    solved, last = solved_and_last
    figure = pose_figures([last], solved.joint).worst
    e = error_mm(*last.columns.q_mm[:, :2].T)
    own = e - e.mean(axis=0)
    away = last.columns.q_mm[:, :2] - last.columns.q_mm[:, :2].mean(axis=0)
    turn = np.stack([-away[:, 1], away[:, 0]], axis=1)
    own -= turn * (turn * own).sum() / (turn**2).sum()
    true = float(np.sqrt(np.mean(own**2)))
    assert figure.value_mm == pytest.approx(true, abs=3.0 * figure.u_mm)
    assert 0.0 < figure.u_mm < 0.1 * true


def test_a_better_machine_is_kept_and_a_worse_one_is_not(solved_and_last):
    solved, last = solved_and_last
    warm = replace(last, columns=replace(last.columns, further={**last.columns.further, "temperature_C": np.full(len(last.columns), 21.5)}))
    before, after = (pose_figures([run], solved.joint) for run in (warm, corrected(warm)))
    decision = decide(before, after)
    assert decision.keep, decision.text
    assert decision.text.startswith("worst pose ")
    assert not decide(after, before).keep
    assert set(figure_rows(before)) == {f"pose_{last.run_id}_um", "worst_pose_um"}


def test_an_artefact_of_another_campaign_is_refused(solved_and_last):
    solved, last = solved_and_last
    with pytest.raises(MeasurementFault, match="does not contain the artefact"):
        pose_figures([replace(last, setup=replace(last.setup, artefact="B"))], solved.joint)


def test_a_pose_that_the_solution_used_proves_nothing(solved_and_last):
    solved, last = solved_and_last
    used = next(r for r in solved.joint.data if r.points is not None and r.points.source == "probe")
    there = replace(
        last,
        run_id="again",
        setup=replace(last.setup, pose=replace(last.setup.pose, matrix=used.points.matrix)),
        columns=replace(last.columns, q_mm=used.axes_mm[:25]),
    )
    with pytest.raises(MeasurementFault, match="repeats a pose of the solution"):
        pose_figures([there], solved.joint)
