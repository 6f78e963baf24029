"""Periods of screws in the displacements at the touched positions of an artefact."""

import os

import numpy as np
import pytest

from abbe.models.solvers.fine import SURE
from abbe.models.solvers.waves import Displacements, peaks

PITCH_MM = 56.8
SIGMA_MM = 3e-4
SEEDS = 6 if os.environ.get("ABBE_TEST_LONG") == "1" else 3


def touched(waves_um: dict[float, float], seed: int, scatter_um: float = 0.0) -> Displacements:
    """Displacements at six features a pitch apart in four poses on X and Y, less a straight line that nobody knows."""
    rng = np.random.default_rng(seed)
    place = np.concatenate([start + PITCH_MM * np.arange(6) for start in (103.1, 131.7, 74.9, 166.3)])
    at, axis = np.tile(place, 2), np.repeat([0, 1], place.size)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, len(waves_um)))
    true = sum(
        (1e-3 * size * np.sin(2.0 * np.pi * at / period + phase[axis, k]) for k, (period, size) in enumerate(waves_um.items())),
        1e-3 * scatter_um * rng.standard_normal(at.size),
    )
    line = np.stack([np.where(axis == a, v, 0.0) for a in (0, 1) for v in (np.ones(at.size), at - at.mean())], axis=1)
    known = (np.eye(at.size) - line @ np.linalg.pinv(line)) / SIGMA_MM**2
    return Displacements(axis, at, known @ (true + SIGMA_MM * rng.standard_normal(at.size)), known)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_two_periods_are_told_from_their_aliases(seed: int) -> None:
    found = [p for p in peaks(touched({10.0: 2.0, 40.0 / 3.0: 1.0}, seed)) if p.weight > SURE]
    assert [p.axes for p in found] == [(0, 1), (0, 1)]
    for p, period in zip(sorted(found, key=lambda p: -p.frequency), (10.0, 40.0 / 3.0), strict=True):
        assert abs(p.frequency - 1.0 / period) < 3.0 * p.u_frequency


@pytest.mark.parametrize("seed", range(SEEDS))
def test_scatter_from_position_to_position_is_no_sure_period(seed: int) -> None:
    assert max((p.weight for p in peaks(touched({}, seed, scatter_um=1.5))), default=0.0) < SURE


@pytest.mark.parametrize("seed", range(3))
def test_one_period_beside_scatter(seed: int) -> None:
    found = [p for p in peaks(touched({10.0: 2.5}, seed, scatter_um=0.5)) if p.weight > 0.5]
    assert len(found) == 1
    assert 1.0 / found[0].frequency == pytest.approx(10.0, abs=0.1)
