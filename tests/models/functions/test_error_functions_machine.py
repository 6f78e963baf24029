"""The machine's error motions together: values, directions, sensitivities, and straight axes without losing anything."""

from __future__ import annotations

import tracemalloc
from itertools import permutations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from abbe.models.functions.legendre import Legendre
from abbe.models.functions.motions import PLACES, SQUARENESS, ErrorMotions, least_squares_line
from abbe.models.functions.polynomial import Polynomial
from abbe.models.functions.table import Table
from abbe.models.geometry import propagation
from abbe.models.geometry.bases import Term, smooth_terms, term_values
from abbe.models.geometry.chain import deviation_mm, exact_deviation_mm
from abbe.models.geometry.propagation import CHUNK, Points, checked_covariance, deviation_covariance, sensitivity
from abbe.models.machine import Machine

STROKE = np.array([[-100.0, 500.0], [0.0, 400.0], [50.0, 450.0]])
CHAINS = ["-".join(["w", *order[:k], "b", *order[k:], "t"]) for order in permutations("XYZ") for k in range(4)]


def random_errors(seed: int) -> ErrorMotions:
    rng = np.random.default_rng(seed)
    functions = {}
    for name, (axis, component) in PLACES.items():
        size = 1e-2 if component < 3 else 3e-5
        lo, hi = STROKE[axis]
        kind = rng.integers(3)
        if kind == 0:
            functions[name] = Polynomial(size * rng.normal(size=4) / (hi - lo) ** np.arange(4), lo + 20.0)
        elif kind == 1:
            functions[name] = Legendre(size * rng.normal(size=5), (lo, hi))
        else:
            functions[name] = Table(np.linspace(lo, hi, 6), size * rng.normal(size=6), "cubic")
    return ErrorMotions(functions, dict(zip(SQUARENESS, 3e-5 * rng.normal(size=3), strict=True)))


def points(n: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(STROKE[:, 0], STROKE[:, 1], (n, 3))


def test_motions_stand_where_rule_g_looks_for_them():
    """With coefficient 1, a Legendre motion is the column that the design matrix of the solvers has."""
    p = points(20)
    for term in smooth_terms(3):
        if term.order == 0:
            continue
        f = Legendre(np.eye(4)[term.order], tuple(STROKE[term.axis]))
        found = ErrorMotions({term.motion: f}).motions(p)[:, term.axis, term.component]
        column = term_values((term,), p, STROKE)[:, 0]
        assert_allclose(found - column, (found - column)[0], atol=1e-14)  # the solvers put the datum at the stroke's start


def test_squareness_counts_from_axis_zero_and_has_the_signs_of_the_conventions():
    p = np.array([[1.0, 10.0, 100.0], [2.0, 0.0, 0.0]])
    m = ErrorMotions({}, {"C0Y": 1e-3, "B0Z": 2e-3, "A0Z": 3e-3}).motions(p)
    assert_allclose(m[0, 1, :3], [-1e-2, 0, 0])
    assert_allclose(m[0, 2, :3], [0.2, -0.3, 0])
    assert not m[1].any()
    for name, (axis, component, _) in SQUARENESS.items():
        shift = (
            ErrorMotions({}, {name: 1.0}).motions(p)[:, axis, component] - term_values((Term(name, 0, axis, component),), p, STROKE)[:, 0]
        )
        assert_allclose(shift, shift[0])  # the solvers count from the stroke's start: a constant for the whole machine


def test_direction():
    p, s = points(4), np.array([[1, 0, 0], [-1, 0, 0], [0, -1, -1], [-1, 1, 1]])
    e = ErrorMotions(
        {"EYX": Polynomial([1.0]), "EYX@reverse": Polynomial([5.0]), "EAX@reverse": Polynomial([7.0]), "EXX": Polynomial([2.0])}
    )
    assert e.motions(p, s)[:, 0, 1].tolist() == [1.0, 5.0, 1.0, 5.0]
    assert e.motions(p, s)[:, 0, 3].tolist() == [0.0, 7.0, 0.0, 7.0]
    assert e.motions(p, s)[:, 0, 0].tolist() == [2.0] * 4
    assert e.motions(p)[:, 0, 1].tolist() == [1.0] * 4


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("chain", CHAINS[::5])
def test_sensitivity_is_that_of_finite_differences(chain, exact):
    machine = Machine(chain, STROKE, np.random.default_rng(1).uniform(-200, 200, (3, 3)), np.array([10.0, -20.0, -120.0]))
    plain = random_errors(4)
    e = ErrorMotions(dict(plain.functions) | {"ECY@reverse": Polynomial([1e-5, 2e-8])}, plain.squareness_rad)
    p, s = points(6), np.array([[1, -1, 1]] * 3 + [[-1, 1, 0]] * 3, dtype=float)
    tool = np.random.default_rng(2).uniform(-100, 100, (6, 3))
    names = ["C0Y", "B0Z", "A0Z", "EXX.1", "EAY.0", "ECY.1", "ECY@reverse.0", "EBZ.2", "EYZ.3"]
    j = sensitivity(machine, e, names, Points(p, s, tool), exact=exact)
    deviation = exact_deviation_mm if exact else deviation_mm
    for column, name in enumerate(names):
        sides = []
        for step in (1e-5, -1e-5):
            functions, squareness = dict(e.functions), dict(e.squareness_rad)
            if name in squareness:
                squareness[name] += step
            else:
                key, _, k = name.rpartition(".")
                old = functions[key].parameters
                functions[key] = functions[key].with_parameters(old + step * np.eye(old.size)[int(k)])
            sides.append(deviation(machine, p, ErrorMotions(functions, squareness).motions(p, s), tool))
        assert_allclose(j[:, :, column], (sides[0] - sides[1]) / 2e-5, rtol=1e-5, atol=1e-5 * max(1.0, np.abs(j[:, :, column]).max()))


def test_covariance_agrees_with_random_draws():
    machine = Machine("w-X-b-Y-Z-t", STROKE, tool_mm=np.array([0.0, 0.0, -150.0]))
    e = ErrorMotions({"EBX": Polynomial([0.0, 1e-7]), "EZX": Table([-100.0, 200.0, 500.0], [0.0, 1e-3, 0.0])}, {"C0Y": 1e-5})
    names = ("C0Y", "EBX.1", "EZX.1")
    root = np.random.default_rng(7).normal(size=(3, 3)) * np.array([[2e-6], [1e-8], [3e-4]])
    p = points(3)
    found = deviation_covariance(machine, e, (names, root @ root.T), Points(p))
    draws = np.random.default_rng(8).normal(size=(20_000, 3)) @ root.T
    spread = np.einsum("nik,sk->sni", sensitivity(machine, e, names, Points(p)), draws)
    for k in range(3):
        assert_allclose(np.cov(spread[:, k].T), found[k], rtol=0.05, atol=0.05 * np.trace(found[k]))


def test_many_points_are_taken_in_pieces():
    machine = Machine("w-X-b-Y-Z-t", STROKE)
    e = ErrorMotions({"EBX": Polynomial([0.0, 1e-7])})
    p, s = points(CHUNK + 5), np.sign(points(CHUNK + 5, 1) - 200.0)
    whole = deviation_covariance(machine, e, (("EBX.1", "B0Z"), np.diag([1e-16, 1e-12])), Points(p, s, p))
    last = deviation_covariance(machine, e, (("EBX.1", "B0Z"), np.diag([1e-16, 1e-12])), Points(p[-7:], s[-7:], p[-7:]))
    assert_allclose(whole[-7:], last, rtol=1e-12)
    with pytest.raises(ValueError, match=r"2 parameters need shape \(2, 2\), got \(3, 3\)"):
        deviation_covariance(machine, e, (("EBX.1", "B0Z"), np.eye(3)), Points(p))


@pytest.mark.parametrize("exact", [False, True])
def test_covariance_of_every_parameter_in_any_order_is_the_whole_product(exact, monkeypatch):
    """Parameters of one motion need not stand together, and pieces of a few points give what one piece gives."""
    monkeypatch.setattr(propagation, "WEIGHTS", 300)
    machine = Machine("w-X-b-Y-Z-t", STROKE, np.full((3, 3), 55.0), np.array([0.0, 30.0, -100.0]))
    plain = random_errors(11)
    e = ErrorMotions(dict(plain.functions) | {"ECY@reverse": Polynomial([1e-5, 2e-8])}, plain.squareness_rad)
    rng = np.random.default_rng(12)
    names = rng.permutation(e.parameter_names())
    root = rng.normal(size=(names.size, names.size)) * np.exp(rng.uniform(-16, -4, (names.size, 1)))
    at = Points(points(11), rng.choice([-1.0, 0.0, 1.0], (11, 3)), points(11, 3))
    j = sensitivity(machine, e, names, at, exact=exact)
    whole = np.einsum("nip,pq,njq->nij", j, root @ root.T, j)
    found = deviation_covariance(machine, e, (names, root @ root.T), at, exact=exact)
    assert_allclose(found, whole, rtol=1e-11, atol=1e-12 * np.abs(whole).max())
    assert not deviation_covariance(machine, e, ((), np.zeros((0, 0))), at).any()


def test_eighteen_long_tables_do_not_fill_the_memory():
    e = ErrorMotions({name: Table(np.linspace(*STROKE[axis], 101), np.zeros(101)) for name, (axis, _) in PLACES.items()})
    names = e.parameter_names()
    tracemalloc.start()
    deviation_covariance(Machine("w-X-b-Y-Z-t", STROKE), e, (names, np.eye(len(names))), Points(points(3000)))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200e6  # the sensitivities of these points alone are 131 MB, and their product with the matrix as much again


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        ([[1, 0], [0, -1e-12]], "row 2: the variance is negative"),
        ([[0, 1e-9], [1e-9, 1]], "row 1: the variance is zero, so the whole row"),
        ([[1, 0], [1e-300, 0]], "row 2: the variance is zero"),
        ([["1e-12", 0], [0, 1]], "expected rows of numbers"),
        ([[True, False], [False, True]], "expected rows of numbers"),
        ([[1, np.nan], [np.nan, 1]], "expected finite numbers"),
        ([[1, 0.5], [0.4, 1]], "not symmetric"),
        ([[1e-10, 1.1e-10], [1.1e-10, 1e-10]], "would have a negative variance"),
        ([[1e-300, 1e300], [1e300, 1e-300]], "would have a negative variance"),
    ],
)
def test_what_is_no_covariance_is_refused(matrix, message):
    e, machine = ErrorMotions({"EBX": Polynomial([0.0, 1e-7])}), Machine("w-X-b-Y-Z-t", STROKE)
    for call in (
        lambda: checked_covariance(matrix, 2),
        lambda: deviation_covariance(machine, e, (("EBX.1", "B0Z"), matrix), Points(points(2))),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_a_covariance_may_be_singular_written_with_seven_digits_and_large():
    root = np.random.default_rng(2).normal(size=(6, 2)) * np.array([[1e-3], [1e-6], [1.0], [1e-9], [0.0], [1e-2]])
    written = np.array([[float(f"{v:.6e}") for v in row] for row in root @ root.T])
    assert_allclose(checked_covariance(written, 6), written, rtol=1e-15)
    assert checked_covariance([[1.7e308]], 1) == [[1.7e308]]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("chain", CHAINS[::7])
def test_straight_axes_differ_by_the_rigid_motion_that_is_handed_back(chain, seed):
    machine = Machine(chain, STROKE, np.full((3, 3), 55.0), np.array([0.0, 30.0, -100.0]))
    before, p = random_errors(seed), points(30)
    after = before.straightened(STROKE)
    for name, (axis, component) in PLACES.items():
        if component < 3 and component != axis:
            slope, _ = least_squares_line(after.motions.functions[name], STROKE[axis])
            assert abs(slope) * 600.0 < 1e-16
    change = deviation_mm(machine, p, before.motions(p)) - deviation_mm(machine, p, after.motions.motions(p))
    assert_allclose(change, after.offset_mm + np.cross(after.rotation_rad, p), rtol=0, atol=1e-15)
    assert np.abs(change).max() > 1e-4


def test_slopes_become_the_squareness_of_the_lines():
    """Angle of +a and +b less 90 degrees, from the least-squares directions of the axes (math.md 1)."""
    s = dict(zip(("EYX", "EZX", "EXY", "EZY", "EXZ", "EYZ"), 1e-6 * np.array([1.0, 2.0, 4.0, 8.0, 16.0, 32.0]), strict=True))
    found = ErrorMotions({name: Polynomial([0.0, slope]) for name, slope in s.items()}).straightened(STROKE).motions.squareness_rad
    x, y, z = np.array([1, s["EYX"], s["EZX"]]), np.array([s["EXY"], 1, s["EZY"]]), np.array([s["EXZ"], s["EYZ"], 1])
    theta = [np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)) - np.pi / 2 for a, b in ((x, y), (x, z), (y, z))]
    assert_allclose([found["C0Y"], -found["B0Z"], found["A0Z"]], theta, rtol=1e-4)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ErrorMotions({"EQX": Polynomial([1.0])}), "error motion 'EQX': expected one of EXX, EYX"),
        (lambda: ErrorMotions({"EXX@forward": Polynomial([1.0])}), "error motion 'EXX@forward'"),
        (lambda: ErrorMotions({}, {"C0X": 1.0}), "squareness 'C0X'"),
        (lambda: ErrorMotions({}, {"C0Y": np.nan}), "squareness 'C0Y' = nan"),
        (lambda: ErrorMotions().motions(np.zeros(3)), r"axes_mm: expected shape \(n, 3\), got \(3,\)"),
        (lambda: ErrorMotions().motions([[np.nan, 0, 0]]), "expected finite numbers"),
        (lambda: ErrorMotions().motions(np.zeros((2, 3)), np.zeros(3)), r"direction: expected -1, 0 or \+1 in shape \(2, 3\)"),
        (lambda: ErrorMotions().motions(np.zeros((1, 3)), [[0.5, 0, 0]]), "direction"),
        (lambda: ErrorMotions().sensitivities(["EXX.0"], np.zeros((1, 3))), "'EXX.0' is not a parameter"),
        (lambda: ErrorMotions({"EYX@reverse": Polynomial([1.0])}).straightened(STROKE), "has two slopes and cannot be straightened"),
    ],
)
def test_what_is_no_machine_error_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()


def test_names_cannot_be_changed_later():
    functions = {"EXX": Polynomial([1.0])}
    e = ErrorMotions(functions)
    functions["EYX"] = Polynomial([2.0])
    assert list(e.functions) == ["EXX"]
    with pytest.raises(TypeError):
        e.functions["EYX"] = Polynomial([2.0])
    assert e.parameter_names() == ("C0Y", "B0Z", "A0Z", "EXX.0")
