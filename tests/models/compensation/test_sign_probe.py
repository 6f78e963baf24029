"""The ball-bar's word on a new table: every place has to agree, and no axis is called proved whose wrong sign it could not have seen."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from abbe.models.compensation.sign_probe import expected_changes, probe
from abbe.models.compensation.tables import NineTables
from abbe.models.paths.helix import helix_points

CENTRE = np.array([300.0, 250.0, 157.5])
PLACES = helix_points(CENTRE, 135.0, turns=3.0, n=12, law="area", axis=2)
GRID = tuple(np.linspace(0.0, length, n) for length, n in ((600.0, 25), (500.0, 21), (450.0, 19)))


def smooth(rng: np.random.Generator, size_mm: float) -> NineTables:
    """Nine curves of low order, zero at the start of each axis."""
    curves = []
    for grid in GRID:
        x = grid / grid[-1]
        shape = np.column_stack([x, np.sin(np.pi * x) * x, np.sin(2.0 * np.pi * x)])
        curves.append(size_mm * shape @ rng.normal(size=(3, 3)))
    none = tuple(np.zeros_like(c) for c in curves)
    return NineTables((GRID[0], GRID[1], GRID[2]), (curves[0], curves[1], curves[2]), (none[0], none[1], none[2]))


def with_signs(tables: NineTables, signs: tuple[int, int, int]) -> NineTables:
    x, y, z = (c * np.array(signs) for c in tables.correction_mm)
    return NineTables(tables.position_mm, (x, y, z), tables.u_mm)


def read(tables: NineTables, rng: np.random.Generator) -> np.ndarray:
    """What a bar reads more when tables come into force, with 0.2 um of noise each time and 0.5 um of drift."""
    each = expected_changes(PLACES, CENTRE, None, tables)
    return each.sum(axis=1) + rng.normal(0.0, 0.0003, len(PLACES)) + rng.uniform(-0.0005, 0.0005)


def test_an_honest_control_is_believed_and_every_wrong_sign_of_a_seen_axis_is_found():
    rng = np.random.default_rng(11)
    zero = np.zeros(len(PLACES))
    seen = passed = 0
    for _ in range(300):
        tables = smooth(rng, rng.uniform(0.002, 0.02))
        each = expected_changes(PLACES, CENTRE, None, tables)
        assert probe(each, zero, read(tables, rng)).agrees
        for signs in product((1, -1), repeat=3):
            turned = [k for k in range(3) if signs[k] < 0]
            if len(turned) != 1:
                continue
            found = probe(each, zero, read(with_signs(tables, signs), rng))
            if found.seen[turned[0]]:
                seen, passed = seen + 1, passed + found.agrees
    assert seen > 500
    assert passed == 0


def test_exchanged_axes_and_other_units_are_found():
    rng = np.random.default_rng(12)
    zero = np.zeros(len(PLACES))
    for _ in range(100):
        tables = smooth(rng, 0.01)
        each = expected_changes(PLACES, CENTRE, None, tables)
        if not all(probe(each, zero, zero).seen):
            continue
        for factor in (-1.0, 0.0, 0.5, 25.4, 1000.0):
            assert not probe(each, zero, factor * read(tables, rng)).agrees
        x, y, z = (c[:, [1, 2, 0]] for c in tables.correction_mm)
        other = NineTables(tables.position_mm, (x, y, z), tables.u_mm)
        assert not probe(each, zero, read(other, rng)).agrees


def test_a_change_too_small_to_prove_is_still_refuted_by_another_one():
    tables = smooth(np.random.default_rng(13), 0.0003)
    each = expected_changes(PLACES, CENTRE, None, tables)
    zero = np.zeros(len(PLACES))
    calm = probe(each, zero, each.sum(axis=1))
    assert calm.agrees
    assert calm.seen == (False, False, False)
    assert "too small to prove the sign of X, Y, Z" in calm.text
    assert not probe(each, zero, each.sum(axis=1) + 0.08).agrees
    assert not probe(each, zero, np.full(len(PLACES), np.nan)).agrees


def test_the_change_is_between_old_and_new():
    rng = np.random.default_rng(14)
    old, new = smooth(rng, 0.01), smooth(rng, 0.01)
    step = expected_changes(PLACES, CENTRE, old, new)
    whole = expected_changes(PLACES, CENTRE, None, new) - expected_changes(PLACES, CENTRE, None, old)
    assert step == pytest.approx(whole, abs=1e-12)
    with pytest.raises(ValueError, match="same places"):
        probe(step, np.zeros(3), np.zeros(12))
