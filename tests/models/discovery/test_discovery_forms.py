"""True forms of structures without a name: a wave that is no sine, and a ball whose lobes end at its poles, are each one structure."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import discover
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.path import Path
from tests.models.discovery.test_discovery_search import campaign

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
FEW = tuple(e for e in CATALOGUE if e.name in ("backlash", "cyclic_error", "cyclic_error_second", "spindle_thermal_drift", "bar_thermal"))


def with_reading(added_mm: Callable[[Path], F1]) -> Case:
    """The small campaign with something added to every reading."""
    case = campaign()
    runs = (replace(r, deviation_mm=None if r.deviation_mm is None else r.deviation_mm + added_mm(r.path)) for r in case.runs)
    return replace(case, runs=tuple(runs))


def left_over(found: Discovery) -> float:
    """Rms residual of the fitted runs over their noise."""
    return found.gaps["identify"].after_mm / found.gaps["identify"].floor_mm


@pytest.mark.parametrize("second", [0.2, 0.6] if LONG else [0.2])
def test_a_wave_on_the_clock_with_a_second_harmonic_is_one_structure(second: float) -> None:
    def sway(p: Path) -> F1:
        angle = 2.0 * np.pi * p.at.t_s / 47.0
        return np.asarray(2e-3 * p.look[:, 2] * (np.sin(angle) + second * np.sin(2.0 * angle + 1.0)))

    found = discover(with_reading(sway), FEW)
    assert found.verdict == "unknown"
    assert [label for label, _ in found.rejected if "wave in time" in dict(found.rejected)[label]] == ["unnamed_surge:Z"]
    assert found.location.period_s == pytest.approx(47.0, rel=0.01)
    assert left_over(found) < 1.03


def test_both_orders_of_an_interpolation_error_are_one_name() -> None:
    def wave(p: Path) -> F1:
        angle = 2.0 * np.pi * p.at.q_mm[:, 0] / 16.0
        return np.asarray(2e-3 * p.look[:, 0] * (np.sin(angle) + 0.4 * np.sin(2.0 * angle + 1.0)))

    found = discover(with_reading(wave), FEW)
    assert [e.label for e in found.effects] == ["cyclic_error:X"]
    assert "second harmonic" in found.effects[0].forms
    assert found.effects[0].parameters["pitch_mm"][0] == pytest.approx(16.0, rel=0.01)
    assert found.effects[0].strength == pytest.approx(2.0, abs=0.1)
    assert left_over(found) < 1.03


@pytest.mark.parametrize("lobes", [3, 4, 5] if LONG else [4])
def test_lobes_that_end_at_the_poles_of_the_ball_are_one_structure(lobes: int) -> None:
    """A sectoral harmonic of a sphere, cos(latitude)^m cos(m azimuth)."""

    def out_of_round(p: Path) -> F1:
        azimuth, level = np.arctan2(p.look[:, 1], p.look[:, 0]), np.hypot(p.look[:, 0], p.look[:, 1])
        return np.asarray(1.5e-3 * level**lobes * np.cos(lobes * azimuth + 0.7))

    found = discover(with_reading(out_of_round), FEW)
    assert found.verdict == "unknown"
    assert found.rejected[0][0] == f"unnamed_lobes:Z{lobes}"
    assert found.location.angular_lobes == lobes
    assert not any("unnamed_smooth" in label for label, _ in found.rejected)
    assert left_over(found) < 1.03
