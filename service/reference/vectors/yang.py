"""`yang_*.json`: complete model, helix, conditioning, ranks, and all 21 errors by ball bar."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.functions.monomials import Kind, Monomial, monomials
from abbe.models.geometry.chain import deviation_mm
from abbe.models.geometry.volume import volume_grid
from abbe.models.notation.yang import YangErrors, iso_motions, machine, workpiece_mm
from abbe.models.papers.yang.complete import delta_eq1, delta_exact, measured_mm, monomial_errors, monomial_field, reading_eq6, reading_eq8
from abbe.models.papers.yang.conditioning import (
    SixParameters,
    ZConvention,
    common_scale_trace_mm,
    conditioning,
    delta_eq2,
    design_eq9,
    fit_eq9,
    spread,
    two_radii_design,
)
from abbe.models.papers.yang.experiments import (
    BAR_POINTS,
    EXPERIMENTS,
    LATERAL_TOOL_MM,
    LONG_TOOL_MM,
    MAP_NODES,
    Experiment,
    Problem,
    YangPlan,
    all_helices,
    origin_plan,
)
from abbe.models.paths import Law, helix_points
from abbe.models.solvers.designs import hidden_combination, map_noise_gain, ranks, shortest_solution
from abbe.service.errors import FileFormatError
from abbe.service.reference.vector_checks import Checks
from abbe.service.reference.vector_file import LAYOUT, VectorCase

SUBTRACTED = "the vector subtracts coordinates of up to 1000 mm"
NAMES = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")
READINGS: dict[str, ZConvention] = {"paper": "workpiece", "workpiece": "workpiece", "physical": "slide", "slide": "slide"}
COORDINATES = "the parameter of 5 turns and coordinates of 600 mm, six units in the last place"
LAWS: dict[str, Law] = {"angle": "angle", "area": "area"}
RADII_MM = (175.0, 100.0)
POINTS = 63
TURNS = 5
"""The file has 63 points, a bar of 175 mm (the second of two bars has 100 mm), and 5 turns unless a key says otherwise."""
KINDS = ("six_angle_", "six_area_", "ten_", "corr9_", "two_radii")
TWO_BARS = tuple(f"centre_{c}_radius_{r}" for c in ("common", "separate") for r in ("common", "separate"))
ORIGIN = np.zeros(3)
PER_UM = 1e-3
"""A micrometre in mm: turns uncertainties per mm of reading noise into those per µm."""
INVERTED = "the file's numbers come from inverted normal equations with a condition number of up to 1900 squared"
DETERMINED = "last digits of a least-squares solution"
DECIMALS = 4
"""Decimals with which the file states combinations of parameters; the computed combinations, rounded alike, must be equal."""
NO_TRACE = 1e-9
INNER = (0.1, 0.9)
NODES = 4
"""Nodes per axis, over the inner 80 % of the travels, for the numbers about the map in the file (found by trial)."""
STEPS = 20
DEGREES = 4
"""The file states noise gains for the degrees 1 to 4, under the keys d1 to d4."""
UM = 1e3


def read_volumetric(case: VectorCase, checks: Checks) -> None:
    """Compare every case of the file with the three forms of the model."""
    for part in case.at("cases").parts():
        errors = errors_of(part)
        slide, tool = part.array("xyz_slide", shape=(3,))[None], part.array("T_plus_L", shape=(3,))
        form = machine(np.array([[0.0, 1.0]] * 3), tool)
        first = part.at("delta_eq1")
        checks.compare("delta, eq (1) as printed", delta_eq1(errors, slide, tool)[0], first, unit="mm", floor=1e-16, relative=1e-14)
        by_chain = deviation_mm(form, workpiece_mm(slide), iso_motions(errors, slide))[0]
        checks.compare("delta, by the kinematic chain", by_chain, first, unit="mm", floor=1e-16, relative=1e-14)
        exact = delta_exact(errors, slide, tool)[0]
        checks.compare("delta, full rotations", exact, part.at("delta_exact_rot"), unit="mm", floor=3e-13, rounding=SUBTRACTED)
        matrix = delta_exact(errors, slide, tool, small_angles=True)[0]
        checks.compare("delta, paper's matrices", matrix, part.at("delta_paper_matrix"), unit="mm", floor=3e-13, rounding=SUBTRACTED)


def errors_of(part: VectorCase) -> YangErrors:
    """Return the 21 errors of one case: d["xy"] = delta_xy, e["zx"] = eps_zx, Sxy, Sxz, Syz."""
    d = np.array([[[part.number("d", i + j) for j in "xyz"] for i in "xyz"]])
    e = np.array([[[part.number("e", i + j) for j in "xyz"] for i in "xyz"]])
    return YangErrors(d, e, part.number("Sxy"), part.number("Sxz"), part.number("Syz"))


def read_helix(case: VectorCase, checks: Checks) -> None:
    """Compare points, exact and linear readings, and both fits of every set with those of the file."""
    truth = SixParameters(*(case.number("truth", k) for k in NAMES))
    origin, turns = case.array("origin", shape=(3,)), case.number("turns")
    spacing = case.text("spacing")
    if spacing not in LAWS:
        raise FileFormatError(f"{case.label}: spacing {spacing!r} is unknown", "use angle or area")
    for part in case.at("sets").parts():
        name = part.text("z_reading")
        if name not in READINGS:
            raise FileFormatError(f"{part.label}: z_reading {name!r} is unknown", f"use one of {', '.join(READINGS)}")
        radius, n = part.number("R"), len(part.at("points").parts())
        points = helix_points(origin, radius, turns=turns, n=n, law=LAWS[spacing])
        checks.compare("points", points, part.at("points"), unit="mm", floor=7e-13, relative=0.0, rounding=COORDINATES)
        _helix_readings(part, checks, truth, points, origin)


def _helix_readings(part: VectorCase, checks: Checks, truth: SixParameters, points: F2, origin: F1) -> None:
    """Compare the exact and the linear readings of one set, and the fits of eq (9) to the exact readings."""
    reading, radius = READINGS[part.text("z_reading")], part.number("R")
    d = points - origin
    nominal = d if reading == "workpiece" else workpiece_mm(d)
    error = delta_eq2(truth, points) - delta_eq2(truth, origin[None])
    exact, rounding = reading_eq6(nominal, error), "difference of two lengths of up to 175 mm"
    checks.compare("dR, eq (6)", exact, part.at("dR_nonlinear"), unit="mm", floor=1.2e-13, rounding=rounding)
    checks.compare("dR, eq (8)", reading_eq8(nominal, error), part.at("dR_linear"), unit="mm")
    fits: tuple[tuple[str, ZConvention], ...] = (("lsq_own_reading", reading), ("lsq_printed_eq9", "workpiece"))
    for key, convention in fits:
        fit = fit_eq9(points, origin, exact, radius, z_convention=convention).parameters.array()
        for k, name in enumerate(NAMES):
            checks.compare(key, fit[k], part.at(key, name), unit="rad", floor=1e-15, rounding="rounding of dR over the radius")


def read_conditioning(case: VectorCase, checks: Checks) -> None:
    """Compare the numbers of every key with computed ones.

    Each kind of key must occur: ``six_<law>_<turns>``, ``ten_<turns>``, ``corr9_<turns>turns``, ``two_radii``.
    """
    for kind in KINDS:
        if not any(key.startswith(kind) for key, _ in case.items()):
            raise FileFormatError(f"{case.label}: there is no key {kind}...", LAYOUT)
    checks.assume(f"a single bar has {RADII_MM[0]:g} mm; two bars have {RADII_MM[0]:g} and {RADII_MM[1]:g} mm and {TURNS} turns")
    for key, part in case.items():
        if six := re.fullmatch(r"six_(angle|area)_(\d+)", key):
            _six(part, checks, _points("angle" if six[1] == "angle" else "area", int(six[2])))
        elif ten := re.fullmatch(r"ten_(\d+)", key):
            _ten(part, checks, design_eq9(_points("angle", int(ten[1])), ORIGIN))
        elif corr := re.fullmatch(r"corr9_(\d+)turns", key):
            found = spread(design_eq9(_points("angle", int(corr[1])), ORIGIN)[:, :9]).correlation
            checks.compare("correlation, nine", found, part, unit="1", floor=1e-14, rounding=DETERMINED)
        elif key == "two_radii":
            _two(part, checks)
        elif key != "assumptions":
            raise FileFormatError(f"{part.label}: unknown key", f"known: {', '.join(KINDS)}")


def _points(law: Law, turns: int, radius_mm: float = RADII_MM[0]) -> F2:
    return helix_points(ORIGIN, radius_mm, turns=turns, n=POINTS, law=law)


def _six(part: VectorCase, checks: Checks, points: F2) -> None:
    a = design_eq9(points, ORIGIN, setup=False)
    found, sigma = conditioning(a), spread(a)
    checks.compare("rank, six unknowns", found.rank, part.at("rank"), unit="1")
    checks.compare("condition, six unknowns", found.condition, part.at("cond"), unit="1")
    checks.compare("singular values, six unknowns", found.singular_values, part.at("sv"), unit="1")
    checks.compare("largest correlation, six unknowns", sigma.largest_correlation, part.at("max_corr"), unit="1")
    checks.compare("sigma per µm, six unknowns", sigma.sigma_per_mm * PER_UM, part.at("sigma_factor_per_um"), unit="1", floor=1e-20)


def _ten(part: VectorCase, checks: Checks, a: F2) -> None:
    nine = conditioning(a[:, :9])
    checks.compare("rank, ten unknowns", conditioning(a).rank, part.at("rank10"), unit="1")
    checks.compare("rank, nine unknowns", nine.rank, part.at("rank9"), unit="1")
    checks.compare("condition, nine unknowns", nine.condition, part.at("cond9"), unit="1")
    sigma = spread(a[:, :9]).sigma_per_mm * PER_UM
    checks.compare("sigma per µm, nine unknowns", sigma, part.at("sigma9_per_um"), unit="1", floor=1e-20, relative=1e-9, rounding=INVERTED)
    trace = common_scale_trace_mm(a, RADII_MM[0])
    checks.compare(
        "trace of the common scale", trace, part.at("null_residual"), unit="mm", floor=3e-13, rounding="0 but for rounding at 175 mm"
    )


def _two(case: VectorCase, checks: Checks) -> None:
    points = tuple(_points("angle", TURNS, r) for r in RADII_MM)
    for key, part in case.named(*TWO_BARS):
        _, centre, _, radius = key.split("_")
        a = two_radii_design(points, ORIGIN, centre_separate=centre == "separate", radius_separate=radius == "separate")
        found = conditioning(a)
        checks.compare("unknowns, two bars", a.shape[1], part.at("unknowns"), unit="1")
        checks.compare("rank, two bars", found.rank, part.at("rank"), unit="1")
        checks.compare("condition, two bars", found.condition, part.at("cond"), unit="1")


def read_ranks(case: VectorCase, checks: Checks) -> None:
    """Compare origins and coefficients of the plan, ranks of every experiment and degree, and null vectors with those of the file."""
    assumed = case.at("assumed")
    plans = [plan_of(assumed, d + 1) for d in range(len(case.at("N").parts()))]
    stroke = np.stack([np.zeros(3), plans[0].travel_mm], axis=1)
    checks.compare("origins of the plan", origin_plan(stroke), assumed.at("origins"), unit="mm", floor=1e-13, rounding="last digit")
    checks.compare("number of coefficients", [len(monomials(p.degree)) for p in plans], case.at("N"), unit="1")
    checks.assume(f"a whole vector map has {MAP_NODES} nodes per axis; the tools of e2 and e3 are {LONG_TOOL_MM} and {LATERAL_TOOL_MM} mm")
    hidden = list(case.at("null_space_degree1").named(*case.at("ranks").keys()))
    for key, part in case.at("ranks").items():
        if len(part.parts()) != len(plans):
            raise FileFormatError(f"{part.label}: expected {len(plans)} polynomial degrees as in N, got {len(part.parts())}", LAYOUT)
        found = [ranks(*experiment(part, key)(plan)) for plan in plans]
        checks.compare("rank and effective rank", found, part, unit="1")
    for key, part in hidden:
        problem = experiment(part, key)(plans[0])
        sees_all = case.number("ranks", key, 0, 0) == case.number("N", 0)
        for vector in part.parts(or_none=sees_all):
            _null_vector(vector, checks, problem)


def plan_of(case: VectorCase, degree: int) -> YangPlan:
    """Return the file's assumptions as a plan."""
    radii = tuple(float(r) for r in case.array("radii"))
    origins, turns, steps = case.array("origins", shape=(None, 3)), case.number("turns"), case.whole("steps")
    return YangPlan(case.array("L", shape=(3,)), case.array("tool", shape=(3,)), origins, radii, turns, steps, degree)


def experiment(case: VectorCase, key: str) -> Experiment:
    """Return the experiment of a key such as ``c1 helix(1)+step diagonals, ideal mirror`` by its first word."""
    code = key.split()[0]
    if code not in EXPERIMENTS:
        raise FileFormatError(f"{case.label}: experiment {code!r} is unknown", f"known: {', '.join(EXPERIMENTS)}")
    return EXPERIMENTS[code]


def _null_vector(case: VectorCase, checks: Checks, problem: Problem) -> None:
    """Compare the ratios of the named parameters up to a common sign, and check that their combination is unobservable."""
    names = [t.name for t in monomials(1)]
    stored = dict(case.items())
    if unknown := [name for name in stored if name not in names]:
        raise FileFormatError(f"{case.label}: unknown parameters {', '.join(unknown)}", f"known: {', '.join(names)}")
    parts = list(stored.values())
    weights, trace = hidden_combination(*problem, [names.index(k) for k in stored])
    # The sign of a null vector is arbitrary; take that of the file.
    sign = -1.0 if sum(w * part.number() for w, part in zip(weights, parts, strict=True)) < 0 else 1.0
    for w, part in zip(weights, parts, strict=True):
        value = np.round(sign * w, DECIMALS) if trace < NO_TRACE else np.nan
        checks.compare("null vectors, degree 1", value, part, unit="1", rounding="both rounded to four decimals")


def read_ballbar(case: VectorCase, checks: Checks) -> None:
    """Compare readings, the two small fits, and the complete fit with the noise gains."""
    checks.assume(
        f"the complete fit uses bars of {RADII_MM[0]:g} and {RADII_MM[1]:g} mm at every origin, although the file lists runs of one bar"
    )
    checks.assume(
        f"numbers about the map hold for {NODES} nodes per axis from {INNER[0]:.0%} to {INNER[1]:.0%} of the travels, and for {STEPS} "
        "steps per diagonal"
    )
    terms = tuple(_monomial(p) for p in case.at("monomials").parts())
    plan = _plan(case)
    _readings(case, checks, terms, plan)
    _small_fits(case, checks)
    _complete_fit(case, checks, terms, plan)
    _gains(case.at("result", "map_noise_gain_d1_to_d4"), checks, plan)
    why = "the file does not contain the noise"
    checks.leave_out("worst error of the map with noise", case.at("result", "recovered_map_max_error_um_with_0.5um_noise"), why)


def _monomial(case: VectorCase) -> Monomial:
    kinds: dict[str, Kind] = {"d": "d", "e": "e", "S": "S"}
    kind, letters, power = case.text(0), case.text(1), case.number(2)
    if kind not in kinds or len(letters) != 2 or not set(letters) <= set("xyz") or power != int(power):
        raise FileFormatError(f"{case.label}: expected kind d, e or S, two of x y z, and a power", LAYOUT)
    return Monomial(kinds[kind], "xyz".index(letters[0]), "xyz".index(letters[1]), int(power))


def _plan(case: VectorCase) -> YangPlan:
    origins = np.array([run.array("origin", shape=(3,)) for run in _cups(case)])
    turns, degree = case.number("turns"), case.whole("degree")
    return YangPlan(case.array("L", shape=(3,)), case.array("tool", shape=(3,)), origins, RADII_MM, turns, STEPS, degree)


def _cups(case: VectorCase) -> list[VectorCase]:
    """Return the first run of every origin, in the order of the file."""
    found: dict[tuple[float, ...], VectorCase] = {}
    for run in case.at("runs").parts():
        found.setdefault(tuple(run.array("origin")), run)
    return list(found.values())


def _nodes(plan: YangPlan) -> F2:
    """Return the nodes, as scale readings, at which the file's numbers about the map hold."""
    return volume_grid(np.outer(plan.travel_mm, INNER), NODES)


def _errors(case: VectorCase, terms: tuple[Monomial, ...], slide_mm: F2) -> YangErrors:
    return monomial_errors(terms, case.array("theta"), slide_mm, case.array("L"))


def _tip(case: VectorCase, terms: tuple[Monomial, ...], slide_mm: F2) -> F2:
    """Return the actual position of the tool tip relative to the workpiece for scale readings."""
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
    """Compare the linear fit of all coefficients, five cup offsets and the bar length to the exact readings of both bars."""
    a, setup = all_helices(plan, centres=True, lengths="common")
    y = np.concatenate([_bar(case, terms, run, r) for run in _cups(case) for r in plan.radii_mm])
    x = np.concatenate([a, setup], axis=1)
    found = shortest_solution(x, y, 1.0 / np.maximum(np.linalg.norm(x, axis=0), 1e-30))
    result = case.at("result")
    rms = float(np.sqrt(np.mean((y - x @ found) ** 2)))
    noise = "the readings in the file are accurate to 1e-13 mm"
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
            raise FileFormatError(f"{part.label}: expected {DEGREES} polynomial degrees, got {len(part.parts())}", LAYOUT)
        for k, value in enumerate(part.parts()):
            of_degree = replace(plan, degree=k + 1)
            gain = map_noise_gain(*experiment(part, key)(of_degree), of_degree.field()(nodes)).max()
            checks.compare("noise gain of the map", gain, value, unit="1")
