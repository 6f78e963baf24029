"""Fast kernels against the plain chain (rule G with `numpy.interp`), for all 24 chains, with and without numba."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from abbe.models.functions.motions import ErrorMotions
from abbe.models.functions.table import Table
from abbe.models.geometry.chain import all_chains, deviation_mm
from abbe.models.machine import Machine
from tests.experiments.kernel import fast, kernel
from tests.experiments.kernel.table_machine import TableMachine, sampled

STROKE = np.array([[-50.0, 600.0], [100.0, 600.0], [0.0, 450.0]])
RANGE = np.array([[-40.0, 560.0], [100.0, 590.0], [-5.0, 450.0]])
NODES = (51, 2, 17)
TOLERANCE_MM = 1e-12
NO_NUMBA = "numba is not installed; the developers' lock has it"


@pytest.fixture(params=["numpy", "compiled", "all cores"])
def scattered(request, require):
    """All paths in turn; the compiled ones need the extra ``fast``."""
    if request.param == "numpy":
        return kernel.scattered
    require("numba", importlib.util.find_spec("numba") is not None, NO_NUMBA)
    from tests.experiments.kernel import compiled

    return partial(compiled.scattered, all_cores=request.param == "all cores")


def machine(chain="w-X-Y-b-Z-t", seed=1, squareness=(30e-6, -20e-6, 45e-6)):
    """Pivots, tool and tables at random; the tables do not cover the stroke, and each axis has another number of nodes."""
    rng = np.random.default_rng(seed)
    nominal = Machine(chain, STROKE, rng.uniform(-400, 400, (3, 3)), np.array([12.0, -30.0, -160.0]))
    tables = tuple(np.concatenate([rng.normal(0, 8e-3, (n, 3)), rng.normal(0, 30e-6, (n, 3))], axis=1) for n in NODES)
    return TableMachine(nominal, RANGE, tables, np.array(squareness))


def points(n, seed=2):
    """Inside and up to 100 mm outside the tables; of every seven points one is a node in all axes."""
    rng = np.random.default_rng(seed)
    p = rng.uniform(RANGE[:, 0] - 100, RANGE[:, 1] + 100, (n, 3))
    for a, count in enumerate(NODES):
        p[::7, a] = rng.choice(np.linspace(*RANGE[a], count), len(p[::7]))
    return p


def plain(tables, axes_mm):
    return deviation_mm(tables.machine, axes_mm, tables.motions(axes_mm))


@pytest.mark.parametrize("chain", all_chains())
def test_any_points_of_any_chain_are_those_of_the_plain_chain(chain, scattered):
    tables, p = machine(chain, all_chains().index(chain)), points(3000)
    expected = plain(tables, p)
    assert np.abs(expected).max() > 0.05
    assert np.abs(scattered(tables, p) - expected).max() < TOLERANCE_MM


def test_squareness_alone_is_position_times_angle_by_hand(scattered):
    tables = TableMachine(Machine("w-b-X-Y-Z-t", STROKE), RANGE, tuple(np.zeros((2, 6)) for _ in range(3)), np.array([1e-5, 2e-5, 3e-5]))
    expected = [[-1e-5 * 200 + 2e-5 * 900, -3e-5 * 900, 0.0]]
    np.testing.assert_allclose(scattered(tables, [[700.0, 200.0, 900.0]]), expected, rtol=1e-13)


def test_an_angle_alone_turns_lever_and_tool_by_hand(scattered):
    values = np.zeros((3, 2, 6))
    values[0, :, 5] = 1e-5, 3e-5  # ECX
    nominal = Machine("w-X-b-Y-Z-t", STROKE, np.array([[5.0, 7.0, 0.0], [0, 0, 0], [0, 0, 0]]), np.array([1.0, 2.0, 3.0]))
    tables = TableMachine(nominal, np.array([[0.0, 400.0]] * 3), tuple(values))
    ecx = 1.5e-5
    expected = [[-ecx * (50.0 + 2.0 - 7.0), ecx * (100.0 + 1.0 - 5.0), 0.0]]
    np.testing.assert_allclose(scattered(tables, [[100.0, 50.0, 20.0]]), expected, rtol=1e-13)


@pytest.mark.parametrize("n", [0, 1, 2, 4095, 4096, 4097, 16385])
def test_any_number_of_points_fills_exactly_its_rows(n, scattered):
    tables, p = machine(), points(n)
    room = np.full((n + 2, 3), 7.0)
    result = scattered(tables, p, room[1:-1])
    assert np.shares_memory(result, room) or n == 0
    assert (room[[0, -1]] == 7.0).all()
    assert np.abs(result - plain(tables, p)).max(initial=0.0) < TOLERANCE_MM


def test_block_size_changes_nothing():
    tables, p = machine(), points(1000)
    assert (kernel.scattered(tables, p, block=1) == kernel.scattered(tables, p)).all()


@pytest.mark.parametrize("what", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("chain", ["w-X-Y-b-Z-t", "w-b-Z-Y-X-t"])
def test_nan_or_infinite_in_gives_nan_out_in_its_own_row_only(chain, axis, what, scattered):
    tables, p = machine(chain), points(100)
    expected = plain(tables, p)
    p[[3, 99], axis] = what
    rest = np.delete(np.arange(100), [3, 99])
    with np.errstate(invalid="ignore"):  # the plain chain's levers are 0 times infinity
        of_chain = plain(tables, p)
    for result in (scattered(tables, p), of_chain):
        assert np.isnan(result[[3, 99]]).all()
        assert np.abs(result[rest] - expected[rest]).max() < TOLERANCE_MM


def test_read_only_and_strided_positions_are_taken(scattered):
    tables, p = machine(), points(50)
    wide = np.zeros((50, 5))
    wide[:, 1:4] = p
    p.setflags(write=False)
    assert (scattered(tables, p) == scattered(tables, wide[:, 1:4])).all()


@pytest.mark.parametrize("out", [np.zeros((9, 3)), np.zeros((10, 3), np.float32), np.zeros((3, 10)).T], ids=["rows", "float32", "order"])
def test_an_out_that_does_not_fit_is_refused(out, scattered):
    with pytest.raises(ValueError, match="out must be"):
        scattered(machine(), points(10), out)


def test_out_must_not_be_the_positions(scattered):
    p = points(10)
    with pytest.raises(ValueError, match="apart"):
        scattered(machine(), p, p)


def test_an_out_that_is_no_array_is_refused(scattered):
    with pytest.raises(ValueError, match=r"out must be .* got list"):
        scattered(machine(), points(1), [[0.0, 0.0, 0.0]])


def test_plain_motions_take_lists_and_refuse_other_shapes():
    tables, p = machine(), points(5)
    assert (tables.motions(p.tolist()) == tables.motions(p)).all()
    for wrong in ([1.0, 2.0, 3.0], np.zeros((2, 2)), np.zeros((1, 2, 3))):
        with pytest.raises(ValueError, match=r"table machine: axes_mm must have shape \(n, 3\)"):
            tables.motions(wrong)


@pytest.mark.parametrize("axes", [np.zeros(3), np.zeros((4, 2)), np.zeros((2, 3, 3))])
def test_positions_of_another_shape_are_refused(axes, scattered):
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        scattered(machine(), axes)
    with pytest.raises(ValueError, match=r"\(n, 3\)"):
        fast.scattered(machine(), axes)


def test_without_numba_the_automatic_choice_is_numpy(monkeypatch):
    monkeypatch.setitem(sys.modules, "tests.experiments.kernel.compiled", None)
    monkeypatch.delattr(sys.modules["tests.experiments.kernel"], "compiled", raising=False)
    monkeypatch.setattr(fast, "WORTH_COMPILING", 5)
    fast.compiled_path.cache_clear()
    try:
        tables, p = machine(), points(10)
        assert fast.path() == "numpy"
        assert (fast.scattered(tables, p) == kernel.scattered(tables, p)).all()
    finally:
        fast.compiled_path.cache_clear()


def test_with_numba_the_automatic_choice_compiles_when_points_are_many(require, monkeypatch):
    require("numba", importlib.util.find_spec("numba") is not None, NO_NUMBA)
    found, used = fast.compiled_path(), []
    spied = replace(
        found,
        scattered=lambda *a, **k: used.append("scattered") or found.scattered(*a, **k),
    )
    tables, p = machine(), points(12)
    monkeypatch.setattr(fast, "WORTH_COMPILING", 12)
    monkeypatch.setattr(fast, "compiled_path", lambda: spied)
    assert fast.path() == "compiled, 1 thread"
    assert np.abs(fast.scattered(tables, p) - kernel.scattered(tables, p)).max() < TOLERANCE_MM
    assert used == ["scattered"]
    fast.scattered(tables, p[:11])


def test_tables_sampled_from_functions_are_those_functions_at_the_nodes():
    x = np.linspace(*STROKE[0], 51)
    table = Table(x, 1e-3 * np.sin(x / 90.0))
    errors = ErrorMotions({"EYX": table, "EBZ": Table(STROKE[2], [1e-6, 9e-6])}, {"B0Z": 4e-5})
    nominal = Machine("w-b-Y-X-Z-t", STROKE, tool_mm=np.array([0.0, 5.0, -100.0]))
    tables = sampled(nominal, errors.functions, errors.squareness_rad)
    p = np.random.default_rng(3).uniform(STROKE[:, 0], STROKE[:, 1], (200, 3))
    expected = deviation_mm(nominal, p, errors.motions(p))
    assert np.abs(kernel.scattered(tables, p) - expected).max() < TOLERANCE_MM


def test_what_is_no_table_machine_is_refused():
    nominal, good = Machine("w-X-Y-b-Z-t", STROKE), np.zeros((3, 6))
    with pytest.raises(ValueError, match="EXX@reverse"):
        sampled(nominal, {"EXX@reverse": np.sin})
    with pytest.raises(ValueError, match="expected 2 or more"):
        sampled(nominal, {}, nodes=1)
    with pytest.raises(ValueError, match="table Y"):
        TableMachine(nominal, RANGE, (good, np.full((3, 6), np.nan), good))
    with pytest.raises(ValueError, match="table Z"):
        TableMachine(nominal, RANGE, (good, good, np.zeros((1, 6))))
    with pytest.raises(ValueError, match="3 tables"):
        TableMachine(nominal, RANGE, (good, good))
    with pytest.raises(ValueError, match="range_mm"):
        TableMachine(nominal, RANGE[:, ::-1], (good, good, good))
    with pytest.raises(ValueError, match="block"):
        kernel.scattered(machine(), points(3), block=0)


def test_a_table_machine_cannot_be_changed_from_outside():
    values = np.zeros((4, 6))
    tables = TableMachine(Machine("w-X-Y-b-Z-t", STROKE), RANGE, (values, values, values))
    values[:] = 1.0
    assert (kernel.scattered(tables, [[100.0, 200.0, 300.0]]) == 0.0).all()
