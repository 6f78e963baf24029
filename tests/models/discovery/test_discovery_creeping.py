"""An axis that creeps at one speed in all runs: its stick-slip is told from a vibration, from noise and from wrong readings."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.localization import Localization
from abbe.models.discovery.variance.creeping_axis import at_standstill, creep_speed, without_band
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, extra_variance
from abbe.models.effects.path import Path
from abbe.models.paths import helix_points
from tests.models.discovery.discovery_paths import CENTRE, bar, noise

HELIX = helix_points(CENTRE, 150.0, turns=8.0, n=540, axis=2)
RUNS = tuple(bar(f"h{back:d}", HELIX, 620.0 + 400.0 * back, feed=1200.0, back=back, test="ballbar_helix") for back in (False, True))
SIGMA = (4e-4, 4e-4)
SPEED = creep_speed(2, RUNS)


def found(
    *add: F1, seed: int = 3, known: tuple[VarianceFinding, ...] = (), alone: tuple[F1, ...] | None = None
) -> tuple[VarianceFinding, ...]:
    rest = tuple(e + a / s for e, a, s in zip(noise(RUNS, seed), add, SIGMA, strict=True))
    return extra_variance(RUNS, rest, SIGMA, known=known, alone=alone)


def teeth(path: Path, height_mm: float, period_mm: float, uneven: float) -> F1:
    """A saw-tooth over the travel of Z; the lengths of its teeth differ by a share of about four times ``uneven``."""
    travel = np.abs(path.at.q_mm[:, 2] - path.at.q_mm[0, 2])
    phase = travel / period_mm + uneven * np.sin(0.7 * travel / period_mm)
    return np.asarray(height_mm * (2.0 * (phase % 1.0) - 1.0) * path.look[:, 2])


def wave(path: Path, frequency_hz: float, swell: float = 0.0) -> F1:
    """A vibration of Z of 1 um; its amplitude swells and fades by the share ``swell`` every 17 s."""
    t = path.at.t_s - path.at.t_s[0]
    return np.asarray(
        1e-3 * (1.0 + swell * np.sin(t / 17.0 * 2.0 * np.pi)) * np.sin(2.0 * np.pi * frequency_hz * t + 1.0) * path.look[:, 2]
    )


def test_z_of_a_helix_creeps_at_one_speed_and_x_does_not() -> None:
    assert SPEED is not None
    assert pytest.approx(0.62, abs=0.01) == SPEED
    assert creep_speed(0, RUNS) is None


@pytest.mark.parametrize(("period_mm", "uneven"), [(0.17, 0.5), (0.11, 0.3), (0.21, 0.2)])
def test_teeth_of_unequal_length_are_a_stick_slip_and_no_vibration(period_mm: float, uneven: float) -> None:
    assert SPEED is not None
    only = found(*(teeth(p, 1e-3, period_mm, uneven) for p in RUNS))
    assert [f.label for f in only] == ["stick_slip:Z"]
    seen = only[0].strength * np.exp(-((SPEED / only[0].parameters["v_c"]) ** 2))  # at the one speed
    assert seen == pytest.approx(1.0, rel=0.2)
    assert only[0].location.period_s is None


@pytest.mark.parametrize("swell", [0.0, 0.4])
def test_a_vibration_that_swells_and_fades_stays_a_vibration(swell: float) -> None:
    only = found(*(wave(p, 37.3, swell) for p in RUNS))
    assert [f.label for f in only] == ["vibration:Z"]
    assert only[0].strength == pytest.approx(1.0, rel=0.15)


def test_harmonics_that_are_aliased_onto_the_line_make_no_saw_tooth() -> None:
    """At a third of the sampling rate, the second and fourth harmonic have the frequency of the line itself."""
    rate = (RUNS[0].n - 1) / float(np.ptp(RUNS[0].at.t_s))
    assert [f.label for f in found(*(wave(p, rate * (4.0 + 1.0 / 3.0) + 0.004) for p in RUNS))] == ["vibration:Z"]


def test_scatter_in_one_of_two_runs_is_no_stick_slip() -> None:
    one = teeth(RUNS[0], 1e-3, 0.17, 0.5)
    assert not [f for f in found(one, np.zeros(RUNS[1].n)) if f.name == "stick_slip"]


def test_noise_alone_has_no_name() -> None:
    assert not [f for seed in range(12) for f in found(*(np.zeros(p.n) for p in RUNS), seed=seed)]


def test_readings_of_a_known_stick_slip_are_no_outliers() -> None:
    rng = np.random.default_rng(6)
    wrong = tuple((rng.uniform(size=p.n) < 0.03).astype(float) for p in RUNS)
    add = [6e-3 * w * rng.choice([-1.0, 1.0], w.size) for w in wrong]
    stick = VarianceFinding("stick_slip", "Z", 6.0, 1.0, {"v_c": 2.9}, 50.0, Localization())
    assert [f.label for f in found(*add, alone=wrong)] == ["bar_outliers"]
    assert not found(*add, alone=wrong, known=(stick,))


@pytest.mark.parametrize("speed_mm_s", [1.0, 2.0, 3.9, 4.5])
def test_height_at_standstill_gives_the_same_teeth_at_the_one_speed(speed_mm_s: float) -> None:
    height, u, v_c = at_standstill(2.0, 0.1, speed_mm_s)
    assert height * np.exp(-((speed_mm_s / v_c) ** 2)) == pytest.approx(2.0)
    assert u > 0.1
    assert v_c >= speed_mm_s


def test_a_run_too_short_for_a_band_keeps_its_residuals() -> None:
    short = bar("two", HELIX[:2], 620.0, feed=1200.0, back=False, test="ballbar_helix")
    assert without_band(7.0, 2, short, np.ones(short.n)).tolist() == [1.0] * short.n
