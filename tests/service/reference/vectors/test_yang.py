"""Yang's vectors through `abbe vectors`' readers and through the production solvers."""

import json

import numpy as np
import pytest

from abbe.models.paths import helix_points
from abbe.models.solvers.helix import fit_helix, helix_design
from abbe.models.solvers.least_squares import analyse
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import load, missed, read

FILES = ("yang_volumetric", "yang_helix", "yang_conditioning", "yang_ranks", "yang_ballbar_complete")
NAMES = ("dxx", "dyy", "dzz", "Sxy", "Sxz", "Syz")


@pytest.mark.parametrize("name", FILES)
def test_every_number_of_the_file_is_used_and_agrees(shared, name):
    checks = check_file(shared / "vectors" / f"{name}.json")
    assert checks.ok, [f for q in checks.quantities.values() for f in q.failures] + checks.unread
    assert sum(n.numbers for n in checks.not_computable) == (1 if name == "yang_ballbar_complete" else 0)  # one draw of noise
    counts = {q.name: q.values for q in checks.quantities.values()}
    if name == "yang_ranks":
        assert counts["rank and effective rank"] == 15 * 5 * 2
        assert counts["null vectors, degree 1"] == 70


@pytest.mark.parametrize("name", ["yang_volumetric", "yang_helix", "yang_conditioning"])
def test_an_altered_eighth_digit_of_an_output_is_found(shared, name):
    outputs = ("delta_eq1", "delta_exact_rot", "delta_paper_matrix", "dR_nonlinear", "dR_linear", "lsq_own_reading", "lsq_printed_eq9")
    outputs += ("sv", "cond", "max_corr", "sigma_factor_per_um", "sigma9_per_um", "cond9", "corr9_5turns", "rank", "truth", "origin")
    assert not missed(shared, name, lambda path: any(k in outputs for k in path), count=25, seed=3)


def test_an_altered_eighth_digit_is_found_in_the_slow_files_too(shared):
    assert not missed(shared, "yang_ballbar_complete", lambda path: path[0] in ("runs", "lsq9_run0_slide", "result"), count=2, seed=5)


def test_a_null_vector_may_point_either_way_but_not_both(shared):
    """A held-out file states some of its null vectors with the other sign: that is the same direction."""
    key = "a1 one helix R175, no setup unknowns"
    doc = load(shared, "yang_ranks")
    vectors = doc["null_space_degree1"][key]
    doc["null_space_degree1"][key] = [{name: -weight for name, weight in vector.items()} for vector in vectors]
    assert read("yang_ranks", doc).ok
    doc["null_space_degree1"][key][0] = vectors[0] | {name: -weight for name, weight in list(vectors[0].items())[:1]}
    assert not read("yang_ranks", doc).ok


def test_an_unaltered_file_passes_the_same_road(shared):
    assert read("yang_helix", load(shared, "yang_helix")).ok


def test_helix_in_the_solver_of_the_product_returns_the_six_parameters(shared):
    v = json.loads((shared / "vectors" / "yang_helix.json").read_text())
    truth = np.array([v["truth"][k] for k in NAMES])
    origin = np.array(v["origin"])
    for s in v["sets"]:
        points = np.array(s["points"])  # z is read as a workpiece coordinate here ("paper" reading)
        assert s["z_reading"] == "paper"
        signs = np.array([1, 1, -1, 1, -1, 1])  # the slide's dzz is -EZZ, Sxz is -B0Z (math.md 1)
        fit = fit_helix(points, np.array(s["dR_nonlinear"]), origin, s["R"], sigma_mm=1e-6, unknowns="six")
        assert np.abs(fit.estimate.theta * signs - truth).max() < 0.02e-6
        assert fit.estimate.theta * signs == pytest.approx([s["lsq_own_reading"][k] for k in NAMES], abs=1e-12)


def test_conditioning_of_the_solver_of_the_product(shared):
    v = json.loads((shared / "vectors" / "yang_conditioning.json").read_text())
    for turns in (1, 5):
        p = helix_points(np.zeros(3), 175.0, turns=turns, n=63)
        a = helix_design(p, np.zeros(3), "nine")
        s = np.linalg.svd(a / np.linalg.norm(a, axis=0), compute_uv=False)
        assert s[0] / s[-1] == pytest.approx(v[f"ten_{turns}"]["cond9"], rel=1e-9)


def test_ten_unknowns_of_one_helix_have_rank_nine_and_the_scale_is_named():
    p = helix_points(np.zeros(3), 175.0, turns=5, n=63)
    names = ("EXX.1", "EYY.1", "EZZ.1", "C0Y", "B0Z", "A0Z", "offset_x", "offset_y", "offset_z", "bar_length")
    found = analyse(names, helix_design(p, np.zeros(3), "ten"))
    assert found.rank == 9
    assert len(found.hidden) == 1
    assert {n for n, _ in found.hidden[0].weights} == {"EXX.1", "EYY.1", "EZZ.1", "bar_length"}
