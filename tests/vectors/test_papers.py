"""The independent vectors of the papers (shared/vectors), through the public functions."""

import json
from pathlib import Path

import numpy as np
import pytest

from models.geometry.bases import smooth_terms
from models.geometry.chain import travel_sign
from models.machine import Machine
from models.paths.helix import helix_points
from models.paths.lines import DIAGONALS, diagonal_ends, step_diagonal, straight_line
from models.solvers.helix import fit_helix, helix_design
from models.solvers.identifiability import analyse, project_out
from models.solvers.joint import run_design, setup_unknowns
from models.solvers.observations import RunData
from models.solvers.priors import Priors
from models.solvers.step_diagonal import closure_mm, increments, squareness_contrast, u_wang_four, wang_eq7, wang_four


def load(shared: Path, name: str) -> dict:
    return json.loads((shared / "vectors" / name).read_text())


NAMES = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")


def test_yang_helix_six_parameters_come_back_to_002_urad(shared):
    v = load(shared, "yang_helix.json")
    truth = np.array([v["truth"][k] for k in NAMES])
    origin = np.array(v["origin"])
    for s in v["sets"]:
        points = np.array(s["points"])  # z is read as a workpiece coordinate here ("paper" reading)
        assert s["z_reading"] == "paper"
        signs = np.array([1, 1, -1, 1, -1, 1])  # the slide's dzz is -EZZ, Sxz is -B0Z (math.md 1)
        fit = fit_helix(points, np.array(s["dR_nonlinear"]), origin, s["R"], sigma_mm=1e-6, unknowns="six")
        assert np.abs(fit.estimate.theta * signs - truth).max() < 0.02e-6
        assert fit.estimate.theta * signs == pytest.approx([s["lsq_own_reading"][k] for k in NAMES], abs=1e-12)


def test_conditioning_of_the_six_parameter_fit(shared):
    v = load(shared, "yang_conditioning.json")
    for law in ("angle", "area"):
        for turns in (1, 2, 3, 5, 8, 10):
            p = helix_points(np.zeros(3), 175.0, turns=turns, n=63, law=law)
            a = helix_design(p, np.zeros(3), "six")
            ref = v[f"six_{law}_{turns}"]
            unit = a / np.linalg.norm(a, axis=0)
            s = np.linalg.svd(unit, compute_uv=False)
            assert s[0] / s[-1] == pytest.approx(ref["cond"], rel=1e-9)
            sigma = np.sqrt(np.diag(np.linalg.inv(a.T @ a))) * 1e-3
            assert sigma == pytest.approx(ref["sigma_factor_per_um"], rel=1e-9)


def test_ten_unknowns_of_one_helix_have_rank_nine_and_the_scale_is_named():
    p = helix_points(np.zeros(3), 175.0, turns=5, n=63)
    names = ("EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z", "offset_x", "offset_y", "offset_z", "bar_length")
    found = analyse(names, helix_design(p, np.zeros(3), "ten"))
    assert found.rank == 9
    assert len(found.hidden) == 1
    assert {n for n, _ in found.hidden[0].weights} == {"EXX.1", "EYY.1", "EZZ.1", "bar_length"}


def test_ten_micrometres_of_mounting_fake_a_hundred_microradians_in_the_papers_fit_only():
    p = helix_points(np.zeros(3), 175.0, turns=5, n=63)
    offset = np.array([0.010, 0.0, 0.0])
    reading = np.linalg.norm(p - offset, axis=1) - 175.0
    paper = fit_helix(p, reading, np.zeros(3), 175.0, sigma_mm=5e-4, unknowns="six").estimate
    ours = fit_helix(p, reading, np.zeros(3), 175.0, sigma_mm=5e-4, unknowns="ten").estimate
    assert abs(paper.value("C0Y")) == pytest.approx(97e-6, rel=0.05)
    assert abs(ours.value("C0Y")) < 2 * ours.u("C0Y")
    assert ours.value("offset_x") == pytest.approx(0.010, abs=2 * ours.u("offset_x"))


@pytest.mark.parametrize("case", ["translational|none", "translational|tilt_0.5mrad", "with_angles|none", "pure_yaw_X_50urad_linear|none"])
def test_wang_step_diagonal(shared, case):
    v = load(shared, "wang_step_diagonal.json")
    c = v["cases"][case]
    inc = np.array(v["inc"])
    q = increments({k: np.array(r) for k, r in c["readings"].items()})
    for name, ref in c["q"].items():
        assert q[name] == pytest.approx(np.array(ref), abs=1e-11)
    for formula, key in ((wang_eq7, "wang_eq7"), (wang_four, "wang_lsq4")):
        found = formula(q, inc)
        for name, ref in c[key].items():  # "YX" = direction Y, axis X
            i, a = "XYZ".index(name[0]), "XYZ".index(name[1])
            assert found[i, a] == pytest.approx(ref, abs=1e-11)
    assert np.abs(closure_mm(q)).max() == pytest.approx(c["closure_max"], abs=1e-11)


def test_squareness_contrasts_are_free_of_scale_errors(shared):
    s = load(shared, "wang_step_diagonal.json")["squareness"]
    found = squareness_contrast(s["dR_total"], np.array(s["L"]), 1e-4)
    assert found.theta_xy == pytest.approx(s["theta_obtuse"]["txy"], abs=1e-12)
    assert found.theta_xz == pytest.approx(s["theta_obtuse"]["txz"], abs=1e-12)
    assert found.theta_yz == pytest.approx(s["theta_obtuse"]["tyz"], abs=1e-12)


def test_what_the_linear_model_cannot_follow_widens_its_uncertainty_but_not_the_prior():
    p = helix_points(np.zeros(3), 175.0, turns=5, n=600)
    true = np.zeros((600, 3))
    true[:, 1] = 4e-3 * np.sin(2 * np.pi * p[:, 0] / 120.0 + 0.7)  # EYX, two waves within the helix
    rng = np.random.default_rng(3)
    reading = np.linalg.norm(p + true, axis=1) - 175.0 + rng.normal(0, 5e-4, 600)
    fit = fit_helix(p, reading, np.zeros(3), 175.0, sigma_mm=5e-4).estimate
    white = fit_helix(p, rng.normal(0, 5e-4, 600), np.zeros(3), 175.0, sigma_mm=5e-4).estimate
    assert fit.u("C0Y") > 3 * white.u("C0Y")
    assert abs(fit.value("C0Y")) < 3 * fit.u("C0Y")
    assert fit.u("bar_length") == pytest.approx(0.0015, rel=0.01)


FXYZ = Machine("w-b-X-Y-Z-t", np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 400.0]]))
"""Bed, X, Y, Z towards the tool: chain of math.md 5.5, tool 0."""


def laser(label: str, p: np.ndarray) -> RunData:
    n, beam = len(p), (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
    return RunData(label, label, "laser", p, np.zeros(n), travel_sign(p), np.arange(n) * 1.0, np.ones(n), beam=beam)


def diagonals(orders: tuple[str, ...]) -> list[RunData]:
    ends = {d: diagonal_ends(FXYZ.stroke_mm, d) for d in DIAGONALS}
    return [laser(f"{d}{o}", step_diagonal(*ends[d], 10, o, back=False)) for o in orders for d in DIAGONALS]


def edges(sides: tuple[int, ...], axes: str = "XYZ") -> list[RunData]:
    out = []
    for side in sides:
        for letter in axes:
            a = "XYZ".index(letter)
            start = FXYZ.stroke_mm[:, side].copy()
            end = start.copy()
            start[a], end[a] = FXYZ.stroke_mm[a]
            out.append(laser(f"{letter}{side}", straight_line(start, end, 11, back=False)))
    return out


@pytest.mark.parametrize(
    ("experiment", "runs", "tilts"),
    [
        ("ideal mirror", diagonals(("XYZ",)), False),
        ("8 tilt unknowns", diagonals(("XYZ",)), True),
        ("8 tilt + linear laser X", diagonals(("XYZ",)) + edges((0,), "X"), True),
        ("8 tilt + linear laser X,Y", diagonals(("XYZ",)) + edges((0,), "XY"), True),
        ("8 tilt + linear laser X,Y,Z", diagonals(("XYZ",)) + edges((0,)), True),
        ("two orders XYZ,ZYX, 16 tilt", diagonals(("XYZ", "ZYX")), True),
        ("two orders + linear X,Y,Z, 16 tilt", diagonals(("XYZ", "ZYX")) + edges((0,)), True),
        ("two orders + linear XYZ on 2 edges, 16 tilt", diagonals(("XYZ", "ZYX")) + edges((0, 1)), True),
    ],
)
def test_ranks_of_laser_experiments_are_those_of_the_independent_table(shared, experiment, runs, tilts):
    reference = load(shared, "wang_step_diagonal.json")["ranks"][experiment]
    setup = setup_unknowns(tuple(runs), Priors())
    for degree in (1, 2, 3):
        terms = smooth_terms(degree)
        a = np.concatenate([run_design(FXYZ, terms, r, setup) for r in runs])
        first = len(terms) + 3
        nuisance = [
            first + k for k, n in enumerate(setup.names) if tilts and n.startswith("tilt_")
        ]  # the table knows neither zero nor drift
        found = analyse(tuple(t.name for t in terms), project_out(a[:, : len(terms)], a[:, nuisance]))
        assert found.rank == reference[degree - 1][0]


def test_stated_noise_of_the_nine_curves_is_the_scatter_of_repeats():
    rng = np.random.default_rng(11)
    inc, n, sigma = np.array([80.0, 50.0, 40.0]), 10, 3e-4
    curves = [wang_four(increments({d: rng.normal(0, sigma, 3 * n + 1) for d in DIAGONALS}), inc) for _ in range(1500)]
    stated = u_wang_four(inc, n, sigma)
    assert np.std(curves, axis=0)[:, :, 1:] == pytest.approx(stated[:, :, 1:], rel=0.1)
    assert (stated[:, :, 0] == 0.0).all()
    with_scale = u_wang_four(inc, n, sigma, 1e-6)
    assert with_scale[0, 0, -1] == pytest.approx(np.hypot(stated[0, 0, -1], 8e-4))
    assert with_scale[0, 1, -1] == stated[0, 1, -1]
