"""Set-ups that no fit has seen: their runs share one cup and one length of the bar, and one instant at which they were mounted."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.case import CaseRun
from abbe.models.discovery.solved_model import left_over, left_together
from abbe.models.effects.instruments.bar_thermal import relaxing
from abbe.models.paths import Law, even_helix_points, helix_points
from abbe.service.runs.cases import case_of
from tests.models.discovery.discovery_paths import MACHINE, campaign
from tests.run_documents import runs_of

PATHS = [p for p in campaign() if p.setup == "B"]
LASER = next(p for p in campaign() if p.kind == "laser")
NOTHING = {p.label: np.zeros(p.n) for p in (*PATHS, LASER)}


def runs_reading(readings: list[F1]) -> list[CaseRun]:
    return [CaseRun(p, "holdout", r, np.ones(p.n, dtype=bool)) for p, r in zip(PATHS, readings, strict=True)]


def rms(parts: dict[str, F1]) -> float:
    return float(np.sqrt(np.nanmean(np.concatenate(list(parts.values())) ** 2)))


def test_one_cup_and_one_length_leave_nothing_and_one_cup_each_is_not_given_away() -> None:
    cup, other = np.array([3e-3, -2e-3, 5e-3]), np.array([-4e-3, 1e-3, 0.0])
    same = runs_reading([p.look @ cup + 2e-3 for p in PATHS])
    assert rms(left_together(same, NOTHING, set())) < 1e-12
    moved = runs_reading([p.look @ c for p, c in zip(PATHS, (cup, other), strict=True)])
    assert rms(left_together(moved, NOTHING, set())) > 1e-3
    assert rms({r.path.label: left_over(r, NOTHING[r.path.label], set()) for r in moved}) < 1e-12
    assert rms(left_together(same, NOTHING, {"B"})) > 1e-3  # its cup was fitted: nothing is free any more


def test_a_bar_that_cools_shows_between_two_runs_of_a_set_up_and_hardly_in_each() -> None:
    cooling = runs_reading([5.0 * relaxing(p, "", {"tau_s": 600.0})[:, 0] for p in PATHS])
    together = rms(left_together(cooling, NOTHING, set()))
    alone = rms({r.path.label: left_over(r, NOTHING[r.path.label], set()) for r in cooling})
    assert together > 1.5 * alone


def test_another_bar_in_the_same_cup_has_a_length_of_its_own_and_flagged_readings_are_nan() -> None:
    first, second = runs_reading([np.full(p.n, length) for p, length in zip(PATHS, (1e-3, 4e-3), strict=True)])
    assert rms(left_together([first, second], NOTHING, set())) > 1e-3
    changed = replace(second, path=replace(second.path, radius_mm=100.0), valid=np.arange(second.path.n) != 7)
    left = left_together([first, changed], NOTHING, set())
    assert rms(left) < 1e-12
    assert np.isnan(left[changed.path.label]).nonzero()[0].tolist() == [7]


def test_a_laser_run_keeps_its_own_zero() -> None:
    run = CaseRun(LASER, "holdout", np.full(LASER.n, 7e-3), np.ones(LASER.n, dtype=bool))
    assert rms(left_together([run], NOTHING, set())) < 1e-12


def bar_run(label: str, setup: str, t_set_s: float, start_s: float) -> dict[str, Any]:
    points = helix_points(np.array([300.0, 250.0, 135.0]), 147.0, turns=4, n=40, law="area", axis=2)
    n = len(points)
    columns = {"t_s": (start_s + np.arange(n)).tolist(), **{f"{c}_mm": points[:, k].tolist() for k, c in enumerate("xyz")}}
    columns |= {"feed_mm_min": [1000.0] * n, "direction": [1] * n, "deviation_mm": [0.0] * n}
    centre = {"setup_id": setup, "t_set_s": t_set_s, "centre_mm": [300.0, 250.0, 135.0], "radius_mm": 147.0}
    return {"run_id": label, "test": "ballbar_helix", "role": "identify", "setup": centre, "columns": columns}


def test_all_runs_of_a_set_up_begin_when_it_was_mounted() -> None:
    """Runs that were stored while every run said when it began itself."""
    runs = [bar_run("r1", "A", 100.0, 120.0), bar_run("r2", "A", 300.0, 320.0), bar_run("r3", "B", 500.0, 520.0)]
    case = case_of({"campaign": "c", "machine": {}}, MACHINE, runs_of(runs[::-1]))
    assert {r.path.label: r.path.t_set_s for r in case.runs} == {"r1": 100.0, "r2": 100.0, "r3": 500.0}
    assert {r.path.label: float(r.path.reference.t_s[0]) for r in case.runs} == {"r1": 100.0, "r2": 100.0, "r3": 500.0}
    assert runs[1]["setup"]["t_set_s"] == 300.0


@pytest.mark.parametrize("law", ["area", "angle"])
def test_even_points_lie_on_the_same_curve_almost_equally_far_apart(law: Law) -> None:
    centre, n = np.array([10.0, 20.0, 30.0]), 3000
    even = even_helix_points(centre, 147.0, turns=4, n=n, law=law, axis=2)
    usual = helix_points(centre, 147.0, turns=4, n=20 * n, law=law, axis=2)
    assert even[[0, -1]] == pytest.approx(usual[[0, -1]], abs=1e-9)
    assert np.linalg.norm(even - centre, axis=1) == pytest.approx(np.full(n, 147.0), abs=1e-9)
    steps = np.linalg.norm(np.diff(even, axis=0), axis=1)
    assert steps / steps.mean() == pytest.approx(np.linspace(0.8, 1.2, n - 1), abs=2e-3)  # never passed with one frequency
    height = (even[:, 2] - centre[2]) / 147.0
    share = 1.0 - height if law == "area" else np.arccos(np.clip(height, -1.0, 1.0)) / (0.5 * np.pi)
    around = np.column_stack([np.cos(8.0 * np.pi * share), np.sin(8.0 * np.pi * share)]) * np.sqrt(1.0 - height**2)[:, None]
    assert (even[:, :2] - centre[:2]) / 147.0 == pytest.approx(around, abs=1e-6)
