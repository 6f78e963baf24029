"""yang_ballbar_complete.json: ball-bar readings of a machine with all 21 errors, fits to them, and noise gains of experiments."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.monomials import Kind, Monomial
from abbe.models.notation.yang import YangErrors, workpiece_mm
from abbe.models.papers.yang.ballbar import measured_mm
from abbe.models.papers.yang.complete import delta_exact, monomial_errors, monomial_field
from abbe.models.papers.yang.conditioning import design_eq9
from abbe.models.papers.yang.experiments import BAR_POINTS, EXPERIMENTS, YangPlan, all_helices
from abbe.models.paths.helix import helix_points
from abbe.models.solvers.designs import map_noise_gain, shortest_solution
from abbe.models.volumetric import volume_grid
from abbe.service.errors import FileFormatError
from abbe.service.vectors.case import LAYOUT, VectorCase
from abbe.service.vectors.checks import Checks

RADII_MM = (175.0, 100.0)
"""Two bars at every origin (math.md 4.3). The file lists the runs of one bar; its figures use both, with the ball unmoved."""
INNER = (0.1, 0.9)
NODES = 4
"""Nodes per axis over the inner 80 % of the travels for the file's figures of the map (found by trial)."""
STEPS = 20
DEGREES = 4
"""Degrees of the noise gains: d1 to d4 in the file's key."""
UM = 1e3


def read(case: VectorCase, checks: Checks) -> None:
    """Readings, the two small fits, and the complete fit with the noise gains."""
    checks.assume(
        f"the figures of the fit are of two bars of {RADII_MM[0]:g} and {RADII_MM[1]:g} mm at every origin; runs are listed of one"
    )
    checks.assume(
        f"figures of the map are taken at {NODES} nodes per axis from {INNER[0]:.0%} to {INNER[1]:.0%} of the travels; "
        f"steps per diagonal: {STEPS}"
    )
    terms = tuple(_monomial(p) for p in case.at("monomials").parts())
    plan = _plan(case)
    _readings(case, checks, terms, plan)
    _small_fits(case, checks)
    _complete_fit(case, checks, terms, plan)
    _gains(case.at("result", "map_noise_gain_d1_to_d4"), checks, plan)
    why = "the draws of the noise are not in the file"
    checks.leave_out("worst error of the map with noise", case.at("result", "recovered_map_max_error_um_with_0.5um_noise"), why)


def _monomial(case: VectorCase) -> Monomial:
    kinds: dict[str, Kind] = {"d": "d", "e": "e", "S": "S"}
    kind, letters, power = case.text(0), case.text(1), case.number(2)
    if kind not in kinds or len(letters) != 2 or not set(letters) <= set("xyz") or power != int(power):
        raise FileFormatError(f"{case.label}: expected kind d, e or S, two of x y z, and a power", "")
    return Monomial(kinds[kind], "xyz".index(letters[0]), "xyz".index(letters[1]), int(power))


def _plan(case: VectorCase) -> YangPlan:
    degree = case.number("degree")
    if degree != int(degree):
        raise FileFormatError(f"{case.label}/degree: expected a whole number, got {degree!r}", "")
    origins = np.array([run.array("origin", shape=(3,)) for run in _cups(case)])
    return YangPlan(
        case.array("L", shape=(3,)), case.array("tool", shape=(3,)), origins, RADII_MM, case.number("turns"), STEPS, int(degree)
    )


def _cups(case: VectorCase) -> list[VectorCase]:
    """One run of every origin, in the order of the file."""
    found: dict[tuple[float, ...], VectorCase] = {}
    for run in case.at("runs").parts():
        found.setdefault(tuple(run.array("origin")), run)
    return list(found.values())


def _nodes(plan: YangPlan) -> F2:
    """Scale readings of the nodes for the file's figures of the map."""
    return volume_grid(np.outer(plan.travel_mm, INNER), NODES)


def _errors(case: VectorCase, terms: tuple[Monomial, ...], slide_mm: F2) -> YangErrors:
    return monomial_errors(terms, case.array("theta"), slide_mm, case.array("L"))


def _tip(case: VectorCase, terms: tuple[Monomial, ...], slide_mm: F2) -> F2:
    """Actual position of the tool tip relative to the workpiece for scale readings."""
    tool = case.array("tool")
    return np.asarray(workpiece_mm(slide_mm) + tool + delta_exact(_errors(case, terms, slide_mm), slide_mm, tool))


def _bar(case: VectorCase, terms: tuple[Monomial, ...], run: VectorCase, radius_mm: float) -> F1:
    points = helix_points(run.array("origin"), radius_mm, turns=case.number("turns"), n=BAR_POINTS)
    return measured_mm(_tip(case, terms, points), run.array("true_centre"), radius_mm, case.number("bar_offset"))


def _readings(case: VectorCase, checks: Checks, terms: tuple[Monomial, ...], plan: YangPlan) -> None:
    why = "difference of lengths of 175 mm between coordinates of 800 mm"
    for run in case.at("runs").parts():
        checks.compare("dR", _bar(case, terms, run, run.number("R")), run.at("dR"), unit="mm", floor=4e-13, rounding=why)
    worst = np.abs(delta_exact(_errors(case, terms, _nodes(plan)), _nodes(plan), plan.tool_mm)).max()
    part = case.at("result", "volumetric_max_um")
    checks.compare(
        "largest component of the map", worst * UM, part, unit="1", floor=3e-10, rounding="coordinates of 800 mm subtracted, in µm"
    )


def _small_fits(case: VectorCase, checks: Checks) -> None:
    run = case.at("runs", 0)
    points = helix_points(run.array("origin"), run.number("R"), turns=case.number("turns"), n=BAR_POINTS)
    last = "last digits of a least-squares solution"
    a, reading = design_eq9(points, run.array("origin")), run.array("dR")
    for count, key in ((6, "lsq6_run0_slide"), (9, "lsq9_run0_slide")):
        found = shortest_solution(a[:, :count], reading, 1.0 / np.linalg.norm(a[:, :count], axis=0))
        part = case.at(key)
        for k in range(count):
            if k < 6:
                checks.compare(f"{count} parameters of run 0", found[k], part.at(k), unit="rad", floor=1e-16, rounding=last)
            else:
                checks.compare("cup offset of run 0", found[k], part.at(k), unit="mm", floor=1e-14, rounding=last)


def _complete_fit(case: VectorCase, checks: Checks, terms: tuple[Monomial, ...], plan: YangPlan) -> None:
    """All coefficients, five cups and the bar's length in one linear step from the exact readings of both bars."""
    a, setup = all_helices(plan, centres=True, lengths="common")
    y = np.concatenate([_bar(case, terms, run, r) for run in _cups(case) for r in plan.radii_mm])
    x = np.concatenate([a, setup], axis=1)
    found = shortest_solution(x, y, 1.0 / np.maximum(np.linalg.norm(x, axis=0), 1e-30))
    result = case.at("result")
    rms = float(np.sqrt(np.mean((y - x @ found) ** 2)))
    noise = "readings of the vector are good to 1e-13 mm"
    checks.compare("residual of the complete fit", rms * UM, result.at("residual_rms_um"), unit="1", floor=4e-12, rounding=noise)
    length = found[a.shape[1]]
    checks.compare("bar length of the complete fit", length, result.at("radius_offset_est"), unit="mm", floor=1e-11, rounding=noise)
    true = delta_exact(_errors(case, terms, _nodes(plan)), _nodes(plan), plan.tool_mm)
    off = np.abs(monomial_field(terms, workpiece_mm(_nodes(plan)), plan.travel_mm, plan.tool_mm) @ found[: len(terms)] - true).max()
    part = result.at("recovered_map_max_error_um")
    checks.compare("largest error of the recovered map", off * UM, part, unit="1", floor=1e-8, rounding=noise + ", times a gain of 76")


def _gains(case: VectorCase, checks: Checks, plan: YangPlan) -> None:
    nodes = workpiece_mm(_nodes(plan))
    for key, part in case.items():
        if len(part.parts()) != DEGREES:
            raise FileFormatError(f"{part.label}: expected {DEGREES} degrees, got {len(part.parts())}", LAYOUT)
        code = key.split()[0]
        if code not in EXPERIMENTS:
            raise FileFormatError(f"{part.label}: experiment {code!r} is unknown", f"known: {', '.join(EXPERIMENTS)}")
        for k, value in enumerate(part.parts()):
            of_degree = replace(plan, degree=k + 1)
            gain = map_noise_gain(*EXPERIMENTS[code](of_degree), of_degree.field()(nodes)).max()
            checks.compare("noise gain of the map", gain, value, unit="1")
