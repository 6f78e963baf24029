"""The search on small campaigns whose readings this file makes by formulas of its own."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import gain_of, taken
from abbe.models.discovery.case import Case, CaseRun, Role
from abbe.models.discovery.discover import discover, fairly
from abbe.models.discovery.instrument_noise import Colour, unscaled
from abbe.models.discovery.residues import leaning, shared
from abbe.models.discovery.selection import Contest, Selection, merged, weighed
from abbe.models.discovery.whitened_problem import SignalProjection, whiten
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.path import Path, at_rest, driven
from abbe.models.machine import Machine
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.discovery_text import lines_of
from abbe.service.discovery.finding import finding_of

R, N = 100.0, 109
MACHINE = Machine("w-X-b-Y-Z-t", np.array([[0.0, 400.0]] * 3))
CUPS = {"A": np.array([150.0, 150.0, 150.0]), "B": np.array([250.0, 240.0, 220.0])}
OFFSETS = {"A": np.array([0.012, -0.02, 0.007]), "B": np.array([-0.015, 0.01, 0.02])}
SCALES = np.array([2e-5, -3e-5, 1e-5])
FEW = tuple(e for e in CATALOGUE if e.name in ("backlash", "servo_mismatch"))
"""Where it does not matter what the names stand against."""


RUN_IN = 9


def circle(plane: int, direction: int) -> F2:
    """One turn around a cup after some run-in, shape (RUN_IN + N, 3); all turning points are readings."""
    angle = direction * np.arange(-RUN_IN, N) * 2.0 * np.pi / (N - 1)
    around = np.zeros((len(angle), 3))
    around[:, (plane + 1) % 3], around[:, (plane + 2) % 3] = R * np.cos(angle), R * np.sin(angle)
    return around


def left_behind(x_mm: F1, width_mm: float) -> F1:
    """How far an axis with play stays behind, half the width to either side: carried along at the end of its play, standing within it."""
    if np.ptp(x_mm) < 1e-9:
        return np.zeros(len(x_mm))
    carried = x_mm[0] - 0.5 * width_mm * np.sign(x_mm[1] - x_mm[0])
    out = np.zeros(len(x_mm))
    for k, x in enumerate(x_mm):
        carried = min(max(carried, x - 0.5 * width_mm), x + 0.5 * width_mm)
        out[k] = carried - x
    return out


def memory_noise(rng: np.random.Generator, sd_mm: float) -> F1:
    """White noise and a tenth of slowly forgetting noise."""
    slow = np.zeros(N)
    for k, shock in enumerate(rng.normal(size=N) * np.sqrt(1.0 - 0.75**2)):
        slow[k] = 0.75 * slow[k - 1] + shock if k else shock / np.sqrt(1.0 - 0.75**2)
    return np.asarray(sd_mm * (np.sqrt(0.9) * rng.normal(size=N) + np.sqrt(0.1) * slow))


def campaign(backlash_um: float = 0.0, step_um: float = 0.0, seed: int = 1, late_ms: float = 0.0) -> Case:
    """Two cups, three planes, both directions, two feeds; lost motion of X; X steps at 900 s; or Y trails the others."""
    rng, t0 = np.random.default_rng(seed), 60.0
    runs: list[CaseRun] = []
    for setup, cup in CUPS.items():
        t_set = t0
        for feed in (1000.0, 2500.0):
            for plane in range(3):
                for direction in (1, -1):
                    whole = circle(plane, direction)
                    behind = left_behind(whole[:, 0], 1e-3 * backlash_um)[RUN_IN:]
                    around = whole[RUN_IN:]
                    q = cup + around
                    t = t0 + np.arange(N) * 2.0 * np.pi * R / N / (feed / 60.0)
                    t0 = float(t[-1]) + 20.0
                    u = around / R
                    moved = SCALES * (q - cup) - OFFSETS[setup]
                    moved[:, 0] += behind
                    moved[:, 1] -= 1e-3 * late_ms * np.gradient(q[:, 1], t)
                    moved[:, 0] += 1e-3 * step_um * ((t > 900.0).astype(float) - float(t_set > 900.0))
                    reading = np.linalg.norm(around + moved, axis=1) - R + 0.002 + memory_noise(rng, 2e-4)
                    runs.append(run(f"r{len(runs):02d}", setup, cup, q, t, feed, direction, t_set, u, np.round(reading, 4)))
    return Case(
        "small", MACHINE, frozenset({"rigid6", "setup_centre_offset", "bar_length_error"}), tuple(runs), {"bar": 1e-4, "laser": 1e-5}
    )


def run(label: str, setup: str, cup: F1, q: F2, t: F1, feed: float, direction: int, t_set: float, u: F2, reading: F1) -> CaseRun:
    """Every seventh run is held out, every eleventh sealed."""
    speed, number = np.full(N, feed), int(label[1:])
    role: Role = "sealed" if number % 11 == 5 else "holdout" if number % 7 == 3 else "identify"
    path = Path(
        label, setup, "ballbar_circle", "bar", MACHINE, 2, driven(q, t, speed, dwelling=False, temp_c={}), at_rest(cup, t_set, {}), u,
        speed, np.full(N, float(direction)), np.zeros(N), t_set, 0.0, R, cup,
    )  # fmt: skip
    return CaseRun(path, role, None if role == "sealed" else reading, np.ones(N, dtype=bool))


@cache
def of_backlash() -> tuple[Case, Discovery]:
    case = campaign(backlash_um=4.0)
    return case, discover(case, CATALOGUE)


def answered(found: Discovery, case: Case) -> dict[str, Any]:
    """What `abbe discover` writes of it."""
    return answer_doc(finding_of(found, case, CATALOGUE, {r.path.label: np.zeros(r.path.n) for r in case.runs}))


def test_nothing_missing_is_none() -> None:
    found = discover(campaign(), CATALOGUE)
    assert found.verdict == "none"
    assert found.effects == ()
    assert found.gaps["identify"].after_mm == pytest.approx(2e-4, rel=0.1)


def test_lost_motion_is_named_with_its_size_and_the_gap_closes_on_runs_never_used() -> None:
    _, found = of_backlash()
    assert found.verdict == "named"
    assert [e.label for e in found.effects] == ["backlash:X"]
    effect = found.effects[0]
    assert abs(effect.strength - 4.0) < 3.0 * effect.u_strength
    assert effect.u_strength < 0.3
    held = found.gaps["holdout"]
    assert held.before_mm > 3.0 * held.floor_mm
    assert held.after_mm < 1.1 * held.floor_mm
    assert found.p_value < 1e-6
    assert effect.needed is not None
    assert effect.needed > 2.5  # without it the runs that judge are as bad as before


def test_the_better_of_two_names_stands_once_both_may_bend() -> None:
    """A search that let servo mismatch in where the axis has lost motion gives the name back."""
    case, _ = of_backlash()
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 12)}
    found, rivals = fairly(contest, weighed(contest, [by["servo_mismatch:X"]]))
    assert [f.pick.label for f in found] == ["backlash:X"]
    assert len(rivals) == 1
    assert "servo_mismatch:X" not in [r.pick.label for r in rivals[0]]  # far behind it


def test_two_axes_that_lead_give_way_to_the_one_that_trails() -> None:
    case = campaign(late_ms=0.2)
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 40)}
    lead = [by["servo_mismatch:X"], by["servo_mismatch:Z"]]
    assert [p.label for p in merged(contest, lead)] == ["servo_mismatch:Y"]
    idle = [by["servo_mismatch:Y"], by["backlash:X"]]
    assert [p.label for p in merged(contest, idle)] == ["servo_mismatch:Y"]


def test_two_names_that_both_explain_something_both_stay() -> None:
    case = campaign(backlash_um=4.0, late_ms=0.2)
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 40)}
    both = [by["servo_mismatch:Y"], by["backlash:X"]]
    assert merged(contest, both) == both


def test_a_name_that_explains_nothing_without_a_residue_goes_with_the_residue() -> None:
    case, _ = of_backlash()
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 40)}
    (true,) = weighed(contest, [by["backlash:X"]])
    spoilt = Selection(by["servo_mismatch:X"], gain=500.0, score=450.0)
    repair = Selection(by["servo_mismatch:Z"], gain=300.0, score=250.0)
    told = leaning(problem, [true, spoilt, repair], {"servo_mismatch:X"})
    assert set(told) == {"servo_mismatch:Z"}
    assert "servo_mismatch:X" in told["servo_mismatch:Z"]
    assert leaning(problem, [true, spoilt, repair], set()) == {}


def test_a_lone_name_that_leans_on_one_residue_is_told_with_that_residue() -> None:
    case = campaign(late_ms=0.2)
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 40)}
    lead, other, idle = by["servo_mismatch:X"], by["servo_mismatch:Z"], by["backlash:X"]
    alone, beside = gain_of(problem, lead, taken(problem, [])), gain_of(problem, lead, taken(problem, [other]))
    assert beside > 1.2 * alone > 0.0
    cost = 0.5 * (alone + beside)
    leans = Selection(lead, gain=beside, score=beside - cost)
    found = [leans, Selection(other, 500.0, 450.0), Selection(idle, 60.0, 10.0)]
    told = leaning(problem, found, {other.label, idle.label, "vibration:X"})
    assert told == {lead.label: f"evidence {leans.score / 2.0:.0f}, which vanishes without the rejected {other.label}"}
    assert leaning(problem, found, {idle.label}) == {}
    assert leaning(problem, [leans], {"vibration:X"}) == {}  # a variance effect is in no fit


def test_what_two_names_explain_together_counts_for_each_with_the_other_taken_out() -> None:
    case, _ = of_backlash()
    problem = whiten(case, baseline_of(case))
    contest = Contest.of(problem, CATALOGUE)
    by = {f.pick.label: f.pick for f in contest.shortlist(taken(problem, []), [], 40)}
    (alone,) = weighed(contest, [by["backlash:X"]])
    beside = weighed(contest, [by["backlash:X"], by["servo_mismatch:X"]])
    evidence = shared(problem, beside)["backlash:X", "servo_mismatch:X"]
    assert evidence == pytest.approx(0.5 * alone.score, rel=1e-6)
    assert evidence > 1.1 * 0.5 * beside[0].score


def test_where_nobody_judges_nothing_is_needed_or_not() -> None:
    case, _ = of_backlash()
    alone = replace(case, runs=tuple(r for r in case.runs if r.role != "holdout"))
    assert [e.needed for e in discover(alone, FEW).effects] == [None]


def test_sealed_runs_are_predicted() -> None:
    case, found = of_backlash()
    sealed = [r.path for r in case.of("sealed")]
    assert {p.label for p in sealed} <= set(found.predicted_mm)
    for p in sealed:
        moved = SCALES * (p.at.q_mm - p.centre_mm) - OFFSETS[p.setup]
        moved[:, 0] += left_behind(p.at.q_mm[:, 0], 4e-3)
        truth = np.linalg.norm(p.at.q_mm - p.centre_mm + moved, axis=1) - R + 0.002
        error = (found.predicted_mm[p.label] - truth)[1:]  # the first reading depends on the run-in
        assert np.sqrt(np.mean(error**2)) < 1e-4


def test_order_of_runs_does_not_matter_and_nothing_is_random() -> None:
    case, found = of_backlash()
    again = discover(replace(case, runs=case.runs[::-1]), CATALOGUE)
    assert [e.label for e in again.effects] == [e.label for e in found.effects]
    assert again.effects[0].strength == found.effects[0].strength
    assert again.p_value == found.p_value
    for label, value in found.predicted_mm.items():
        assert np.array_equal(value, again.predicted_mm[label])


def test_a_step_in_time_is_unknown_and_located() -> None:
    found = discover(campaign(step_um=6.0), CATALOGUE)
    assert found.verdict == "unknown"
    assert found.effects == ()
    assert found.location.time_s is not None
    low, high = found.location.time_s
    assert low <= 900.0 + 60.0
    assert high >= 900.0 - 60.0


def test_a_step_beside_a_name_is_not_credited_to_the_name() -> None:
    case = campaign(backlash_um=4.0, step_um=1.5)
    found = discover(case, CATALOGUE)
    assert found.verdict == "named"
    assert [e.label for e in found.effects] == ["backlash:X"]
    labels = [label for label, _ in found.beside]
    assert any(label.startswith("unnamed_") for label in labels)
    evidence = [value for _, value in found.beside]
    assert evidence == sorted(evidence, reverse=True)
    assert evidence[0] < found.effects[0].evidence
    told = dict(found.rejected)
    for label, value in found.beside:
        assert told[label].startswith(f"evidence {value:.0f}, without a name: ")
    assert answered(found, case)["beside"] == [{"label": label, "evidence": value} for label, value in found.beside]


def test_nothing_stands_beside_a_lone_name_or_an_unknown() -> None:
    assert of_backlash()[1].beside == ()
    unknown = discover(campaign(backlash_um=0.8, step_um=6.0), CATALOGUE)
    assert unknown.verdict == "unknown"
    assert unknown.effects == unknown.beside == ()
    assert "less than the structures without a name have" in dict(unknown.rejected)["backlash:X"]


def test_a_role_whose_readings_are_all_flagged_has_no_gap() -> None:
    case = campaign(backlash_um=4.0)
    runs = tuple(replace(r, valid=r.valid & (r.role != "holdout")) for r in case.runs)
    found = discover(replace(case, runs=runs), FEW)
    assert set(found.gaps) == {"identify"}
    assert "holdout_rms_um" not in answered(found, case)


def test_whitened_noise_has_unit_variance_and_no_memory() -> None:
    colour = Colour(3e-4)
    rng = np.random.default_rng(3)
    runs = 400
    noise = np.concatenate([memory_noise(rng, 3e-4) for _ in range(runs)])
    white = unscaled(noise[:, None], [N] * runs, ["bar"] * runs, {"bar": colour})[:, 0] / colour.sd_mm
    assert np.mean(white**2) == pytest.approx(1.0, abs=0.02)
    parts = white.reshape(runs, N)
    for lag in (1, 2, 5):
        assert abs(np.mean(parts[:, lag:] * parts[:, :-lag])) < 0.02


def test_what_is_left_of_readings_is_orthogonal_to_what_was_taken_out() -> None:
    rng = np.random.default_rng(5)
    columns, more, y = rng.normal(size=(80, 5)), rng.normal(size=(80, 2)), rng.normal(size=80)
    space = SignalProjection.of(y, columns, columns.T @ columns, np.full(5, 1e6)).without(more, np.full(2, 1e6))
    every = np.column_stack([columns, more])
    left = y - every @ np.linalg.lstsq(every, y, rcond=None)[0]
    assert space.residual == pytest.approx(left, abs=1e-8)
    assert space.chi2 == pytest.approx(float(left @ left), abs=1e-8)
    assert space.leverage.sum() == pytest.approx(7.0, abs=1e-8)


def test_without_a_run_that_judges_the_gap_is_told_on_left_out_blocks_and_such_a_run_is_proposed() -> None:
    case = campaign(backlash_um=4.0)
    alone = replace(case, runs=case.of("identify"))
    held, found = discover(case, FEW).gaps["holdout"], discover(alone, FEW)
    assert found.left_out is not None
    assert found.left_out.before_mm == pytest.approx(held.before_mm, rel=0.3)
    assert found.left_out.after_mm == pytest.approx(held.after_mm, rel=0.1)
    assert found.next_test is not None
    assert found.next_test.adds == ("judging_run",)
    told = lines_of(finding_of(found, alone, FEW, {r.path.label: np.zeros(r.path.n) for r in alone.runs}))
    assert "no holdout run of this campaign can judge; on blocks of runs left out of the fit in turn" in told[0]
    assert any("measure next: a run of the role holdout" in line for line in told)
