"""Export and import of random tables: no correction differs by more than half of the format's unit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.models.functions.motions import PLACES, SQUARENESS
from abbe.models.machine import AXES, Machine
from abbe.service.formats import skew
from abbe.service.formats.compare import places_mm
from abbe.service.formats.files import FormatSettings
from abbe.service.formats.model import AxisCurve, AxisTable, Compensation, Lattice, Motions, ProductTable, correction_at
from abbe.service.formats.registry import FORMATS, Format

MACHINE = Machine("w-X-Y-b-Z-t", np.array([[0.0, 600.0], [-400.0, 0.0], [-300.0, 100.0]]))
EXACT_MM = 1e-9


@st.composite
def cases(draw: st.DrawFn, form: Format) -> tuple[Compensation, FormatSettings]:
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    if form.limits.lines:
        return _commands(rng, form), FormatSettings(machine=MACHINE, decimals=draw(st.integers(3, 7)), reference_mm=(0.0, 0.0, 0.0))
    n = draw(st.integers(3, min(form.limits.points, 40)))
    decimals = draw(st.integers(3, 7))
    told = FormatSettings(
        reference_mm=None,
        decimals=decimals,
        machine=MACHINE,
        unit_mm=draw(st.sampled_from([1e-3, 1e-4])),
        magnification=draw(st.integers(1, 3)),
    )
    step = draw(st.integers(5, 500)) / 10
    even = form.limits.equidistant or draw(st.booleans())
    size = draw(st.sampled_from([1e-5, 0.003, 0.05]))
    if form.key in ("fanuc-pitch", "fanuc-lattice", "centroid"):
        told = replace(told, reference_mm=(0.0, 0.0, 0.0), largest_step=10**6)
    grids = [_grid(rng, n if not form.limits.lattice else min(n, 6), step, even) for _ in AXES]
    if form.limits.lattice:
        values = rng.uniform(-size, size, (*(g.size for g in grids), 3))
        return Compensation(lattice=Lattice((grids[0], grids[1], grids[2]), values)), told
    if form.limits.motions and (not form.limits.own or draw(st.booleans())):
        return Compensation(motions=_motions(rng, grids, size)), told
    pairs = [(a, o) for a in range(3) for o in range(3) if (a == o or form.limits.cross) and (a == o or draw(st.booleans()))]
    tables = tuple(
        _table(rng, a, o, grids[a], size, directional=form.limits.directional and a == o and draw(st.booleans())) for a, o in pairs
    )
    products = ()
    if form.limits.products and draw(st.booleans()):
        angle = AxisCurve("Y", grids[1], rng.uniform(-1, 1, grids[1].size) * size * 1e-3)
        products = (ProductTable("X", angle, AxisCurve("Z", grids[2], np.round(grids[2] - grids[2][0], 3))),)
    return Compensation(tables, products), told


def _commands(rng: np.random.Generator, form: Format) -> Compensation:
    lost = dict(zip(AXES, rng.uniform(0.001, 0.05, 3).tolist(), strict=True)) if form.limits.lost_motion else {}
    tables = []
    for (axis, output), slope in zip(skew.PAIRS, rng.uniform(-1e-3, 1e-3, 3), strict=True):
        position = MACHINE.stroke_mm[AXES.index(axis)]
        tables.append(AxisTable(axis, output, position, slope * position, slope * position))
    return Compensation(tuple(tables) if form.limits.cross else (), lost_motion_mm=lost)


def _grid(rng: np.random.Generator, n: int, step: float, even: bool) -> np.ndarray:
    if even:
        return np.round(step * np.arange(n), 4)
    return np.round(np.cumsum(rng.uniform(0.5, 50.0, n)) - 100.0, 4)


def _table(rng: np.random.Generator, a: int, o: int, grid: np.ndarray, size: float, *, directional: bool) -> AxisTable:
    forward = rng.uniform(-size, size, grid.size)
    forward[0] = 0.0
    backward = rng.uniform(-size, size, grid.size) if directional else forward
    return AxisTable(AXES[a], AXES[o], grid, forward, backward)


def _motions(rng: np.random.Generator, grids: list[np.ndarray], size: float) -> Motions:
    curves = {
        n: AxisCurve(AXES[a], grids[a], rng.uniform(-size, size, grids[a].size) * (1.0 if c < 3 else 1e-3)) for n, (a, c) in PLACES.items()
    }
    return Motions(MACHINE, curves, {n: float(v) for n, v in zip(SQUARENESS, rng.uniform(-1e-4, 1e-4, 3), strict=True)})


def _unit(form: Format, told: FormatSettings) -> float:
    if form.key.startswith("fanuc"):
        return told.unit_mm * told.magnification
    return told.step_mm


@pytest.mark.parametrize("key", FORMATS)
@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_nothing_differs_by_more_than_half_a_unit(key: str, data: st.DataObject) -> None:
    form = FORMATS[key]
    comp, told = data.draw(cases(form))
    files = form.write(comp, told)
    found = form.read(files, told)
    half = 0.5 * _unit(form, told) + EXACT_MM
    if form.limits.motions and comp.motions is None:  # tables go out as the error motions they correct
        assert found.motions is not None
        for t in comp.tables:
            curve = found.motions.curves[f"E{t.output}{t.axis}"]
            assert np.abs(curve.value + t.forward_mm).max() <= half
        return
    _compare_tables(comp, found, half)
    assert dict(found.lost_motion_mm) == pytest.approx(dict(comp.lost_motion_mm), abs=half)
    for p, q in zip(comp.products, found.products, strict=True):
        assert (p.output, p.angle.axis, p.lever.axis) == (q.output, q.angle.axis, q.lever.axis)
        assert np.abs(p.angle.value - q.angle.value).max() <= half * 1e-3 + 1e-12
        assert np.abs(p.lever.value - q.lever.value).max() <= half
    if comp.lattice is not None:
        assert found.lattice is not None
        assert np.abs(comp.lattice.correction_mm - found.lattice.correction_mm).max() <= half
    if comp.motions is not None:
        assert found.motions is not None
        if not found.motions.squareness_rad:  # it stands in the straightness
            at = places_mm(comp)
            assert np.abs(correction_at(found, at) - correction_at(comp, at)).max() <= 5 * half
            return
        for n, c in comp.motions.curves.items():
            assert np.abs(c.value - found.motions.curves[n].value).max() <= (half if PLACES[n][1] < 3 else half * 1e-3 + 1e-12)
        assert found.motions.squareness_rad == pytest.approx(dict(comp.motions.squareness_rad), abs=half * 1e-3 + 1e-12)
    again = form.write(found, told)  # columns of two directions that are alike after rounding become one: from then on nothing changes
    assert form.write(form.read(again, told), told) == again


def _compare_tables(comp: Compensation, found: Compensation, half: float) -> None:
    wanted = {t.name: t for t in comp.tables}
    have = {t.name: t for t in found.tables}
    assert set(wanted) == set(have)
    for name, t in wanted.items():
        assert have[name].position_mm == pytest.approx(t.position_mm, abs=1e-3 if t.position_mm.size and half > 1e-4 else 2e-6)
        assert np.abs(have[name].forward_mm - t.forward_mm).max() <= half
        assert np.abs(have[name].backward_mm - t.backward_mm).max() <= half
