"""The machines that judge the solver share no code with it, yet agree with its kinematics; two of them are made, solved and judged."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.polynomial import legendre

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import perpendicular, predict, setup_unknowns
from abbe.models.solvers.priors import Priors
from tests.experiments.calibration import plates
from tests.experiments.calibration.families import CHAINS, FAMILIES, draw_machine
from tests.experiments.calibration.folder import write_case
from tests.experiments.calibration.judging import Case, Refused, judge, table
from tests.experiments.calibration.kinematics import F, Play, TrueMachine
from tests.experiments.calibration.measured import foreign
from tests.experiments.calibration.plan import Step, full_plan
from tests.experiments.calibration.readings import Noise, Setups, reading_mm

OTHER = "pitch" if os.environ.get("ABBE_TEST_LONG") == "1" else "poly"
"""Family that is judged beside ``gp``: the parts of a rough machine take minutes."""
ORDER, LOST_UM = 5, (4.0, 3.0, 2.0)
STROKE_MM = np.array([[0.0, 600.0], [-40.0, 460.0], [10.0, 460.0]])
PIVOTS_MM = np.array([[300.0, 260.0, -120.0], [10.0, 320.0, 260.0], [-70.0, 40.0, 330.0]])


def known_machine(chain: str, rng: np.random.Generator) -> tuple[TrueMachine, dict[str, float]]:
    """A machine of polynomials with constant lost motion, and its parameters by the names of a solution, mm and rad.

    The solver's mirror does not turn with the machine, so this one's does not, either.
    """
    names: dict[str, float] = {}

    def curve(axis: int, component: int):
        straight = component < 3 and component != axis
        c = np.where(np.arange(ORDER + 1) < (2 if straight else 1), 0.0, 20.0 * rng.standard_normal(ORDER + 1))
        motion = f"E{'XYZABC'[component]}{'XYZ'[axis]}"
        names.update({f"{motion}.{k}": c[k] * (1e-3 if component < 3 else 1e-6) for k in range(1, ORDER + 1)})
        start, length = 0.0 if straight else legendre.legval(-1.0, c), float(np.ptp(STROKE_MM[axis]))
        return lambda x: legendre.legval(2.0 * x / length - 1.0, c) - start

    curves = tuple(tuple(curve(j, c) for c in range(6)) for j in range(3))
    square = 50e-6 * rng.standard_normal(3)
    names.update(zip(("C0Y", "B0Z", "A0Z"), square, strict=True))
    play = tuple(Play(lambda x, b=b: np.full_like(x, b), np.zeros(3)) for b in LOST_UM)
    return TrueMachine(chain, STROKE_MM, PIVOTS_MM, curves, square, play), names


def as_the_solver_has_it(step: Step) -> RunData:
    """A run for the solver, its readings not used."""
    n = len(step.t_s)
    bar = {"centre_mm": np.array(step.setup["centre_mm"]), "radius_mm": step.setup["radius_mm"]} if step.is_bar else {}
    kind = "bar" if step.is_bar else "laser"
    beam = None if step.is_bar else np.array(step.setup["nominal_beam"])
    sign = travel_sign(step.axes_mm)
    return RunData(step.run, step.setup["setup_id"], kind, step.axes_mm, np.zeros(n), sign, step.t_s, np.ones(n), beam=beam, **bar)


def setup_values(setups: Setups, runs: tuple[RunData, ...]) -> dict[str, float]:
    """The drawn set-up errors by the solver's names."""
    out = {f"bar_length_{r:g}": v for r, v in setups.bars.items()}
    for name, cup in setups.cups.items():
        out |= {f"cup_{name}_{a}": cup[i] for i, a in enumerate("xyz")}
    for run in runs:
        if run.beam is not None:
            normal, real = setups.mirrors[run.setup]
            tilts = perpendicular(run.beam) @ (normal - run.beam)
            out |= {f"tilt_{run.setup}_1": tilts[0], f"tilt_{run.setup}_2": tilts[1], f"cosine_{run.setup}": 1.0 / (normal @ real) - 1.0}
    return out


@pytest.mark.parametrize("chain", CHAINS)
def test_readings_of_a_known_machine_are_those_that_the_solver_predicts(chain: str) -> None:
    rng = np.random.default_rng(len(chain) + CHAINS.index(chain))
    truth, names = known_machine(chain, rng)
    setups = Setups(rng)
    steps = [s for s in full_plan(STROKE_MM, 0.1) if s.run in ("r01", "r06", "r11", "r18")]
    made = [reading_mm(truth, step, setups) for step in steps]
    runs = tuple(as_the_solver_has_it(s) for s in steps)
    terms, unknowns = smooth_terms(ORDER), setup_unknowns(runs, Priors())
    values = setup_values(setups, runs)
    theta: F = np.array([*(names[t.name] for t in terms), *(1e-3 * b for b in LOST_UM), *(values.get(n, 0.0) for n in unknowns.names)])
    machine = Machine(chain, STROKE_MM, PIVOTS_MM)
    for run, reading in zip(runs, made, strict=True):
        assert reading.std() > 2e-3
        close = 1e-9 if run.beam is None else 1e-4  # the solver's mirror turns by the sum of three rotations of up to a milliradian
        np.testing.assert_allclose(reading, predict(machine, terms, run, unknowns, theta), rtol=0, atol=close)


@pytest.mark.parametrize("family", [f for f in FAMILIES if f != "measured"])
def test_a_family_draws_other_machines_with_another_seed_and_the_same_with_the_same(family: str) -> None:
    points = np.random.default_rng(1).uniform(10.0, 390.0, (20, 3))
    first, again, other = (draw_machine(family, np.random.default_rng(seed))[0].deviation_mm(points) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4


def test_curves_of_the_third_population_were_measured(shared: Path) -> None:
    x = np.linspace(0.0, 500.0, 300)
    drawn = np.stack([foreign(np.random.default_rng(seed), 500.0, 2.0)(x) for seed in range(8)])
    assert drawn.std(axis=1) == pytest.approx(2.0, rel=0.6)
    assert np.abs(np.corrcoef(drawn) - np.eye(8)).max() < 0.99


def test_noise_has_the_size_and_colour_of_its_kind() -> None:
    rng = np.random.default_rng(5)
    for kind, apart in (("white", 0.0), ("slow", 0.09), ("pink", 0.7)):
        runs = np.stack([Noise(0.5, 0.3, kind).draw(rng, 500, bar=True) for _ in range(40)])
        assert runs.std() == pytest.approx(0.5, rel=0.06)
        assert (runs[:, 1:] * runs[:, :-1]).mean() / runs.var() == pytest.approx(apart, abs=0.12 if kind == "pink" else 0.03)
    wrong = Noise(0.5, 0.3, outliers=0.05).draw(rng, 20000, bar=True)
    assert np.mean(np.abs(wrong) > 2.8) == pytest.approx(0.05, abs=0.01)


def test_machines_are_made_solved_and_judged(tmp_path: Path, shared: Path) -> None:
    for family in ("gp", OTHER):
        write_case(tmp_path, family, 0, seed=3, size=0.25)
    found = judge(tmp_path, tmp_path / "answers")
    smooth, other = found
    assert isinstance(smooth, Case)
    assert isinstance(other, Case)
    assert smooth.ratio < 0.6
    assert np.mean(np.abs(smooth.over_u) <= 1.0) > 0.8
    assert len(smooth.parameter_z) >= 5
    assert np.sqrt(np.mean(smooth.parameter_z**2)) < 3.0
    theirs = [sys.executable, shared / "tools" / "coverage.py", "--truth", tmp_path / "sealed", "--answers", tmp_path / "answers", "--json"]
    told = json.loads(subprocess.run(theirs, capture_output=True, check=True, text=True).stdout)
    for case in (smooth, other):
        assert told[case.family]["inside"] == pytest.approx(np.mean(np.abs(case.over_u) <= 1.0))
        assert told[case.family]["ratio"] == pytest.approx(case.ratio)
    assert [line.split(" | ")[0] for line in table(found).splitlines()[2:]] == ["| gp", f"| {OTHER}", "| all"]


def test_a_case_without_an_answer_is_told_with_what_the_program_said(tmp_path: Path) -> None:
    write_case(tmp_path, "walk", 0, seed=3, size=0.1)
    (tmp_path / "public" / "walk00" / "r01.json").write_text("{")
    (refused,) = judge(tmp_path, tmp_path / "answers")
    assert isinstance(refused, Refused)
    assert "r01" in refused.said
    assert "refused: walk00" in table([refused])


def test_a_mirror_on_the_spindle_turns_with_the_machine() -> None:
    machine = replace(known_machine("w-X-Y-b-Z-t", np.random.default_rng(4))[0], play=())
    diagonal = next(s for s in full_plan(STROKE_MM) if s.run == "r15")
    square = Setups(np.random.default_rng(0))
    beam = np.array(diagonal.setup["nominal_beam"])
    square.mirrors[diagonal.setup["setup_id"]] = beam, beam
    fixed, turning = (reading_mm(replace(machine, mirror_turns=turns), diagonal, square) for turns in (False, True))
    beside = (diagonal.axes_mm - diagonal.axes_mm[0]) @ (np.eye(3) - np.outer(beam, beam))
    turn = machine.motions(diagonal.axes_mm)[:, :, 3:].sum(axis=1)
    np.testing.assert_allclose(turning - fixed, np.einsum("ni,ni->n", np.cross(turn, beam), beside), rtol=0, atol=2e-5)
    assert np.abs(turning - fixed).max() > 5e-4


@pytest.mark.parametrize(("kind", "sign"), [("hole", -1.0), ("work", 1.0)])
def test_points_of_a_plate_show_the_machine_with_the_sign_of_their_source(tmp_path, kind, sign):
    """Less the true deviation of the machine, what all poses have in common, a rigid motion and a scale each, only micrometres are left."""
    name = plates.write_case(tmp_path, "big", kind, 0, seed=3)
    read = lambda f: json.loads((tmp_path / "public" / name / f).read_text())  # noqa: E731
    campaign = read("campaign.json")
    machine, _ = draw_machine("big", np.random.default_rng([3, *name.encode()]))
    left, raw = [], []
    for run in (read(r["file"]) for r in campaign["runs"]):
        c, pose = run["columns"], run["setup"]["pose"]
        rows = [i for i, f in enumerate(c["feature"]) if not f.startswith("W")][:25]
        at, matrix = np.array([c[f"{a}_mm"] for a in "xyz"]).T[rows], np.array(pose["matrix"])
        tool = np.array(run["setup"]["tool_mm"])
        own = replace(machine, pivots_mm=machine.pivots_mm - tool).deviation_mm(at) @ matrix
        found = np.array([c[f"deviation_{a}_mm"] for a in "xy"], dtype=np.float64).T[rows]
        n = {f["id"]: f["nominal_mm"][:2] for f in campaign["artefacts"]["A"]["features"]}
        q = np.array([n[c["feature"][i]] for i in rows]) / 200.0
        basis = np.stack([np.tile([1.0, 0.0], (25, 1)), np.tile([0.0, 1.0], (25, 1)), np.stack([-q[:, 1], q[:, 0]], 1), q], -1).reshape(
            50, -1
        )
        for kept, value in ((raw, found), (left, found - sign * own[:, :2])):
            kept.append(value.ravel() - basis @ np.linalg.lstsq(basis, value.ravel(), rcond=None)[0])
    spread = [float(np.std(np.array(v) - np.mean(v, axis=0))) for v in (raw, left)]
    assert spread[1] < min(2.5e-3, 0.6 * spread[0]), spread
    assert (tmp_path / "points" / f"{name}.csv").exists()
