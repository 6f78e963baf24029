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


def warmed(run):
    """The same pose with a temperature of the air on record."""
    return replace(run, columns=replace(run.columns, further={**run.columns.further, "temperature_C": np.full(len(run.columns), 21.5)}))


def test_the_room_counts_where_no_run_recorded_the_air(solved_and_last):
    """A shop without a laser: its table is verified only if the room is held within 1 K."""
    solved, last = solved_and_last
    unknown = {name: values for name, values in last.columns.further.items() if name != "temperature_C"}
    steady, wide, recorded = (20.5, 21.5), (20.0, 21.5), warmed(last)
    last = replace(last, columns=replace(last.columns, further=unknown))
    assert pose_figures([last], solved.joint).air_c is None
    assert pose_figures([last], solved.joint, steady).air_c == steady
    assert pose_figures([recorded], solved.joint, steady).air_c == (21.5, 21.5)
    assert decide(*(pose_figures([run], solved.joint, steady) for run in (last, corrected(last)))).keep
    kept = decide(*(pose_figures([run], solved.joint, wide) for run in (last, corrected(last))))
    assert (kept.keep, "20.0 to 21.5 °C" in kept.text) == (False, True)


def true_rms(last):
    """Deviation of the machine over a pose without the rigid motion, rms."""
    e = error_mm(*last.columns.q_mm[:, :2].T)
    own = e - e.mean(axis=0)
    away = last.columns.q_mm[:, :2] - last.columns.q_mm[:, :2].mean(axis=0)
    turn = np.stack([-away[:, 1], away[:, 0]], axis=1)
    own -= turn * (turn * own).sum() / (turn**2).sum()
    return float(np.sqrt(np.mean(own**2)))


def test_the_figure_is_the_deviation_without_the_rigid_motion(solved_and_last):
    solved, last = solved_and_last
    figure, true = pose_figures([last], solved.joint).worst, true_rms(last)
    assert figure.value_mm == pytest.approx(true, abs=3.0 * figure.u_mm)
    assert 0.0 < figure.u_mm < 0.1 * true


def test_a_better_machine_is_kept_and_a_worse_one_is_not(solved_and_last):
    solved, last = solved_and_last
    warm = warmed(last)
    before, after = (pose_figures([run], solved.joint) for run in (warm, corrected(warm)))
    decision = decide(before, after)
    assert decision.keep, decision.text
    assert decision.text.startswith("worst pose ")
    assert not decide(after, before).keep
    assert set(figure_rows(before)) == {f"pose_{last.run_id}_um", "worst_pose_um"}


def test_an_artefact_of_another_campaign_is_refused(solved_and_last):
    solved, last = solved_and_last
    with pytest.raises(MeasurementFault, match="is not of an artefact that the solution contains"):
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


def test_another_artefact_verifies_if_one_pose_of_it_was_solved_with_the_first(tmp_path_factory):
    one = from_folder(campaign(tmp_path_factory.mktemp("one")))
    two = from_folder(campaign(tmp_path_factory.mktemp("two"), seed=7))
    others = [
        replace(r, run_id=f"q{k}", setup=replace(r.setup, setup_id=f"q{k}", artefact="B")) for k, r in enumerate((two.runs[1], two.runs[3]))
    ]
    known, last = others[0], replace(others[1], role="holdout")
    solved = solve_runs(one.site, [*one.runs[:3], known])
    figure = pose_figures([last], solved.joint).worst
    true = true_rms(last)
    assert figure.value_mm == pytest.approx(true, abs=3.0 * figure.u_mm)
    assert 0.0 < figure.u_mm < 0.2 * true
    assert decide(pose_figures([warmed(last)], solved.joint), pose_figures([corrected(warmed(last))], solved.joint)).keep
