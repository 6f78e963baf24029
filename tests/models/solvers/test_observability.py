"""The report against simulation: hidden is hidden, stated uncertainties and gains are those of repeated fits, more runs tell no less."""

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import all_chains, design, travel_sign
from abbe.models.geometry.volume import remove_rigid, volume_grid
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.assessment import observability, observability_of, posterior_covariance
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observability.rank import (
    campaign_columns,
    compressed,
    correlations,
    observable_motions,
    stated_knowledge,
    status_of,
    with_knowledge,
)
from abbe.models.solvers.observability.volume import inner_box
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import predict, setup_unknowns
from abbe.models.solvers.priors import Priors, size_model
from tests.models.solvers.observability_cases import ONE, YANG, laser
from tests.models.solvers.truth import FLOOR, MACHINE, SIGMA, Truth

LONG = np.array([0.0, 0.0, -240.0])
BOX = np.array([[0.0, 500.0], [0.0, 400.0], [0.0, 300.0]])


def bar(label, centre, radius, tool=None, **stated):
    path = helix_points(np.array(centre), radius, turns=4, n=90, law="area", axis=2)
    n = len(path)
    rest = (np.zeros(n), travel_sign(path), np.arange(n) * 0.1, np.ones(n), np.array(centre), radius)
    return RunData(label, label, "bar", path, *rest, tool_mm=tool, **stated)


def piece(name):
    """One measurement of the pool from which campaigns are drawn."""
    if name in DIAGONALS:
        return laser(name, step_diagonal(*diagonal_ends(BOX + np.array([20.0, -20.0]), name), 9))
    if name in ("X", "Y", "Z"):
        a = "XYZ".index(name)
        ends = np.full((2, 3), 40.0)
        ends[1, a] = 260.0
        return laser(name, straight_line(*ends, 12))
    centres = {"h1": (250, 200, 100), "h2": (150, 150, 60), "h3": (350, 250, 90), "calibrated": (250, 200, 100), "long": (250, 200, 150)}
    stated = {"u_length_mm": 1e-3, "length_calibrated": True} if name == "calibrated" else {}
    radius = 120.0 if name == "calibrated" else 100.0
    return bar(name, centres[name], radius, LONG if name == "long" else None, **stated)


POOL = ("h1", "h2", "h3", "calibrated", "long", "X", "Y", "Z", *DIAGONALS)


@settings(max_examples=30 if os.environ.get("ABBE_TEST_LONG") == "1" else 10, deadline=None)
@given(
    chain=st.sampled_from(all_chains()),
    names=st.sets(st.sampled_from(POOL), min_size=1, max_size=6),
    degree=st.integers(1, 3),
    seed=st.integers(0, 10**6),
)
def test_adding_a_hidden_combination_changes_no_reading_and_no_table(chain, names, degree, seed):
    rng = np.random.default_rng(seed)
    machine = Machine(chain, BOX, rng.uniform(-200, 200, (3, 3)), np.array([0.0, 0.0, -120.0]))
    runs = tuple(piece(n) for n in sorted(names))
    report = observability(machine, runs, terms=degree)
    terms, setup = report.terms, setup_unknowns(runs, Priors())
    assert report.rank + sum(g.count for g in report.hidden) == len(terms)
    written = observable_motions(report.motions, weak=True)
    free = free_columns(machine, terms, runs, setup)
    for group in report.hidden:
        for v in group.vectors.T:
            v = v / np.linalg.norm(v / np.array([20e-6 if t.component > 2 or not t.order else 5e-3 for t in terms]))
            assert not any(c for c, t in zip(v, terms, strict=True) if t.motion in written)
            theta = with_answer(machine, terms, runs, setup, free, v)
            change = [predict(machine, terms, r, setup, theta) - predict(machine, terms, r, setup, 0.0 * theta) for r in runs]
            assert np.abs(np.concatenate(change)).max() < 1e-5  # mm; what is left is second order


def free_columns(machine, terms, runs, setup):
    columns = campaign_columns(machine, terms, runs, setup)
    known = stated_knowledge(terms, runs, setup.names)
    _, free, groups = with_knowledge(columns, known)
    return columns.machine, free, [g[0] for g in groups]


def with_answer(machine, terms, runs, setup, free, v):
    """All unknowns for machine errors ``v`` together with the set-up errors that hide them."""
    a, n, names = free
    s = np.linalg.lstsq(n, -a @ v, rcond=1e-13)[0]
    every = [f"backlash_{x}" for x in "XYZ"] + list(setup.names)
    theta = np.zeros(len(terms) + len(every))
    theta[: len(terms)] = v
    theta[[len(terms) + every.index(name) for name in names]] = s
    return theta


# --- uncertainties and gains against simulation ------------------------------------------------------------------------------------------


@cache
def linear_campaign():
    """A one-tool campaign with order 3, its estimator and its report."""
    runs = tuple(piece(n) for n in ("h1", "h2", "h3", "calibrated", "X", "Y", "ppp", "npp"))
    machine = Machine("w-X-Y-b-Z-t", BOX, np.zeros((3, 3)), np.array([0.0, 0.0, -120.0]))
    terms, setup = smooth_terms(3), setup_unknowns(runs, Priors())
    sigma = {"bar": 0.5e-3, "laser": 0.3e-3}
    report = observability(machine, runs, terms=3, sigma_mm=sigma, floor_mm={"bar": 0.0, "laser": 0.0})
    c = campaign_columns(machine, terms, runs, setup)
    a = np.concatenate([c.machine, c.lost, c.setup], axis=1)
    u = np.concatenate([np.full(r.deviation_mm.size, sigma[r.kind]) for r in runs])
    rest = tuple(f"backlash_{x}" for x in "XYZ") + setup.names
    sizes = size_model(machine, terms, rest, np.concatenate([np.full(3, Priors().backlash_mm), setup.prior_sd]), Priors())
    root = sizes.typical[:, None] * sizes.root
    stacked = np.concatenate([a @ root / u[:, None], np.eye(len(root))])
    estimator = root @ np.linalg.pinv(stacked)[:, : len(u)] / u
    return machine, terms, report, a, u, root, estimator


def test_stated_uncertainty_and_typical_size_are_those_of_simulated_machines():
    machine, terms, report, a, u, root, estimator = linear_campaign()
    rng = np.random.default_rng(5)
    inner = volume_grid(inner_box(machine), 7)
    field = design(machine, terms, inner)
    before, after = np.zeros(len(inner)), np.zeros(len(inner))
    draws = 400
    for _ in range(draws):
        truth = root @ rng.normal(size=len(root))
        found = estimator @ (a @ truth + rng.normal(size=len(u)) * u)
        before += (remove_rigid(inner, field @ truth[: len(terms)]) ** 2).sum(axis=1) / draws
        after += (remove_rigid(inner, field @ (found - truth)[: len(terms)]) ** 2).sum(axis=1) / draws
    stated = report.at(inner)
    assert stated.inner.all()
    assert np.sqrt(before) == pytest.approx(stated.prior_mm, rel=0.15)
    assert np.sqrt(after) == pytest.approx(stated.u_mm, rel=0.15)
    assert (stated.worst_mm <= stated.u_mm * (1 + 1e-9)).all()
    assert (stated.u_mm <= np.sqrt(3) * stated.worst_mm * (1 + 1e-9)).all()
    ratio = np.sqrt(before.max() / after.max())
    assert report.number.value == pytest.approx(ratio, rel=0.2)


def test_noise_gain_is_the_scatter_of_predictions_over_that_of_readings():
    machine, terms, report, _, u, _, estimator = linear_campaign()
    rng = np.random.default_rng(6)
    inner = volume_grid(inner_box(machine), 7)
    field = design(machine, terms, inner)
    scatter = np.zeros(len(inner))
    for _ in range(400):
        shift = estimator @ (rng.normal(size=len(u)) * u)
        scatter += (remove_rigid(inner, field @ shift[: len(terms)]) ** 2).sum(axis=1) / 400
    assert np.sqrt(scatter) / np.sqrt(np.mean(u**2)) == pytest.approx(report.at(inner).gain, rel=0.15)


def test_what_is_written_holds_and_what_is_not_would_have_been_wrong():
    _, terms, report, a, u, root, estimator = linear_campaign()
    rng = np.random.default_rng(7)
    written = observable_motions(report.motions)
    assert {"EXX", "EYX", "EZX"} & set(written)
    mine = [i for i, t in enumerate(terms) if t.motion in written]
    hidden = [i for i, p in enumerate(report.parameters[: len(terms)]) if p.status == "not observable"]
    sd = np.sqrt(np.diag(report.knowing.posterior))
    prior = np.linalg.norm(root, axis=1)[: len(terms)]
    off, missed = [], []
    for _ in range(100):
        truth = root @ rng.normal(size=len(root))
        error = (estimator @ (a @ truth + rng.normal(size=len(u)) * u) - truth)[: len(terms)]
        off.append(error[mine] / sd[mine])
        missed.append(error[hidden] / prior[hidden])
    assert 0.93 < np.mean(np.abs(off) < 1.96) < 0.97
    assert np.sqrt(np.mean(np.square(missed))) > 0.3  # of a typical machine's size: a table of it would be an invention


def test_more_runs_never_tell_less():
    machine = Machine("w-X-b-Y-Z-t", BOX, np.zeros((3, 3)), np.array([0.0, 0.0, -120.0]))
    reports = [observability(machine, tuple(piece(n) for n in POOL[:k]), terms=2) for k in (1, 3, 5, 8, len(POOL))]
    ranks, values = [r.rank for r in reports], [r.number.value for r in reports]
    assert ranks == sorted(ranks)
    assert values == pytest.approx(sorted(values))
    assert values[0] >= 1.0
    assert reports[0].number.verdict == "mostly assumption"
    assert values[-1] > 3.0


def test_the_report_of_a_solution_has_its_values_and_covariance():
    runs = tuple(Truth(3).campaign()[:8])
    s = solve_joint(MACHINE, runs, order=3, sigma_mm=SIGMA, floor_mm=FLOOR)
    report, before = observability_of(s), observability(MACHINE, runs, terms=3)
    assert (report.rank, report.reachable) == (before.rank, before.reachable)
    assert [g.motions for g in report.hidden] == [g.motions for g in before.hidden]
    assert [p.name for p in report.parameters] == list(s.estimate.names)
    first = report.parameters[0]
    assert (first.value, first.u) == (s.estimate.value(first.name), s.estimate.u(first.name))
    assert before.parameters[0].value is None
    assert report.lines()[0] == report.number.text
    assert f"{report.rank} of {len(report.terms)} coefficients" in report.lines()[1]
    assert report.volume.worst_point == int(np.argmax(report.volume.u_mm))


def test_orders_above_the_chosen_one_count_in_uncertainties_but_not_in_the_rank():
    runs = tuple(Truth(3).campaign()[:10])
    s = solve_joint(MACHINE, runs)
    report = observability_of(s)
    assert max(t.order for t in report.terms) == s.order
    assert len(report.model) == len(s.terms)
    assert len(report.parameters) == len(s.estimate.names)


# --- parameters and motions ---------------------------------------------------------------------------------------------------------------


def test_lost_motion_of_an_axis_that_never_reverses_is_not_observable():
    status = {p.name: p.status for p in observability(YANG, ONE, terms=1).parameters}
    assert status["backlash_Y"] == "not observable"  # the helix descends in Y: lost motion is an offset of the cup
    assert status["backlash_X"] != "not observable"


def test_motions_with_hidden_parts_and_motions_without_information_are_kept_out_of_tables():
    report = observability(YANG, ONE, terms=2)
    by_name = {m.name: m for m in report.motions}
    assert by_name["ECY"].status == "not observable"
    assert "cannot be distinguished" in by_name["C0Y"].reason
    for m in report.motions:
        assert (m.name in observable_motions(report.motions)) == (m.status == "observed")
        assert not (m.hidden and m.name in observable_motions(report.motions, weak=True))


def test_thresholds_of_the_status():
    assert status_of(0.95, hidden=False) == "observed"
    assert status_of(0.5, hidden=False) == "weak"
    assert status_of(0.05, hidden=False) == "not observable"
    assert status_of(0.99, hidden=True) == "not observable"


def test_correlations_above_nine_tenths_strongest_first():
    c = np.array([[1.0, 0.95, 0.2], [0.95, 1.0, -0.99], [0.2, -0.99, 1.0]])
    found = correlations(("a", "b", "c"), c * np.outer([2.0, 3.0, 4.0], [2.0, 3.0, 4.0]))
    assert [(f.first, f.second) for f in found] == [("b", "c"), ("a", "b")]
    assert [f.r for f in found] == pytest.approx([-0.99, 0.95])


def test_posterior_covariance_is_the_inverse_of_information_and_prior():
    rng = np.random.default_rng(8)
    a, root = rng.normal(size=(4, 6)), np.tril(rng.normal(size=(6, 6))) + 3 * np.eye(6)
    found = posterior_covariance(a.T @ a, root)
    assert found == pytest.approx(np.linalg.inv(a.T @ a + np.linalg.inv(root @ root.T)))


def test_compressing_a_campaign_keeps_everything():
    runs = tuple(piece(n) for n in ("h1", "ppp", "X"))
    machine = Machine("w-b-X-Y-Z-t", BOX)
    terms = smooth_terms(2)
    whole = campaign_columns(machine, terms, runs, setup_unknowns(runs, Priors()))
    few = compressed(whole)
    assert few.machine.shape[0] < whole.machine.shape[0]
    assert few.machine.T @ few.setup == pytest.approx(whole.machine.T @ whole.setup, abs=1e-9 * np.abs(whole.machine).max() ** 2)
    again = compressed(replace(few, setup_names=few.setup_names))
    assert again.machine.shape == few.machine.shape
