"""What `import abbe` offers: each name is there and documented, and the functions agree with each other on a machine that is known."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import abbe
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.geometry.chain import deviation_mm

MACHINE = abbe.Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]]))
ERRORS = abbe.ErrorMotions(
    {"EXX": abbe.Polynomial([0.0, 2e-5], 0.0), "EYX": abbe.Legendre([0.0, 0.0, 2e-3], (0.0, 600.0))}, {"C0Y": 30e-6, "B0Z": -12e-6}
)


def plan() -> abbe.CampaignPlan:
    """Half of the identification, and the verification."""
    half = [t for t in abbe.identification(MACHINE).tests if t.label.endswith(("helix1", "helix2", "X1", "Y1", "Z1", "XYZ"))]
    return abbe.CampaignPlan("june", (*half, *abbe.verification(MACHINE).tests))


@pytest.fixture(scope="module")
def campaign() -> abbe.Campaign:
    return abbe.simulate(MACHINE, plan(), ERRORS, effects={"backlash:X": 6.0})


@pytest.fixture(scope="module")
def solution(campaign: abbe.Campaign) -> abbe.Solution:
    return abbe.solve(campaign)


@pytest.mark.parametrize("name", abbe.__all__)
def test_each_public_name_is_there_and_documented(name: str):
    assert (getattr(abbe, name).__doc__ or "").strip()
    assert name in dir(abbe)


def test_another_name_is_refused_as_python_does():
    with pytest.raises(AttributeError, match="no attribute 'solver'"):
        abbe.solver  # noqa: B018


def test_importing_it_loads_nothing_that_is_not_asked_for():
    code = "import sys, abbe; print([m for m in ('numpy', 'sqlalchemy', 'fastapi') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_the_solution_finds_what_was_simulated_within_its_uncertainty(solution: abbe.Solution):
    for name, true in (("EXX", 20.0), ("C0Y", 30.0), ("B0Z", -12.0), ("backlash X", 6.0), ("backlash Y", 0.0)):
        found = solution.parameters[name]
        assert abs(found.value - true) < 3.0 * found.u, name
    assert solution.model == "rigid21"
    assert solution.flags == ()


def test_a_simulated_campaign_can_be_saved_for_the_command_line(campaign: abbe.Campaign, tmp_path: Path):
    read = abbe.read_campaign(campaign.save(tmp_path / "june"))
    assert read.name == campaign.name
    assert [(r.run_id, r.role, r.columns.to_document()) for r in read.runs] == [
        (r.run_id, r.role, r.columns.to_document()) for r in campaign.runs
    ]
    again = abbe.read_campaign(read.save(tmp_path / "again"))
    assert [run.to_document() for run in again.runs] == [run.to_document() for run in read.runs]
    one, two = (replace(run, run_id=name) for run, name in zip(campaign.runs, ("a b", "campaign"), strict=False))
    odd = replace(campaign, runs=[one, two, replace(two, run_id="a_b")])
    assert [run.run_id for run in abbe.read_campaign(odd.save(tmp_path / "odd")).runs] == ["a b", "campaign", "a_b"]
    with pytest.raises(abbe.AbbeError, match="abbe export june FOLDER"):
        replace(campaign, doc={}).save(tmp_path / "none")
    with pytest.raises(abbe.AbbeError, match="not an empty folder"):
        campaign.save(tmp_path / "june")


def test_progress_can_be_printed(campaign: abbe.Campaign, capsys: pytest.CaptureFixture[str]):
    abbe.solve(campaign, model="rigid6", progress=print)
    abbe.plan(MACHINE, minutes=8.0, progress=print)
    lines = capsys.readouterr().out.splitlines()
    assert any("units, axes" in line for line in lines)
    assert "  0% selecting the most informative measurements" in lines


def test_the_deviation_between_two_points_is_the_machines(solution: abbe.Solution):
    rng = np.random.default_rng(4)
    points = MACHINE.stroke_mm[:, 0] + rng.uniform(0.1, 0.9, (200, 3)) * MACHINE.length_mm
    true = deviation_mm(MACHINE, points, 0.5 * (ERRORS.motions(points) + ERRORS.motions(points, -np.ones_like(points))))
    found = solution.deviation(points)
    design = np.zeros((200, 3, 6))
    design[:, :, :3] = np.eye(3)
    for k, axis in enumerate(np.eye(3)):
        design[:, :, 3 + k] = np.cross(axis, points)
    off = (found.value_mm - true).reshape(-1)
    off -= design.reshape(-1, 6) @ np.linalg.lstsq(design.reshape(-1, 6), off, rcond=None)[0]  # the frame is free
    assert (np.abs(off) < found.U_mm.reshape(-1)).mean() > 0.95
    assert np.abs(off).max() < 1.5e-3


@pytest.mark.parametrize("points", [[1.0, 2.0], [[1.0, 2.0, np.nan]], [[[1.0, 2.0, 3.0]]]])
def test_points_that_are_none_are_refused(solution: abbe.Solution, points: list[float]):
    with pytest.raises(ValueError, match="points_mm"):
        solution.deviation(points)


def test_tables_take_the_error_out(solution: abbe.Solution):
    tables = solution.tables((25, 21, 19), unit_mm=1e-4)
    assert np.allclose(np.mod(tables.correction_mm[0] / 1e-4 + 0.5, 1.0), 0.5, atol=1e-6)
    ends = tables.correction_at(np.array([[0.0, 0.0, 0.0], [600.0, 0.0, 0.0]]))
    assert ends[1, 0] - ends[0, 0] == pytest.approx(-600.0 * 2e-5, abs=1.5e-3)


def test_a_flag_forbids_tables(campaign: abbe.Campaign):
    few = replace(campaign, runs=[r for r in campaign.runs if r.run_id.startswith("line")])
    solution = abbe.solve(few)
    with pytest.raises(abbe.AbbeError, match="no tables"):
        solution.tables((5, 5, 5))


def test_pictures_and_reports_are_pages(solution: abbe.Solution, tmp_path: Path):
    solution.plot().save(tmp_path / "motions.html")
    solution.report(tmp_path / "report.html")
    assert "<svg" in (tmp_path / "motions.html").read_text()
    assert "EXX" in (tmp_path / "report.html").read_text()
    with pytest.raises(abbe.AbbeError, match="cannot be written"):
        solution.plot().save(tmp_path / "no" / "folder.html")


def test_equal_seeds_draw_equal_campaigns_and_other_seeds_others():
    first, again, other = (abbe.simulate(MACHINE, abbe.verification(MACHINE), ERRORS, seed=s) for s in (3, 3, 4))
    readings = [c.runs[0].columns.readings_mm.tolist() for c in (first, again, other)]
    assert readings[0] == readings[1] != readings[2]


def test_recipes_may_stand_in_for_a_plan():
    helix = abbe.Helix("h", "A", "identify", (300.0, 250.0, 100.0), 100.0, turns=4.0)
    found = abbe.simulate(MACHINE, [helix], ERRORS)
    assert [r.run_id for r in found.runs] == ["h"]


def test_nothing_is_missing_where_nothing_was_added_and_an_added_effect_is_named(campaign: abbe.Campaign, tmp_path: Path):
    assert abbe.discover(abbe.simulate(MACHINE, plan(), ERRORS), progress=None).verdict == "none"
    answer = abbe.discover(campaign)
    found = answer.effects["backlash:X"]
    assert answer.verdict == "named"
    assert abs(found.value - 6.0) < 3.0 * found.u
    assert answer.gap["holdout"]["after_um"] < 1.2 * answer.gap["holdout"]["floor_um"] < answer.gap["holdout"]["before_um"]
    answer.report(tmp_path / "answer.html")
    assert "backlash" in (tmp_path / "answer.html").read_text()


def test_ones_own_effect_is_simulated_and_found():
    straightness = next(e for e in CATALOGUE if e.name == "backlash")
    own = replace(straightness, name="my_effect", title="my effect", separated_by={}, forms=())
    campaign = abbe.simulate(MACHINE, plan(), ERRORS, effects={"my_effect:Y": 8.0}, own_effects=(own,))
    answer = abbe.discover(campaign, effects=(own,))
    assert answer.verdict == "named"
    assert {label.partition(":")[2] for label in answer.effects} == {"Y"}  # backlash by either name


@pytest.mark.parametrize(
    ("label", "why"), [("friction:X", "no effect 'friction'"), ("backlash:W", "no key 'W'"), ("straightness:EYX", "several coefficients")]
)
def test_an_effect_that_cannot_be_simulated_is_refused_in_one_line(label: str, why: str):
    with pytest.raises(abbe.AbbeError, match=why):
        abbe.simulate(MACHINE, abbe.verification(MACHINE), ERRORS, effects={label: 1.0})


def test_a_strength_that_is_a_root_is_simulated_as_stated():
    feeds = [abbe.Helix(f"h{v:g}", "A", "identify", (300.0, 250.0, 100.0), 100.0, turns=4.0, feed_mm_min=v) for v in (1000.0, 4000.0)]
    quiet = abbe.SimulatedInstruments(bar_noise_mm=1e-6, laser_noise_mm=1e-6)
    slow, fast = (
        run.columns.readings_mm
        for run in abbe.simulate(MACHINE, feeds, abbe.ErrorMotions(), effects={"contour_lag": 20.0}, instruments=quiet).runs
    )
    v2 = (4000.0**2 - 1000.0**2) / 3600.0
    assert fast.mean() - slow.mean() == pytest.approx(-(0.02**2) * v2 / 200.0, rel=0.2)


def test_an_effect_that_breaks_the_rules_is_refused():
    bad = replace(CATALOGUE[0], name="Not a name")
    with pytest.raises(abbe.AbbeError, match="lower-case"):
        abbe.discover(abbe.simulate(MACHINE, abbe.verification(MACHINE), ERRORS), effects=(bad,))


def test_a_campaign_folder_is_read_and_a_missing_one_is_one_line(tmp_path: Path):
    with pytest.raises(abbe.AbbeError, match="no such folder"):
        abbe.read_campaign(tmp_path / "june")
