"""The ball-bar's word on a new table: every place has to agree, and no axis is called proved whose wrong sign it could not have seen."""

from __future__ import annotations

from itertools import permutations, product

import numpy as np
import pytest

from abbe.models.compensation.sign_probe import Shift, bar_shift, expected_changes, probe, sign_proof, step_tables
from abbe.models.compensation.tables import NineTables
from abbe.models.paths import helix_points

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
    observed = passed = 0
    for _ in range(300):
        tables = smooth(rng, rng.uniform(0.002, 0.02))
        each = expected_changes(PLACES, CENTRE, None, tables)
        assert probe(each, zero, read(tables, rng)).agrees
        for signs in product((1, -1), repeat=3):
            turned = [k for k in range(3) if signs[k] < 0]
            if len(turned) != 1:
                continue
            found = probe(each, zero, read(with_signs(tables, signs), rng))
            if found.observed[turned[0]]:
                observed, passed = observed + 1, passed + found.agrees
    assert observed > 500
    assert passed == 0


def test_exchanged_axes_and_other_units_are_found():
    rng = np.random.default_rng(12)
    zero = np.zeros(len(PLACES))
    for _ in range(100):
        tables = smooth(rng, 0.01)
        each = expected_changes(PLACES, CENTRE, None, tables)
        if not all(probe(each, zero, zero).observed):
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
    assert calm.observed == (False, False, False)
    assert "too small to prove the sign of X, Y, Z" in calm.text
    assert not probe(each, zero, each.sum(axis=1) + 0.08).agrees
    assert not probe(each, zero, np.full(len(PLACES), np.nan)).agrees


def test_the_change_is_between_old_and_new():
    rng = np.random.default_rng(14)
    old, new = smooth(rng, 0.01), smooth(rng, 0.01)
    step = expected_changes(PLACES, CENTRE, old, new)
    whole = expected_changes(PLACES, CENTRE, None, new) - expected_changes(PLACES, CENTRE, None, old)
    assert step == pytest.approx(whole, abs=1e-12)
    with pytest.raises(ValueError, match="one of each per position"):
        probe(step, np.zeros(3), np.zeros(12))


STEP, U = 0.010, 0.0002


def places(n: int = 24) -> np.ndarray:
    k = np.arange(n) + 0.5
    z = k / n
    turn = 2.399963 * k
    return np.column_stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z])


def shift(response: np.ndarray, axis: int, rng: np.random.Generator, *, drift_mm: float = 0.0005, noise_mm: float = U) -> Shift:
    """Readings of exact distances from a cup off the centre, on a machine whose tables do ``response`` (3, 3); drift along Z with time."""
    out, cup = places(), np.array([0.012, -0.031, 0.02])

    def read(moved: np.ndarray, t: float) -> np.ndarray:
        tool = 100.0 * out + moved + np.array([0.0, 0.0, drift_mm * t])
        return np.linalg.norm(tool - cup, axis=1) - 100.0 + noise_mm * rng.standard_normal(len(out))

    none = np.zeros(3)
    return bar_shift(out, read(none, 0.0), read(STEP * response[:, axis], 1.0), read(none, 2.0), U)


def proof(response: np.ndarray, seed: int, **more: float):
    rng = np.random.default_rng(seed)
    return sign_proof(STEP, (shift(response, 0, rng, **more), shift(response, 1, rng, **more), shift(response, 2, rng, **more)))


def test_a_control_that_does_what_is_written_is_proved():
    for seed in range(200):
        assert proof(np.eye(3), seed).proved


def test_every_sign_and_every_exchange_of_axes_is_found():
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        response = np.zeros((3, 3))
        for a in range(3):
            response[order[a], a] = signs[a]
        found = proof(response, 7)
        wrong = [a for a in range(3) if order[a] != a or signs[a] < 0]
        assert [f[0] for f in found.faults] == ["XYZ"[a] for a in wrong]
        for text, a in zip(found.faults, wrong, strict=True):
            assert ("the sign is reversed" in text) == (signs[a] < 0)
            assert (f"it moves {'XYZ'[order[a]]}" in text) == (order[a] != a)


@pytest.mark.parametrize(
    ("ratio", "word"), [(25.4, "inch"), (1 / 25.4, "no effect"), (0.0, "no effect"), (0.5, "times the step"), (2.0, "times the step")]
)
def test_units_and_dead_tables_are_found(ratio, word):
    for seed in range(20):
        found = proof(ratio * np.eye(3), seed)
        assert len(found.faults) == 3
        assert all(word in text for text in found.faults), found.faults


def test_one_axis_alone_is_named():
    response = np.diag([1.0, -1.0, 1.0])
    assert proof(response, 1).faults == ("Y: the sign is reversed",)


def test_noise_that_hides_the_step_proves_nothing():
    found = proof(np.eye(3), 3, noise_mm=0.01)
    assert len(found.faults) == 3
    assert all("proves nothing" in text for text in found.faults)


def test_the_uncertainty_covers():
    off = [
        np.abs(proof(np.eye(3), seed, drift_mm=0.0).response - np.eye(3)) / proof(np.eye(3), seed, drift_mm=0.0).u for seed in range(200)
    ]
    assert 0.9 < float(np.mean(np.array(off) < 2.0)) <= 1.0


def test_places_on_one_circle_are_refused():
    turn = np.linspace(0, 6, 12)
    flat = np.column_stack([np.cos(turn), np.sin(turn), 0 * turn])
    with pytest.raises(ValueError, match="six or more positions"):
        bar_shift(flat, turn, turn, turn, U)


def test_the_step_rises_from_the_reference_and_leaves_the_rest():
    grid = np.linspace(0.0, 600.0, 25)
    none = NineTables((grid,) * 3, (np.zeros((25, 3)),) * 3, (np.zeros((25, 3)),) * 3)
    made = step_tables(none, 1, STEP, 200.0, 400.0)
    at = np.array([[x, y, z] for x, y, z in product((0.0, 200.0, 300.0, 400.0), repeat=3)])
    correction = made.correction_at(at)
    assert np.array_equal(correction[:, [0, 2]], np.zeros((len(at), 2)))
    assert np.allclose(correction[:, 1], np.where(at[:, 1] >= 200.0, STEP, 0.0))
    assert made.correction_mm[1][0, 1] == 0.0
    assert none.correction_mm[1][:, 1].max() == 0.0
    for low, high in ((10.0, 400.0), (200.0, 700.0)):
        with pytest.raises(ValueError, match="must lie on the grid and leave one grid interval"):
            step_tables(none, 1, STEP, low, high)
