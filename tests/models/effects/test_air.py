"""Warm, thin air makes a laser read short: Edlen's equation, the catalogue, hidden effects and the simulated instrument say the same."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.columns import AIR_PER_K
from abbe.models.effects.self_test import DEAD_PATH_MM, probe_paths
from abbe.simulators.hidden.instrument import AIR_PPM_PER_K
from abbe.simulators.scenario import from_dict
from abbe.simulators.truth.surroundings import Air
from abbe.simulators.world import World
from tests.simulators.conftest import QUIET

BY_NAME = {e.name: e for e in CATALOGUE}
PUBLISHED = {(20, 80): 21458.0, (20, 100): 26824.4, (20, 120): 32191.6, (10, 100): 27774.7, (30, 100): 25937.2}
"""(n - 1) 1e8 of dry air with 450 ppm CO2 at 633 nm by temperature in C and pressure in kPa: Birch and Downs, Metrologia 30 (1993) 155 and
31 (1994) 315; the same in table 1 of Ciddor, Applied Optics 35 (1996) 1566."""


def edlen(t_c: float, p_pa: float, vapour_pa: float = 0.0) -> float:
    """n - 1 at 633 nm by the equation of Edlen as Birch and Downs updated it."""
    s = 1.0 / 0.633**2
    standard = 1e-8 * (8342.54 + 2406147.0 / (130.0 - s) + 15998.0 / (38.9 - s))
    dense = (1.0 + 1e-8 * (0.601 - 0.00972 * t_c) * p_pa) / (1.0 + 0.0036610 * t_c)
    return standard * p_pa / 96095.43 * dense - 1e-10 * vapour_pa * (3.7345 - 0.0401 * s)


def counted_mm(way_mm: float, t_c: float, p_pa: float = 101325.0, vapour_pa: float = 1100.0) -> float:
    """What a counter shows that was told the wavelength at 20 C and 101325 Pa: n D over the wavelength in vacuum."""
    return way_mm * (1.0 + edlen(t_c, p_pa, vapour_pa)) / (1.0 + edlen(20.0, 101325.0, vapour_pa))


@pytest.mark.parametrize("state", PUBLISHED)
def test_edlen_gives_the_published_indices(state: tuple[int, int]) -> None:
    t_c, p_kpa = state
    assert edlen(t_c, 1e3 * p_kpa) == pytest.approx(PUBLISHED[state] * 1e-8, abs=2e-8)


def test_a_metre_reads_short_in_warm_air_and_long_under_pressure() -> None:
    published = (PUBLISHED[30, 100] - PUBLISHED[10, 100]) * 1e-8 / 20.0
    assert published == pytest.approx(-0.92e-6, abs=0.005e-6)
    per_k = (counted_mm(1000.0, 21.0) - counted_mm(1000.0, 19.0)) / 2.0
    assert per_k == pytest.approx(-0.93e-3, abs=0.01e-3)  # vapour as it is; at one relative humidity -0.96
    assert per_k == pytest.approx(1000.0 * AIR_PER_K, rel=0.02)
    assert counted_mm(1000.0, 20.0, 101425.0) - 1000.0 == pytest.approx(0.27e-3, abs=0.01e-3)


def test_catalogue_hidden_effects_and_instrument_agree_in_recorded_readings() -> None:
    """The air warms up by 3 K while each simulated laser looks along 400 mm; the catalogue's column read off each gives +3 K."""
    rise_k, way_mm = 3.0, 400.0
    for reading in (_hidden_mm(rise_k, way_mm), _instrument_mm(rise_k, way_mm)):
        assert reading < 0.0
        assert reading / (AIR_PER_K * way_mm) == pytest.approx(rise_k, rel=0.04)


def test_a_warming_hall_is_not_called_cooling() -> None:
    """Readings of a dead path in air that warms up by 5 K/h: the catalogue's size has the sign of the warming."""
    w = _looking({"name": "dead_path", "key": "", "parameters": {"strength": 5.0}})
    t_s, reading = np.empty(20), np.empty(20)
    for i in range(t_s.size):
        w.advance(w.time_s + 30.0)
        t_s[i], reading[i] = w.time_s, w.laser.output().displacement_mm
    assert reading[-1] < reading[0]
    effect, path = BY_NAME["dead_path"], next(p for p in probe_paths() if p.kind == "laser")
    per_hour = effect.signal((path,), "", {})[0][-1] / (path.at.t_s[-1] - path.at.t_s[0]) * 3600.0 * 900.0 / DEAD_PATH_MM
    found = effect.strength(np.atleast_1d(_slope(t_s / 3600.0, reading) / per_hour), {})
    assert found == pytest.approx(5.0, rel=0.02)
    assert "down while the air warms up" in effect.signature
    assert "short in warm air" in BY_NAME["air_refraction"].signature


def _slope(x: F1, y: F1) -> float:
    return float(np.polyfit(x, y, 1)[0])


def _looking(hidden: dict[str, object] | None = None) -> World:
    """A world without errors and noise whose laser looks along X, zeroed, with its environmental compensation on."""
    w = World(from_dict({"seed": 4, "magnitudes": QUIET, **({"hidden": hidden} if hidden else {})}))
    _drive(w, 100.0)
    w.laser.mount(np.array([1.0, 0.0, 0.0]), w.tool_position())
    w.laser.compensate(1)
    w.laser.zero(w.tool_position())
    return w


def _drive(w: World, x_mm: float) -> None:
    w.controller.move(np.array([x_mm, 250.0, 225.0]), 6000.0)
    w.advance(w.time_s + 30.0)


def _hidden_mm(rise_k: float, way_mm: float) -> float:
    """What a hidden warm hall adds to a way: at the top of its wave."""
    w = _looking({"name": "air_refraction", "key": "", "parameters": {"strength": rise_k, "period_s": 6000.0, "phase": 0.0}})
    _drive(w, 100.0 + way_mm)
    w.advance(1500.0)
    assert AIR_PPM_PER_K < 0.0
    return float(w.laser.output().displacement_mm - way_mm)


def _instrument_mm(rise_k: float, way_mm: float) -> float:
    """What the laser without compensation shows less of the same way once the gate of the shop is open."""
    w = _looking()
    w.laser.compensate(0)
    w.laser.zero(w.tool_position())
    _drive(w, 100.0 + way_mm)
    before, was = float(w.laser.output().displacement_mm), w.laser.output().air.temperature_c
    w.air.warmer_c += rise_k
    w.advance(w.time_s + 0.5)
    after = w.laser.output()
    assert isinstance(w.air, Air)
    assert after.air.temperature_c - was == pytest.approx(rise_k, abs=0.01)
    return float(after.displacement_mm) - before
