"""A solution of artefacts in a report and in tables: arrows where they lay, and the poses; heights by themselves."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.models.solvers.engine import DEFAULT_SIGMA_MM
from abbe.service.campaign_data.campaign_folder import from_folder
from abbe.service.compensation.proposals import change_of
from abbe.service.identification.artefact_answer import touched_boxes_mm
from abbe.service.identification.solve import Solved, solve_runs
from abbe.service.rendering.document import PictureBlock, TextTable
from abbe.service.report.artefact_sections import artefact_sections, pose_readings
from abbe.service.runs.observations import run_data
from tests.artefact_campaign import campaign, error_mm


@pytest.fixture(scope="module")
def solved(tmp_path_factory: pytest.TempPathFactory) -> Solved:
    """The third pose lies 100 mm higher; the errors are the same there."""
    found = from_folder(campaign(Path(tmp_path_factory.mktemp("plate"))))
    runs = list(found.runs)
    columns = replace(runs[2].columns, q_mm=runs[2].columns.q_mm + np.array([0.0, 0.0, 100.0]))
    runs[2] = replace(runs[2], columns=columns)
    return solve_runs(found.site, runs)


def test_each_height_has_its_picture_beside_the_poses(solved: Solved) -> None:
    (section,) = artefact_sections(solved.joint)
    pictures, poses = section.blocks
    assert isinstance(pictures, PictureBlock)
    assert isinstance(poses, TextTable)
    assert [f"Z = {z} mm" in svg for z, svg in zip((200, 300), pictures.svgs, strict=True)] == [True, True]
    assert "best-fit rigid motion in the plane" in pictures.caption
    assert [row[0] for row in poses.rows] == ["p1", "p2", "p3", "p4"]
    assert "x (0, 1, 0), y (-1, 0, 0)" in poses.rows[1][5]


def test_tables_of_two_heights_take_out_what_both_have(solved: Solved) -> None:
    assert [box[2].tolist() for box in touched_boxes_mm(solved.joint)] == [[200.0, 200.0], [300.0, 300.0]]
    change, promised, (text,) = change_of(solved)
    assert text.startswith("known only in the planes and part of the strokes")
    x, y = np.meshgrid(np.linspace(280.0, 520.0, 7), np.linspace(120.0, 360.0, 7))
    at = np.column_stack([x.ravel(), y.ravel(), np.full(49, 250.0)])
    left = error_mm(*at[:, :2].T) + change.correction_at(at)[:, :2]
    away = at[:, :2] - at[:, :2].mean(axis=0)
    basis = np.stack([np.tile([1.0, 0.0], (49, 1)), np.tile([0.0, 1.0], (49, 1)), np.stack([-away[:, 1], away[:, 0]], 1)], -1).reshape(
        98, 3
    )
    left = left.ravel() - basis @ np.linalg.lstsq(basis, left.ravel(), rcond=None)[0]
    assert np.sqrt(np.mean(left**2)) < 0.2 * promised.before_mm
    assert not change.correction_mm[2].any()


def test_one_pose_shows_machine_and_artefact_together_without_the_best_motion(tmp_path: Path) -> None:
    run = from_folder(campaign(tmp_path)).runs[1]
    found = pose_readings(run, run_data(run))
    count, rms, noise, most = found.figures
    x, y = (run.columns.further[f"deviation_{a}_mm"] for a in "xy")
    place = np.array([run_data(run).points.nominal_mm[k, :2] for k in range(25)])  # type: ignore[union-attr]
    own = (x - x.mean()) + 1j * (y - y.mean())
    away = (place - place.mean(axis=0)) @ [1.0, 1.0j]
    own -= 1j * away * (np.conj(1j * away) @ own).real / (np.abs(away) ** 2).sum()
    assert count.value == 25
    assert rms.value == pytest.approx(1e3 * np.sqrt(np.mean(np.abs(own) ** 2) / 2.0), rel=1e-6)
    assert most.value == pytest.approx(1e3 * np.abs(own).max(), rel=1e-6)
    assert rms.u is not None
    assert most.u is not None
    assert 0.0 < rms.u < noise.value < most.u < most.value
    assert "machine and form of the artefact together" in found.not_observable[0]
    (picture,) = found.pictures
    assert picture.svgs[0].count("<title>(") == 25


def test_features_on_a_line_have_figures_and_no_picture(tmp_path: Path) -> None:
    run = from_folder(campaign(tmp_path)).runs[0]
    data = run_data(run)
    assert data.points is not None
    flat = replace(data, points=replace(data.points, nominal_mm=data.points.nominal_mm * [1.0, 0.0, 0.0]))
    assert [pose_readings(run, flat).pictures, len(pose_readings(run, flat).figures)] == [[], 4]


def test_noise_alone_exceeds_u_of_the_largest_deviation_in_a_twentieth_of_all_poses(tmp_path: Path) -> None:
    run = from_folder(campaign(tmp_path)).runs[0]
    data, rng, beyond = run_data(run), np.random.default_rng(7), 0
    u = DEFAULT_SIGMA_MM["artefact"] / np.sqrt(data.weight_n)
    for _ in range(300):
        most = pose_readings(run, replace(data, deviation_mm=rng.normal(0.0, u))).figures[-1]
        assert most.value is not None
        assert most.u is not None
        beyond += most.value > 2.0 * most.u
    assert 2 <= beyond <= 28, "15 of 300 are expected; the fitted motion takes some noise away"
