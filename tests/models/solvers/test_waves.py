"""Periods of screws in the displacements at the touched positions of an artefact."""

import os

import numpy as np
import pytest

from abbe.models.solvers.artefact import PRIORS
from abbe.models.solvers.fine import SURE, _waves, sure_periods
from abbe.models.solvers.waves import Displacements, Peak, gain_of_pairs, peaks

PITCH_MM = 56.8
SIGMA_MM = 3e-4
SEEDS = 6 if os.environ.get("ABBE_TEST_LONG") == "1" else 3


def touched(
    waves_um: dict[float, float], seed: int, scatter_um: float = 0.0, *, form: bool = False, pitch_mm: float = PITCH_MM
) -> Displacements:
    """Displacements at six features a pitch apart in four poses on X and Y; a straight line in them is unknown.

    ``form``: the places of the features are unknown, too; the poses are 0, 90, 180 and 270 degrees, so X and Y read the same features.
    """
    rng = np.random.default_rng(seed)
    place = np.concatenate([start + pitch_mm * np.arange(6) for start in (103.1, 131.7, 74.9, 166.3)])
    at, axis = np.tile(place, 2), np.repeat([0, 1], place.size)
    phase = rng.uniform(0.0, 2.0 * np.pi, (2, len(waves_um)))
    true = sum(
        (1e-3 * size * np.sin(2.0 * np.pi * at / period + phase[axis, k]) for k, (period, size) in enumerate(waves_um.items())),
        1e-3 * scatter_um * rng.standard_normal(at.size),
    )
    unknown = [np.where(axis == a, v, 0.0) for a in (0, 1) for v in (np.ones(at.size), at - at.mean())]
    if form:
        pose, column = np.divmod(np.tile(np.arange(place.size), 2), 6)
        side, turned = (axis + pose) % 2, pose >= 2
        feature = np.where(turned, 5 - column, column)
        unknown += [1.0 * ((axis == a) & (pose == p)) for a in (0, 1) for p in range(4)]
        unknown += [np.where(turned, -1.0, 1.0) * ((side == s) & (feature == c)) for s in (0, 1) for c in range(6)]
    hidden = np.stack(unknown, axis=1)
    known = (np.eye(at.size) - hidden @ np.linalg.pinv(hidden)) / SIGMA_MM**2
    return Displacements(axis, at, known @ (true + SIGMA_MM * rng.standard_normal(at.size)), known)


def test_the_evidence_of_a_pair_is_that_of_all_its_waves_at_once() -> None:
    data, frequency = touched({10.0: 2.0, 40.0 / 3.0: 1.0}, 1, form=True), np.array([0.03, 0.075, 0.1])
    waves = data.waves((0, 1), frequency)
    gain = gain_of_pairs(waves, data.h, data.information)
    for one, two in ((0, 1), (0, 2), (1, 2)):
        both = np.concatenate([waves[one], waves[two]], axis=1)
        whole, asked = np.eye(8) + both.T @ data.information @ both, both.T @ data.h
        assert gain[one, two] == pytest.approx(0.5 * asked @ np.linalg.solve(whole, asked) - 0.5 * np.linalg.slogdet(whole)[1], rel=1e-9)


def test_two_periods_are_found_where_only_both_axes_together_show_them() -> None:
    """The features' places are unknown, so almost any pair fits one axis alone: a search axis by axis finds 2 pairs of 8."""
    pairs = 0
    for seed in range(8):
        found = peaks(touched({10.0: 2.0, 40.0 / 3.0: 1.0}, seed, form=True))
        assert any(p.weight > SURE and abs(p.frequency - 0.1) < 3.0 * p.u_frequency for p in found), seed
        pairs += any(p.weight > 0.3 and abs(p.frequency - 0.075) < 3.0 * p.u_frequency for p in found)
    assert pairs >= 6


@pytest.mark.parametrize(("pitches", "least", "most"), [(4.0, -1e-9, 1e-9), (3.99, -1e-9, 4.0), (4.26, 50.0, np.inf), (4.5, 50.0, np.inf)])
def test_a_period_that_divides_the_pitch_is_hidden(pitches: float, least: float, most: float) -> None:
    """Such a wave only shifts each pose, and poses are unknown. What the readings show of it is in units of its prior."""
    period = 40.0 / 3.0
    data = touched({}, 1, form=True, pitch_mm=pitches * period)
    wave = data.waves((0, 1), np.array([1.0 / period]))[0]
    shown = np.linalg.eigvalsh(wave.T @ data.information @ wave)
    assert least <= shown[0]
    assert shown[-1] <= most


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


def test_only_a_period_without_rivals_is_named_and_only_once() -> None:
    """Every probable period has waves in the model; two waves stand for one period."""
    fine = _waves((Peak((0, 1), 0.1, 1e-4, 0.95), Peak((0,), 0.04, 1e-4, 0.6), Peak((1,), 0.13, 1e-4, 0.3)))
    assert {one.found_mm for one in fine} == {1.0 / 0.1, 1.0 / 0.04, 1.0 / 0.13}
    assert sure_periods(fine) == ((0, 10.0), (1, 10.0))
    variance = sum(one.sd_mm(PRIORS) ** 2 for one in fine if one.axis == 1 and one.phase == 0 and one.found_mm < 9.0)
    assert variance == pytest.approx(0.3 * PRIORS.wave_mm**2)
