"""Map of a stored solution and what-if figures, against sums that are made another way: rule G by hand, exact readings, brute draws."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import term_values
from abbe.models.geometry.chain import design, deviation_mm
from abbe.models.geometry.volume import remove_rigid, volume_grid
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, straight_line
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import SetupUnknowns, predict
from abbe.models.uncertainty.coverage import apart_from_zero
from abbe.models.uncertainty.known_field import KnownField, field_map
from abbe.models.uncertainty.what_if import (
    GainForecast,
    check_figures,
    diagonal_figures,
    expected_rms,
    helix_figure,
    volume_figures,
    what_if,
)
from abbe.models.verification import diagonal_figure
from abbe.models.verification import helix_figure as measured_helix
from abbe.service.domain.machine import machine_from_doc
from abbe.service.domain.solution_file import StoredPrediction
from tests.pages_world import solved_campaign


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> KnownField:
    site, _, solved, doc = solved_campaign(tmp_path_factory, "m")
    del solved
    machine = machine_from_doc(json.loads(json.dumps(site.doc)))
    return KnownField(machine, *StoredPrediction.read(doc["prediction"]).unpacked(), doc["prediction"]["scatter_mm"])


def certain(known: KnownField) -> KnownField:
    return replace(known, covariance=np.zeros_like(known.covariance), scatter_mm=0.0)


def by_hand(known: KnownField, points: np.ndarray, motions: set[str]) -> np.ndarray:
    """Rule G with the six motions of each carriage summed one by one."""
    values = term_values(known.terms, points, known.machine.stroke_mm)
    carried = np.zeros((len(points), 3, 6))
    for k, term in enumerate(known.terms):
        if term.motion in motions:
            carried[:, term.axis, term.component] += values[:, k] * known.coefficients[k]
    return deviation_mm(known.machine, points, carried)


def test_the_map_of_some_motions_is_their_deviation_without_rigid_motion(known) -> None:
    points = volume_grid(known.machine.stroke_mm, 5)  # the frame is fitted to these very points
    for motions in ({"EXX", "ECY", "C0Y"}, {t.motion for t in known.terms}):
        wanted = remove_rigid(points, by_hand(known, points, motions))
        assert np.abs(field_map(known, points, motions).deviation_mm - wanted).max() < 1e-12
    assert np.allclose(field_map(known, points).deviation_mm, wanted, atol=1e-12)


def test_the_covariance_of_a_node_is_the_scatter_of_drawn_solutions(known) -> None:
    points = volume_grid(known.machine.stroke_mm, 3)
    motions = {"EXX", "EYY", "ECZ", "A0Z"}
    found = field_map(known, points, motions)
    at = [k for k, t in enumerate(known.terms) if t.motion in motions]
    drawn = np.random.default_rng(5).multivariate_normal(known.coefficients[at], known.covariance[np.ix_(at, at)], size=1200, method="eigh")
    unit = design(known.machine, known.terms, points)[:, :, at]
    grid = volume_grid(known.machine.stroke_mm, 5)
    frame = design(known.machine, known.terms, grid)[:, :, at]
    for node in (0, 26):
        both = [remove_rigid_at(grid, frame @ c, points[node], unit[node] @ c) for c in drawn]
        spread = np.cov(np.array(both).T) + known.scatter_mm**2 * np.eye(3)
        scale = np.maximum(np.sqrt(np.diag(found.covariance_mm2[node])), 1e-9)  # these motions may not move a component
        assert np.abs((spread - found.covariance_mm2[node]) / np.outer(scale, scale)).max() < 0.15


def test_a_machine_without_errors_is_told_to_err_at_five_nodes_in_a_hundred(known) -> None:
    points = volume_grid(known.machine.stroke_mm, 3)
    found = field_map(known, points)
    rng = np.random.default_rng(11)
    roots = np.linalg.cholesky(found.covariance_mm2)
    told = np.mean([apart_from_zero(np.einsum("nij,nj->ni", roots, rng.normal(size=(27, 3))), found.covariance_mm2) for _ in range(400)])
    assert told == pytest.approx(0.05, abs=0.006)  # three standard deviations for 10 800 nodes
    flat = np.diag([1e-6, 0.0, 0.0])[None]
    assert [bool(apart_from_zero(np.array([[x, 0.0, 0.0]]), flat)[0]) for x in (0.0, 2e-3, 3e-3)] == [False, False, True]


def remove_rigid_at(grid: np.ndarray, field: np.ndarray, point: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Deviation at a point less the rigid motion fitted over a grid, by the six normal equations written out."""
    d = grid - grid.mean(axis=0)
    shift = field.mean(axis=0)
    inertia = (np.sum(d**2) * np.eye(3)) - d.T @ d
    turn = np.linalg.solve(inertia, np.cross(d, field).sum(axis=0))
    return own - shift - np.cross(turn, point - grid.mean(axis=0))


def test_a_quadratic_figure_has_the_mean_and_scatter_of_its_closed_form(known) -> None:
    """rms² is a quadratic form of a normal vector: mean m'Gm + tr GC, variance 4 m'GCGm + 2 tr GCGC."""
    [found] = what_if(known, known.estimate_of({"C0Y", "EXX"}), volume_figures(known)[:1], draws=3000)
    assert expected_rms(known, 6) == (pytest.approx(found.before_mm, rel=0.01), pytest.approx(found.u_before_mm, rel=0.08))
    d = known.per_unit(volume_grid(known.machine.stroke_mm, 6))
    g = np.einsum("mik,mil->kl", d, d) / len(d)
    left = np.array([0.0 if t.motion in {"C0Y", "EXX"} else c for t, c in zip(known.terms, known.coefficients, strict=True)])
    for mean, value, u in ((known.coefficients, found.before_mm, found.u_before_mm), (left, found.after_mm, found.u_after_mm)):
        gc = g @ known.covariance
        square = mean @ g @ mean + np.trace(gc)
        spread = np.sqrt(4 * mean @ gc @ g @ mean + 2 * np.trace(gc @ gc))
        assert value**2 + u**2 == pytest.approx(square, rel=0.02)
        assert u == pytest.approx(spread / (2 * np.sqrt(square)), rel=0.08)


def test_largest_and_ranges_are_those_of_solutions_drawn_one_by_one(known) -> None:
    rng = np.random.default_rng(77)
    names = {"EXX.1", "EYY", "B0Z"}
    outcomes = {o.name: o for o in what_if(known, known.estimate_of(names), [*volume_figures(known, 4), *diagonal_figures(known)])}
    box = known.machine.stroke_mm + np.array([10.0, -10.0])
    grid, unit = volume_grid(known.machine.stroke_mm, 4), design(known.machine, known.terms, volume_grid(known.machine.stroke_mm, 4))
    line = straight_line(*diagonal_ends(box, "npp"), 11, back=False)
    along = (line[-1] - line[0]) / np.linalg.norm(line[-1] - line[0])
    beam = np.einsum("i,mip->mp", along, design(known.machine, known.terms, line))
    taken = np.array([t.motion in names or t.name in names for t in known.terms])
    drawn = rng.multivariate_normal(known.coefficients, known.covariance, size=400, method="eigh")
    largest, ranges = [], []
    for truth in drawn:
        left = truth - np.where(taken, known.coefficients, 0.0)
        largest.append(np.linalg.norm(remove_rigid(grid, unit @ left), axis=1).max())
        ranges.append(np.ptp(beam @ left))
    for name, values in (("volume_max", largest), ("diagonal_npp", ranges)):
        # The frame of the product is fitted to 5 nodes per axis, this one to 4.
        assert outcomes[name].after_mm == pytest.approx(np.mean(values), rel=0.05), name
        assert outcomes[name].u_after_mm == pytest.approx(np.std(values), rel=0.2), name


def test_predicted_check_figures_are_those_of_exact_readings(known) -> None:
    sure = certain(known)
    theta = np.concatenate([known.coefficients, np.zeros(3)])
    machine = known.machine
    box = machine.stroke_mm + np.array([10.0, -10.0])
    outcomes = {o.name: o for o in what_if(sure, sure.estimate_of(()), diagonal_figures(sure))}
    for name in DIAGONALS:
        start, end = diagonal_ends(box, name)
        out = straight_line(start, end, 11, back=True)
        run = reading("laser", machine, known, out, theta, beam=(end - start) / np.linalg.norm(end - start))
        assert outcomes[f"diagonal_{name}"].before_mm == pytest.approx(diagonal_figure(run).value_mm, abs=2e-5)  # of second order
    centre, radius = machine.centre_mm, 100.0
    at = helix_points(centre, radius, turns=3.0, n=180, law="area", axis=2)
    run = reading("bar", machine, known, at, theta, centre_mm=centre, radius_mm=radius)
    [found] = what_if(sure, sure.estimate_of(()), [helix_figure(sure, centre, radius)])
    assert found.before_mm == pytest.approx(measured_helix(run).value_mm, rel=0.01)


def reading(kind, machine: Machine, known: KnownField, axes: np.ndarray, theta: np.ndarray, **setup) -> RunData:
    n = len(axes)
    empty = RunData("r", "S", kind, axes, np.zeros(n), np.zeros((n, 3)), np.arange(float(n)), np.ones(n), **setup)
    return replace(empty, deviation_mm=predict(machine, known.terms, empty, SetupUnknowns((), np.zeros(0), {}), theta))


def test_what_is_corrected_leaves_its_uncertainty(known) -> None:
    figures = check_figures(known, (known.machine.centre_mm, 100.0))
    nothing, all_of_it = what_if(known, known.estimate_of(()), figures), what_if(known, known.coefficients, figures)
    assert [o.name for o in nothing] == ["volume_rms", "volume_max", *(f"diagonal_{d}" for d in DIAGONALS), "helix_rms"]
    for before, after in zip(nothing, all_of_it, strict=True):
        assert (before.gain_mm, before.u_gain_mm, before.after_mm) == (0.0, 0.0, before.before_mm)
        assert 0.0 < after.after_mm < after.before_mm
        assert after.u_after_mm > 0.0
        assert after.before_mm == before.before_mm  # the same draws
    d = known.per_unit(volume_grid(known.machine.stroke_mm, 6))
    unknown = np.sqrt(np.einsum("mik,kl,mil->", d, known.covariance, d, optimize=True) / len(d))
    rms: GainForecast = all_of_it[0]
    assert np.hypot(rms.after_mm, rms.u_after_mm) == pytest.approx(unknown, rel=0.05)


def test_mean_linear_errors_that_are_taken_off_are_gone(known) -> None:
    """Slopes of the main effects of what is left, by straight lines through means over planes (signs: docs/explanation/conventions.md)."""
    wanted = {"EXX": 2e-5, "EZZ": -3e-6, "C0Y": 4e-5, "B0Z": -1e-5, "A0Z": 7e-6}
    n = 7
    points = volume_grid(known.machine.stroke_mm, n)
    made = (design(known.machine, known.terms, points) @ known.linear(wanted)).reshape(n, n, n, 3)
    axes = [np.linspace(*known.machine.stroke_mm[a], n) for a in range(3)]

    def slope(moved: int, of: int) -> float:
        mean = made[..., of].mean(axis=tuple(a for a in range(3) if a != moved))
        return float(np.polyfit(axes[moved], mean, 1)[0])

    found = {f"E{c}{c}": slope(k, k) for k, c in enumerate("XYZ")}
    found |= {"C0Y": -slope(1, 0) - slope(0, 1), "B0Z": slope(2, 0) + slope(0, 2), "A0Z": -slope(2, 1) - slope(1, 2)}
    assert found == pytest.approx({"EYY": 0.0} | wanted, abs=1e-12)


def test_a_motion_that_the_solution_does_not_have_is_refused(known) -> None:
    with pytest.raises(ValueError, match="no motion or parameter EQX"):
        known.estimate_of({"EXX", "EQX"})
    with pytest.raises(ValueError, match="no motion or parameter EXX"):
        field_map(known, known.machine.centre_mm[None], {"EXX.99"})
    with pytest.raises(ValueError, match="no motion or parameter"):
        known.linear({"D0Y": 1e-6})
