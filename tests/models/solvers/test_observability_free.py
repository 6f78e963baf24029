"""What is said of the set-up: free unknowns that the readings leave open, one rule for rank and report, rounding that is not a reading.

``ABBE_TEST_LONG=1`` writes numbers with more different digits.
"""

import os
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from abbe.models.compensation.achievable import individually_observable
from abbe.models.machine import Machine
from abbe.models.paths import diagonal_ends, step_diagonal, straight_line
from abbe.models.solvers.assessment import motions_of, observability, observability_of
from abbe.models.solvers.joint import solve_joint
from abbe.models.solvers.observability.rank import as_meant
from abbe.models.solvers.observe import setup_unknowns
from abbe.models.solvers.priors import Priors
from tests.models.solvers.observability_cases import FXYZ, ONE, STEPS, TEN, YANG, helix, laser

BOX = np.array([[0.0, 500.0], [0.0, 400.0], [0.0, 300.0]])
MACHINE = Machine("w-X-Y-b-Z-t", BOX, tool_mm=np.array([0.0, 0.0, -120.0]))


LONG = os.environ.get("ABBE_TEST_LONG") == "1"


def said(report, start):
    return {p.name: p.status for p in report.parameters if p.name.startswith(start)}


def test_a_length_that_grows_with_the_scales_is_not_observed():
    """Ten helices: every scale and both bars may grow together, though priors and readings narrow the length to 1 % of its variance."""
    report = observability(YANG, TEN, terms=1)
    length = {p.name: p for p in report.parameters}["bar_length_175"]
    assert length.share > 0.98
    assert set(said(report, "bar_length").values()) == {"not observable"}
    certified = tuple(replace(r, u_length_mm=1e-3, length_calibrated=True) for r in TEN)
    assert "not observable" not in said(observability(YANG, certified, terms=1), "bar_length").values()


def test_tilts_that_read_like_the_machine_are_not_observed():
    report = observability(YANG, STEPS, terms=1)
    tilts = [p for p in report.parameters if p.name.startswith("tilt")]
    assert len(tilts) == 8
    assert min(p.share for p in tilts) > 0.98
    assert {p.status for p in tilts} == {"not observable"}


def test_what_no_run_reverses_has_no_lost_motion_to_tell():
    """The helix descends in Y: lost motion there and the height of the cup are one number, and neither is told."""
    report = observability(YANG, ONE, terms=1)
    assert said(report, "backlash_Y") == {"backlash_Y": "not observable"}
    assert said(report, "cup_h0") == {"cup_h0_x": "observed", "cup_h0_y": "not observable", "cup_h0_z": "observed"}


def moved(run, rng):
    """The run as a quiet machine would have read it."""
    n = run.deviation_mm.size
    base = 0.0 if run.kind == "laser" else np.linalg.norm(run.axes_mm - run.centre_mm, axis=1) - run.radius_mm
    return replace(run, deviation_mm=base + rng.normal(0, 5e-4, n))


@pytest.mark.parametrize("certified", [True, False])
def test_the_solver_s_rank_the_report_and_the_tables_say_the_same(certified):
    rng = np.random.default_rng(0)
    stated = {"u_length_mm": 1e-3, "length_calibrated": True} if certified else {}
    solution = solve_joint(YANG, tuple(moved(replace(r, **stated), rng) for r in TEN), order=1)
    report = observability_of(solution)
    rank = solution.identifiability
    assert (rank.rank, rank.effective_rank, rank.n_parameters) == (report.rank, report.observed.effective_rank, len(report.terms))
    assert rank.rank == (11 if certified else 10)
    involved = {n for m in report.motions for n in m.hidden}
    assert {n for c in rank.hidden for n, _ in c.weights} == involved == rank.involved & {t.name for t in report.terms}
    free = tuple(f"{kind}_" for kind in ("backlash", "cup", *([] if certified else ["bar_length"])))
    assert rank.involved - involved == {p.name for p in report.parameters if p.name.startswith(free) and p.name in rank.involved}
    assert {p.status for p in report.parameters if p.name in rank.involved} == {"not observable"}
    assert ("bar_length_175" in rank.involved) == (not certified)
    assert motions_of(solution) == report.motions
    assert individually_observable(solution) == {m.name for m in report.motions if m.status == "observed"}


@pytest.mark.parametrize("digits", [9, 7, 6, 4, 3] if LONG else [6, 3])
def test_digits_of_a_beam_or_a_position_change_no_rank(digits):
    """A plain diagonal says order + 1 combinations, a line its own axis; a written beam or a resolution of 1 um changes nothing."""
    diagonal, line = straight_line(*diagonal_ends(BOX, "ppp"), 9), straight_line(np.array([20.0, 30, 40]), np.array([480.0, 30, 40]), 9)
    for path, rank in ((diagonal, 3), (line, 2)):
        exact = laser("d", path)
        assert rank_of_a_path(tuple(map(tuple, path))) == rank
        off = np.round(exact.beam + 10.0**-digits * np.array([0.0, 0.4, -0.4]), digits + 1)
        written = replace(exact, beam=off / np.linalg.norm(off))
        shaky = replace(
            exact, axes_mm=np.round(path + np.random.default_rng(digits).uniform(-0.5, 0.5, path.shape) * 10.0**-digits, digits)
        )
        for run in (written, shaky):
            assert not any(n.startswith("tilt_") for n in setup_unknowns((run,), Priors()).names)
            assert observability(MACHINE, (run,), terms=2).rank == rank


@cache
def rank_of_a_path(path):
    run = laser("d", np.array(path))
    assert not any(n.startswith("tilt_") for n in setup_unknowns((run,), Priors()).names)
    return observability(MACHINE, (run,), terms=2).rank


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("digits", [6, 4, 3] if LONG else [6, 3])
def test_digits_of_positions_do_not_tell_a_common_scale_from_a_bar(order, digits):
    """One unknown length per radius hides one combination of the scales (math.md 4.6); resolution and chords do not bring it back."""
    rank = {1: 10, 2: 24}[order]
    rounded = tuple(replace(r, axes_mm=np.round(r.axes_mm, digits)) for r in TEN)
    assert observability(YANG, rounded, terms=order).rank == rank
    assert rank_of_chords(order) == rank


@cache
def rank_of_chords(order):
    chords = tuple(replace(r, axes_mm=r.centre_mm + (r.axes_mm - r.centre_mm) * (1 - 1e-4 * np.arange(63) / 63)[:, None]) for r in TEN)
    return observability(YANG, chords, terms=order).rank


def test_a_beam_off_its_straight_path_costs_certainty_not_a_tilt():
    path = straight_line(np.array([20.0, 30, 40]), np.array([480.0, 30, 40]), 9)
    exact = laser("d", path)

    def cosine(angle):
        run = replace(exact, beam=np.array([np.cos(angle), np.sin(angle), 0.0]))
        setup = setup_unknowns((run,), Priors())
        return setup.prior_sd[setup.names.index("cosine_d")], any(n.startswith("tilt") for n in setup.names)

    assert cosine(0.0) == (Priors().cosine, False)
    assert cosine(1e-3) == (pytest.approx(np.hypot(Priors().cosine, Priors().tilt_rad * 1e-3), rel=1e-3), False)
    assert cosine(0.1)[1]  # another direction on purpose: the mirror's tilt is a scale of its own


def test_runs_as_meant_move_by_rounding_only():
    rough = laser("d", np.round(straight_line(*diagonal_ends(BOX, "pnp"), 9), 3))
    straight = as_meant(rough)
    assert 0 < np.abs(straight.axes_mm - rough.axes_mm).max() < 1e-3
    steps = laser("s", step_diagonal(*diagonal_ends(BOX, "pnp"), 5))
    assert np.array_equal(as_meant(steps).axes_mm, steps.axes_mm)
    bar = helix("h", np.array([400.0, 250.0, 250.0]), 100.0)
    assert as_meant(bar).axes_mm == pytest.approx(bar.axes_mm, abs=1e-9)
    far = replace(bar, radius_mm=120.0)
    assert np.array_equal(as_meant(far).axes_mm, bar.axes_mm)
    still = laser("l", straight_line(*diagonal_ends(BOX, "pnp"), 9))
    resting = replace(still, axes_mm=np.tile([1.0, 2.0, 3.0], (18, 1)))
    assert np.array_equal(as_meant(resting).axes_mm, resting.axes_mm)


def test_the_default_noise_of_a_planned_reading_is_what_it_says():
    """Half a micrometre for the bar and 0.3 for the laser, and not the root of twice their squares."""
    for runs, u_mm in ((ONE, 0.5e-3), (STEPS, 0.3e-3)):
        usual = observability(YANG if runs is ONE else FXYZ, runs, terms=1)
        said_so = {"bar": u_mm, "laser": u_mm}
        same = observability(YANG if runs is ONE else FXYZ, runs, terms=1, sigma_mm=said_so, floor_mm={"bar": 0.0, "laser": 0.0})
        assert [p.u for p in usual.parameters] == pytest.approx([p.u for p in same.parameters], rel=1e-9)
