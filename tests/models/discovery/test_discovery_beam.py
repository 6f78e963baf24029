"""A misaligned beam scales what it reads with one sign in all set-ups, and for as long as it stays; air does neither."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import Pick, gain_of, taken
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.discover import discover
from abbe.models.discovery.selection import EXCLUDED
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.columns import AIR_PER_K
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import CENTRE, MACHINE, campaign, laser

BEAM = next(e for e in CATALOGUE if e.name == "laser_cosine")
FEW = tuple(e for e in CATALOGUE if e.name in ("laser_cosine", "air_refraction", "bar_thermal", "contour_lag"))
BARS = tuple(replace(p, look=(p.at.q_mm - CENTRE) / p.radius_mm) for p in campaign() if p.kind == "bar")
LASERS = tuple(laser(f"{d}{k}", d, 2600.0 + 1500.0 * i + 500.0 * k) for i, d in enumerate(("ppp", "npp", "pnp", "ppn")) for k in (0, 1))


def case_with(added_mm: Callable[[Path], F1]) -> Case:
    """Circles and four diagonals, two runs each, on a straight machine whose laser adds something."""
    rng = np.random.default_rng(8)
    runs = []
    for p in (*BARS, *LASERS):
        reading = (3e-4 if p.kind == "bar" else 2e-4) * rng.standard_normal(p.n) + (added_mm(p) if p.kind == "laser" else 0.0)
        runs.append(CaseRun(p, "identify", np.round(reading, 5), np.ones(p.n, dtype=bool)))
    return Case(
        "beam",
        MACHINE,
        frozenset({"rigid6", "setup_centre_offset", "mirror_tilt"}),
        tuple(runs),
        {"bar": 1e-5, "laser": 1e-5},
    )


def askew(squares: dict[str, float]) -> Case:
    """Beams whose angle has this square, mrad^2, by set-up."""
    return case_with(lambda p: np.asarray(0.5e-6 * squares[p.setup] * p.travel_mm))


def free_and_signed(case: Case) -> tuple[float, float]:
    """Gain of the beam with coefficients of any sign, and with those of one sign."""
    problem = whiten(case, baseline_of(case))
    nothing = taken(problem, [])
    free = gain_of(problem, Pick(replace(BEAM, name="free", one_sign=False), ""), nothing)
    return free, gain_of(problem, Pick(BEAM, ""), nothing)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_beams_of_one_sign_gain_as_much_as_free_ones(sign: float) -> None:
    free, signed = free_and_signed(askew({"Lppp": 9.0 * sign, "Lnpp": 4.0 * sign, "Lpnp": 16.0 * sign, "Lppn": 6.0 * sign}))
    assert free > 200.0
    assert signed == pytest.approx(free, rel=0.01)


def test_scales_of_both_signs_are_no_beams() -> None:
    free, signed = free_and_signed(askew({"Lppp": 9.0, "Lnpp": -9.0, "Lpnp": -9.0, "Lppn": 9.0}))
    assert free > 200.0
    assert signed < 0.9 * free


def air(p: Path) -> F1:
    """Air that is colder and then warmer than the laser assumes; its course is no sine."""
    angle = 2.0 * np.pi * p.at.t_s / 9000.0
    return np.asarray(AIR_PER_K * 4.0 * (np.cos(angle) + 0.2 * np.cos(3.2 * angle)) * p.travel_mm)


def test_air_that_changes_from_setup_to_setup_is_not_a_beam() -> None:
    found = discover(case_with(air), FEW)
    assert [e.label for e in found.effects] == ["air_refraction"]


def test_a_misaligned_beam_is_named_with_its_size() -> None:
    found = discover(askew({"Lppp": 9.0, "Lnpp": 9.0, "Lpnp": 9.0, "Lppn": 9.0}), FEW)
    assert [e.label for e in found.effects] == ["laser_cosine"]
    assert found.effects[0].strength == pytest.approx(3.0, abs=0.5)
    more = {label for label, deficit in found.effects[0].alternatives if deficit > 0.5 * EXCLUDED}
    assert not more  # air has more unknowns than four beams: that it may deviate from its formula is no reason to believe in it


def test_air_beside_a_misaligned_beam_has_its_name() -> None:
    found = discover(case_with(lambda p: air(p) + 20e-6 * p.travel_mm), FEW)
    assert {e.label for e in found.effects} == {"laser_cosine", "air_refraction"}
