"""A map of many points is the plain chain to 1e-12 mm: grids, other orders, blocks, one core and several."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from abbe.models.functions.legendre import Legendre
from abbe.models.functions.motions import PLACES, ErrorMotions
from abbe.models.functions.table import Table
from abbe.models.geometry import field
from abbe.models.geometry.bases import ROUGH_ORDER, smooth_terms, term_motions
from abbe.models.geometry.chain import all_chains, design, deviation_mm
from abbe.models.geometry.field import field_mm, grid_lines, in_blocks
from abbe.models.machine import Machine

STROKE = np.array([[-50.0, 600.0], [100.0, 600.0], [0.0, 450.0]])
SIDES = (11, 9, 13)
TOLERANCE_MM = 1e-12


def machine(chain: str = "w-X-Y-b-Z-t") -> Machine:
    """Pivots and tool at random."""
    return Machine(chain, STROKE, np.random.default_rng(3).uniform(-400, 400, (3, 3)), np.array([12.0, -30.0, -160.0]))


def errors() -> ErrorMotions:
    """Every motion in a curve or a table: some um and tens of urad."""
    rng, functions = np.random.default_rng(4), {}
    for k, (name, (axis, component)) in enumerate(PLACES.items()):
        size, (lo, hi) = (5e-3 if component < 3 else 20e-6), STROKE[axis]
        if k % 2:
            functions[name] = Legendre(rng.normal(0.0, size, 13), (lo, hi))
        else:
            functions[name] = Table(np.linspace(lo + 20.0, hi, 17), rng.normal(0.0, size, 17))
    return ErrorMotions(functions, {"C0Y": 3e-5, "B0Z": -2e-5, "A0Z": 4e-5})


def grid(sides: tuple[int, int, int] = SIDES) -> np.ndarray:
    lines = [np.sort(np.random.default_rng(a).uniform(*STROKE[a], n)) for a, n in enumerate(sides)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def plain(m: Machine, points: np.ndarray) -> np.ndarray:
    return deviation_mm(m, points, errors().motions(points))


@pytest.mark.parametrize("chain", all_chains())
def test_a_grid_and_its_points_in_any_order_are_those_of_the_plain_chain(chain: str) -> None:
    points, m = grid(), machine(chain)
    expected = plain(m, points)
    assert np.abs(expected).max() > 5e-3
    assert grid_lines(points) is not None
    assert np.abs(field_mm(m, errors().motions, points) - expected).max() < TOLERANCE_MM
    mixed = np.random.default_rng(5).permutation(len(points))
    assert grid_lines(points[mixed]) is None
    assert np.abs(field_mm(m, errors().motions, points[mixed]) - expected[mixed]).max() < TOLERANCE_MM


def test_a_grid_costs_three_lines_of_every_motion() -> None:
    asked: list[int] = []
    known = errors()

    def counted(axes_mm: np.ndarray) -> np.ndarray:
        asked.append(len(axes_mm))
        return known.motions(axes_mm)

    field_mm(machine(), counted, grid())
    assert asked == [max(SIDES)]


@pytest.mark.parametrize("cores", [1, 2])
@pytest.mark.parametrize("sides", [(50, 40, 45), (2, 200, 190), (300, 2, 130)])
def test_many_points_are_shared_among_cores_and_stay_the_same(cores: int, sides, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "CORES", cores)
    points, m = grid(sides), machine()
    assert len(points) >= field.SHARED
    expected = plain(m, points)
    assert np.abs(field_mm(m, errors().motions, points) - expected).max() < TOLERANCE_MM
    assert np.abs(field_mm(m, errors().motions, points[::-1]) - expected[::-1]).max() < TOLERANCE_MM


@pytest.mark.parametrize("row", [0, 1, 500, -1])
@pytest.mark.parametrize("value", [7.0, np.nan])
def test_a_grid_with_one_other_number_is_no_grid(row: int, value: float) -> None:
    for axis in range(3):
        points = grid()
        points[row, axis] = value
        assert grid_lines(points) is None


@pytest.mark.parametrize("points", [np.zeros((2000, 3)), grid()[:-1], grid((8, 8, 7))[: field.LEAST - 1], grid((1, 40, 40))[:, ::-1]])
def test_what_is_no_full_grid_or_too_small_is_worked_off_point_by_point(points: np.ndarray) -> None:
    assert grid_lines(points) is None
    assert field_mm(machine(), lambda p: np.zeros((len(p), 3, 6)), points).shape == points.shape


def test_blocks_cover_every_row_once_and_an_error_in_one_comes_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "CORES", 3)
    for count, weight in ((0, 1), (1, 1), (field.SHARED + 5, 1), (70, 1000)):
        seen = np.zeros(count, dtype=int)

        def mark(rows: slice, seen: np.ndarray = seen) -> None:
            seen[rows] += 1

        in_blocks(count, mark, weight=weight)
        assert (seen == 1).all()

    def broken(rows: slice) -> None:
        raise ValueError(f"row {rows.start}")

    with pytest.raises(ValueError, match="row"):
        in_blocks(field.SHARED, broken)


def test_a_thread_keeps_the_error_state_of_its_caller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(field, "CORES", 2)
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("error")
        in_blocks(field.SHARED, lambda rows: np.full(rows.stop - rows.start, 1e308) * 10.0)


def test_points_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        field_mm(machine(), errors().motions, np.zeros((600, 2)))


@pytest.mark.parametrize("order", [1, 12, ROUGH_ORDER])
def test_motions_of_terms_with_levers_are_the_design_times_the_coefficients(order: int) -> None:
    terms, m, rng = smooth_terms(order), machine("w-Y-b-X-Z-t"), np.random.default_rng(order)
    size = np.array([5e-3 if t.component < 3 and t.order else 2e-5 for t in terms])
    coefficients = rng.normal(0.0, 1.0, len(terms)) * size
    points = rng.uniform(STROKE[:, 0] - 30.0, STROKE[:, 1] + 30.0, (700, 3))
    found = field_mm(m, lambda at: term_motions(terms, coefficients, at, STROKE), points)
    assert np.abs(found - design(m, terms, points) @ coefficients).max() < TOLERANCE_MM
