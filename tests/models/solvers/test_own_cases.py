"""The papers' own cases through the product: runs as they are stored, exact readings, one solution with the set-up among the unknowns.

Truth is that of the shared vectors (independent scripts), never of our own design. Figures seen are in the assertions' comments.
"""

import json
import os
from dataclasses import dataclass, replace

import numpy as np
import pytest

from abbe.models.geometry.bases import Term, smooth_terms
from abbe.models.geometry.chain import design
from abbe.models.geometry.volume import volume_grid
from abbe.models.machine import Machine
from abbe.models.papers.wang.experiments import WangPlan, distance_errors_mm, interpolated_mm, readings
from abbe.models.papers.wang.model import diagonal_beam, exact_positions_mm
from abbe.models.solvers.helix import LINEAR, fit_helix
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.least_squares import ParameterEstimate, solve_map
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SetupUnknowns, linearise, setup_unknowns
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.solvers.step_diagonal import increments, wang_eq7
from abbe.service.reference.vector_file import VectorCase
from abbe.service.reference.vectors.wang import DEMO_PLANS, IDEAL, NOISY, TILTED, errors_of, tilts_of

LONG = os.environ.get("ABBE_TEST_LONG") == "1"


def solved(
    machine: Machine, terms: tuple[Term, ...], runs: tuple[RunData, ...], setup: SetupUnknowns, sigma_mm: float, priors: Priors
) -> ParameterEstimate:
    """Most probable unknowns of the exact readings for priors as stated, nothing about them learned: Gauss and Newton, three steps."""
    names = (*(t.name for t in terms), "lost_X", "lost_Y", "lost_Z", *setup.names)
    prior = np.concatenate([term_prior_sd(machine, terms, priors), np.full(3, priors.backlash_mm), setup.prior_sd])
    y = np.concatenate([r.deviation_mm for r in runs])
    theta, estimate = np.zeros(len(names)), None
    for _ in range(3):
        value, a = (np.concatenate(v) for v in zip(*(linearise(machine, terms, r, setup, theta) for r in runs), strict=True))
        estimate = solve_map(names, a, y - value + a @ theta, np.full(y.size, sigma_mm), prior)
        theta = estimate.theta
    return estimate


# --- Yang and Kim: the laser's column of Table 2, seen by 63-point helices of 175 and 100 mm -------------------------------------------


@dataclass
class Yang:
    """Truth and readings of yang_helix.json: eq (2) as printed, z a workpiece coordinate (so EZZ is -dzz and Z is the squareness datum)."""

    sets: list[dict]
    origin: np.ndarray
    scales: np.ndarray
    squareness: np.ndarray

    machine = Machine("w-Z-b-X-Y-t", np.array([[0.0, 812.8], [-200.0, 295.0], [0.0, 508.0]]), tool_mm=np.array([0.0, 0.0, 150.0]))

    @classmethod
    def read(cls, shared) -> "Yang":
        v = json.loads((shared / "vectors" / "yang_helix.json").read_text())
        t = v["truth"]
        scales = np.array([t["dxx"], t["dyy"], -t["dzz"]])
        return cls(v["sets"], np.array(v["origin"]), scales, np.array([t["Sxy"], t["Sxz"], t["Syz"]]))

    @property
    def truth(self) -> np.ndarray:
        """EXX, EYY, EZZ slopes; C0Y, B0Z, A0Z (docs/explanation/conventions.md: the angles XZ and YZ are -B0Z and +A0Z)."""
        xy, xz, yz = self.squareness
        return np.array([*self.scales, xy, -xz, yz])

    @property
    def truth_in_our_datum(self) -> np.ndarray:
        """The same to the last digit: distances know the metric (I + M)^T (I + M) only, and with X as datum I + M is its upper root.

        The change of datum is a rotation by 0.1 mrad, whose square is the 0.024 urad by which these differ from `truth`.
        """
        strained = np.eye(3) + self.deviation(np.eye(3)).T
        m = np.linalg.cholesky(strained.T @ strained).T - np.eye(3)
        return np.array([*np.diag(m), -m[0, 1], m[0, 2], -m[1, 2]])

    def deviation(self, p: np.ndarray) -> np.ndarray:
        xy, xz, yz = self.squareness
        out = p * self.scales
        out[:, 0] -= xy * p[:, 1]
        out[:, 2] -= xz * p[:, 0] + yz * p[:, 1]
        return out

    def runs(self, offset_mm: np.ndarray, rng: np.random.Generator | None = None) -> tuple[RunData, ...]:
        """Both helices with the cup this far from where the spindle was, half a micrometre of noise if a generator is given."""
        out = []
        for k, s in enumerate(self.sets):
            p = np.array(s["points"])
            bar = p - self.origin + self.deviation(p) - self.deviation(self.origin[None]) - offset_mm
            reading = np.linalg.norm(bar, axis=1) - s["R"]
            if rng is not None:
                reading = reading + rng.normal(0, 5e-4, reading.size)
            n, label = reading.size, f"R{s['R']:g}"
            out.append(
                RunData(
                    label,
                    label,
                    "bar",
                    p,
                    reading,
                    np.zeros((n, 3)),
                    np.arange(n) + 600.0 * k,
                    np.ones(n),
                    self.origin,
                    s["R"],
                    None,
                    1.5e-3,
                    True,
                    test="helix",
                )
            )
        return tuple(out)

    def six(self, estimate: ParameterEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Slopes and squareness of an estimate, with their standard uncertainties."""
        factor = np.array([*(2.0 / self.machine.length_mm), 1.0, 1.0, 1.0])
        names = ("EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z")
        return np.array([estimate.value(n) for n in names]) * factor, np.array([estimate.u(n) for n in names]) * factor


SIX = tuple(t for t in smooth_terms(1) if t.order == 0 or t.component == t.axis)


@pytest.fixture(scope="module")
def yang(shared):
    return Yang.read(shared)


def test_yang_our_readings_of_his_machine_are_those_of_the_independent_script(yang):
    for run, s in zip(yang.runs(np.zeros(3)), yang.sets, strict=True):
        assert run.deviation_mm == pytest.approx(np.array(s["dR_nonlinear"]), abs=2e-13)


def test_yang_six_parameters_come_back_without_set_up_error(yang):
    perfect = SetupUnknowns((), np.zeros(0))
    for run in yang.runs(np.zeros(3)):
        found, _ = yang.six(solved(yang.machine, SIX, (run,), perfect, 1e-7, Priors()))
        assert np.abs(found - yang.truth_in_our_datum).max() < 1e-4 * 1e-6  # exact readings: nothing is neglected
        paper = fit_helix(run.axes_mm, run.deviation_mm, run.centre_mm, run.radius_mm, sigma_mm=1e-6, unknowns="six").estimate
        assert np.abs(paper.theta - yang.truth).max() < 0.02e-6  # math.md 8; seen 0.014 urad


@pytest.mark.parametrize(("axis", "wrong", "bias_urad"), [(0, "C0Y", 97.0), (1, "EYY.1", -61.0), (2, "A0Z", 97.0)])
def test_yang_ten_micrometres_of_mounting_ruin_the_papers_fit_and_not_ours(yang, axis, wrong, bias_urad):
    """math.md 4.5: 9.7, -6.1 and 9.7 urad per um at 175 mm. Ours: all six within their stated uncertainty, 15 draws of noise."""
    rng = np.random.default_rng(10 + axis)
    z, off = [], []
    for _ in range(15):
        runs = yang.runs(10e-3 * np.eye(3)[axis], rng)
        for run, factor in zip(runs, (1.0, 1.75), strict=True):
            paper = fit_helix(run.axes_mm, run.deviation_mm, run.centre_mm, run.radius_mm, sigma_mm=5e-4, unknowns="six").estimate
            off.append((paper.theta - yang.truth)[LINEAR.index(wrong)] * 1e6 / factor)
            assert abs(off[-1]) > 50
            ten = fit_helix(run.axes_mm, run.deviation_mm, run.centre_mm, run.radius_mm, sigma_mm=5e-4, unknowns="ten").estimate
            assert np.abs((ten.theta[:6] - yang.truth) / np.sqrt(np.diag(ten.covariance))[:6]).max() < 4.5
        found, u = yang.six(solve_joint(yang.machine, runs, model="rigid6", sigma_mm={"bar": 5e-4, "laser": 3e-4}).estimate)
        z.append((found - yang.truth) / u)
        assert u[:3].max() < 12e-6  # the length of the bar, 1.5 um on 175 and on 100 mm
        assert u[3:].max() < 4e-6
    assert np.mean(off) == pytest.approx(bias_urad, abs=3.0)
    assert np.abs(z).max() < 4.0
    assert 0.3 < np.sqrt(np.mean(np.square(z))) < 1.2


def test_yang_every_parameter_is_as_uncertain_as_stated(yang):
    """Cup, both bar lengths and noise drawn anew 300 times: each of the six inside 1.96 u as often as it says, its spread that of u.

    Binomial: 95 % of 300 is 285, three standard deviations are 11. Seen with 150 draws: 0.947 to 0.973, rms 0.88 to 0.95.
    The first 100 draws, held to the same bounds, unless ``ABBE_TEST_LONG=1``.
    """
    rng, z = np.random.default_rng(2024), []
    for _ in range(300 if LONG else 100):
        runs = yang.runs(rng.normal(0, 10e-3, 3), rng)
        runs = tuple(replace(r, deviation_mm=r.deviation_mm + rng.normal(0, r.u_length_mm)) for r in runs)
        found, u = yang.six(solve_joint(yang.machine, runs, model="rigid6", sigma_mm={"bar": 5e-4, "laser": 3e-4}).estimate)
        z.append((found - yang.truth_in_our_datum) / u)
    inside, rms = (np.abs(z) < 1.96).mean(axis=0), np.sqrt(np.mean(np.square(z), axis=0))
    assert inside.min() > 0.912
    assert inside.max() < 0.988
    assert rms.min() > 0.8
    assert rms.max() < 1.1


@pytest.mark.parametrize("noise", [{}, {"sigma_mm": {"bar": 1e-7, "laser": 1e-7}, "floor_mm": {"bar": 1e-7, "laser": 1e-7}}])
@pytest.mark.parametrize(("model", "order"), [("rigid6", None), ("rigid21", 3), ("auto", None)])
def test_yang_readings_without_any_noise_are_solved_and_not_believed_without_limit(yang, model, order, noise):
    """They used to drive the estimated noise to zero and the normal equations out of the digits of a double."""
    solution = solve_joint(yang.machine, yang.runs(np.zeros(3)), model=model, order=order, **noise)
    e = solution.estimate
    assert np.isfinite(e.covariance).all()
    assert solution.noise_mm["bar"] > 0.0
    found, u = yang.six(e)
    assert (np.abs(found - yang.truth_in_our_datum) < 3 * u + 1e-9).all()


# --- Wang: math.md 5.5, the machine "with angles" and mirrors tilted by 0.5 mrad -------------------------------------------------------


@dataclass
class Wang:
    """The machine of compensation_demo, its readings, and what each way leaves: worst error of all distances in a grid, um."""

    file: dict

    def __post_init__(self) -> None:
        self.inc = np.array(self.file["inc"])
        self.n = int(self.file["n"])
        self.travel = self.n * self.inc
        self.box = np.stack([np.zeros(3), self.travel], axis=1)
        self.grid = volume_grid(self.box, 5)
        self.machine = Machine("w-b-X-Y-Z-t", self.box)
        self.case = VectorCase(self.file, ("wang_step_diagonal",)).at("cases", TILTED)
        self.demo = self.file["compensation_demo"]

    def deviation(self, p: np.ndarray) -> np.ndarray:
        return exact_positions_mm(errors_of(self.case, p, self.travel), p)

    def worst_um(self, model_mm: np.ndarray) -> float:
        return float(np.abs(distance_errors_mm(self.grid, model_mm, self.deviation(self.grid))).max()) * 1e3

    def runs(self, plan: WangPlan, noise_mm: float = 0.0, seed: int = 0) -> tuple[RunData, ...]:
        """One run per diagonal and line; the first record is zero and without noise, as the file's readings have it."""
        y = readings(plan, self.deviation, tilts_of(self.case))
        y = y + np.random.default_rng(seed).normal(0, noise_mm, y.size)
        paths = [(f"{d}{plan.orders[k // 4]}", p, diagonal_beam(self.travel, d)) for k, (d, p) in enumerate(plan.diagonals)]
        paths += [(f"{'XYZ'[a]}{k // 3}", p, np.eye(3)[a]) for k, (a, p) in enumerate(plan.lines)]
        parts = np.split(y, np.cumsum([len(p) - 1 for _, p, _ in paths])[:-1])
        out = []
        for k, ((label, p, beam), part) in enumerate(zip(paths, parts, strict=True)):
            n = len(p)
            read, t_s = np.append(0.0, part), 600.0 * k + 2.0 * np.arange(n)
            out.append(RunData(label, label, "laser", p, read, np.zeros((n, 3)), t_s, np.ones(n), beam=beam, mirror_turns=False))
        return tuple(out)

    def solved_um(self, runs: tuple[RunData, ...], sigma_mm: float, priors: Priors) -> float:
        terms = smooth_terms(3)
        estimate = solved(self.machine, terms, runs, setup_unknowns(runs, priors), sigma_mm, priors)
        return self.worst_um(design(self.machine, terms, self.grid) @ estimate.theta[: len(terms)])


WIDE = {
    "scale_rad": 1e-3,
    "squareness_rad": 1e-3,
    "positioning_mm": 0.1,
    "straightness_mm": 0.1,
    "angle_rad": 1e-3,
    "angle_slope_rad": 1e-3,
}
"""Nothing said about the machine."""
AS_IN_THE_DEMONSTRATION = Priors(**WIDE, zero_mm=1e-9, drift_mm_s=1e-12, laser_scale=1e-12, cosine=1e-12)
"""Mirrors tilted, the laser otherwise perfect: what the demonstration's own least squares take for granted."""
TWO_ORDERS, ONE_ORDER = "rigid_lsq_2orders_linXYZ_2edges (rank 39/39)", "rigid_lsq_1order_linXYZ_1edge (rank 36/39)"
FILE_SEED = 1
"""The file does not print its draw of the noise; this one gives its figure to eight digits (0.58949028 um by minimum norm)."""


@pytest.fixture(scope="module")
def wang(shared):
    return Wang(json.loads((shared / "vectors" / "wang_step_diagonal.json").read_text()))


def plan_of(wang: Wang, name: str) -> WangPlan:
    return DEMO_PLANS[name](wang.travel, wang.n)


def test_wang_the_papers_formula_on_these_runs_leaves_15_and_220_micrometres(wang):
    runs = {r.label: r for r in wang.runs(plan_of(wang, ONE_ORDER))}
    tilted = {d: runs[f"{d}XYZ"].deviation_mm for d in ("ppp", "npp", "pnp", "ppn")}
    ideal = {d: np.array(v) for d, v in wang.file["cases"][IDEAL]["readings"].items()}
    for d, values in wang.file["cases"][TILTED]["readings"].items():
        assert tilted[d] == pytest.approx(np.array(values), abs=1e-12)  # our runs are the file's readings
    for measured, left in ((ideal, "wang_eq7_ideal_mirror"), (tilted, "wang_eq7_tilt_0.5mrad")):
        curves = interpolated_mm(wang.grid, wang.inc, wang_eq7(increments(measured), wang.inc))
        assert wang.worst_um(curves) == pytest.approx(wang.demo[left], rel=1e-8)  # 15.1 and 220.5 um, of 25.0 without compensation
    assert wang.worst_um(np.zeros_like(wang.grid)) == pytest.approx(wang.demo["no_compensation"], rel=1e-8)


def test_wang_ours_leaves_what_the_file_promises_on_its_own_noise(wang):
    exact = wang.solved_um(wang.runs(plan_of(wang, TWO_ORDERS)), 1e-6, AS_IN_THE_DEMONSTRATION)
    assert exact < 0.03  # the file: 0.013 um by a linear model; the rest is the model's datum rules and finite rotations
    noisy = wang.solved_um(wang.runs(plan_of(wang, TWO_ORDERS), 1e-4, FILE_SEED), 1e-4, AS_IN_THE_DEMONSTRATION)
    assert noisy <= wang.demo[NOISY]  # seen 0.57 um, the file 0.589


def test_wang_one_draw_of_noise_is_luck_and_the_usual_one_is_worse(wang):
    """The file's 0.6 um is a good draw: over draws, least squares of these runs leave 1.7 um in the mean, with or without our priors."""
    runs = [wang.runs(plan_of(wang, TWO_ORDERS), 1e-4, seed) for seed in range(8)]
    demanding = [wang.solved_um(r, 1e-4, Priors()) for r in runs]  # the laser's zero, drift, wavelength and alignment unknown too
    relaxed = [wang.solved_um(r, 1e-4, AS_IN_THE_DEMONSTRATION) for r in runs]
    assert np.mean(relaxed) == pytest.approx(1.67, abs=0.1)
    assert np.mean(demanding) == pytest.approx(1.72, abs=0.1)  # documented priors pay for the unknowns that the demonstration leaves out
    assert max(demanding) < 3.0


def test_wang_the_joint_solution_as_it_comes_is_ten_times_better_than_the_machine_and_a_hundred_than_the_paper(wang):
    s = solve_joint(wang.machine, wang.runs(plan_of(wang, TWO_ORDERS), 1e-4, FILE_SEED))
    assert wang.worst_um(s.deviation_mm(wang.grid)) < 2.5  # seen 2.0, of 25.0 and 220
