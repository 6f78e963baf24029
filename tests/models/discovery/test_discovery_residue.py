"""Which weak names are only what a strong effect's formula leaves, and that an answer of them stays plain JSON."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from abbe.models.discovery.answer import NamedEffect
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.case import Case
from abbe.models.discovery.discover import discover
from abbe.models.discovery.finding import _confounded, _of_scatter, _with_ties
from abbe.models.discovery.localization import Localization
from abbe.models.discovery.residues import residues, ties, too_smooth
from abbe.models.discovery.solved_model import solve, whole_rest
from abbe.models.discovery.variance.scatter_effects import VarianceFinding
from abbe.models.discovery.whitened_problem import whiten
from abbe.models.effects.catalogue import CATALOGUE
from abbe.models.effects.effect import Effect
from abbe.service.discovery.discovery_answer import answer_doc
from abbe.service.discovery.finding import effect_found
from abbe.service.domain.finding import Finding
from tests.models.discovery.test_discovery_search import campaign

SCATTER = frozenset({"vibration:Z", "stick_slip:X", "beam_outliers"})
TURNS = tuple(e for e in CATALOGUE if e.name in ("backlash", "reversal_spike", "servo_mismatch"))


def by_name(name: str) -> Effect:
    return next(e for e in CATALOGUE if e.name == name)


def effect(label: str, evidence: float) -> NamedEffect:
    name, _, key = label.partition(":")
    return NamedEffect(name, key, 1.0, 0.1, {}, np.ones(1), np.ones((1, 1)), evidence)


def answered(named: NamedEffect) -> dict[str, Any]:
    """The effect as `abbe discover` writes it."""
    effects = {e.name: e for e in CATALOGUE}
    (told,) = answer_doc(Finding(verdict="named", effects=(effect_found(named, effects[named.name], effects),)))["effects"]
    return told


@pytest.mark.parametrize(
    ("strong", "weak", "share", "residue"),
    [
        ("backlash:Z", "reversal_spike:Z", 0.008, True),
        ("backlash:Z", "reversal_spike:Z", 0.014, False),
        ("backlash:Z", "reversal_spike:X", 0.008, False),
        ("reversal_spike:X", "lateral_play:EYX", 0.008, True),
        ("reversal_spike:X", "lateral_play:EXY", 0.008, False),
        ("cyclic_error:Y", "stick_slip:X", 0.007, True),
        ("backlash:X", "vibration:Z", 0.003, True),
        ("backlash:X", "vibration:Z", 0.02, False),
        ("angular_error:EBX", "stick_slip:Z", 0.0099, False),  # a smooth effect leaves no scatter
        ("angular_error:EBX", "stick_slip:Z", 0.002, True),
        ("backlash:X", "beam_outliers", 0.005, False),
        ("backlash:X", "ram_sag", 0.009, False),
        ("backlash:X", "ram_sag", 0.0009, True),
        ("bar_thermal", "axis_thermal_growth:Y", 0.035, True),
        ("bar_thermal", "axis_thermal_growth:Y", 0.045, False),
        ("nonrigid_bed:EYZ", "straightness:EXZ", 0.01, True),
        ("nonrigid_bed:EYZ", "nonrigid_bed:EYX", 0.01, True),
        ("straightness:EYX", "straightness:EXZ", 0.0398, False),  # they share no axis and no direction
        ("straightness:EYX", "angular_error:EBZ", 0.01, False),
        ("ram_sag", "angular_error:EBZ", 0.01, True),
        ("axis_thermal_growth:X", "positioning_nonlinear:X", 0.022, True),
        ("axis_thermal_growth:X", "positioning_nonlinear:Y", 0.022, False),
        ("straightness:EYX", "spindle_thermal_drift:Z", 0.022, False),
        ("contour_lag", "servo_mismatch:X", 0.039, True),
        ("contour_lag", "servo_mismatch:X", 0.041, False),
        ("air_refraction", "laser_cosine", 0.036, True),
        ("laser_cosine", "air_refraction", 0.036, False),  # a beam is constant in time
        ("servo_mismatch:Y", "servo_mismatch:X", 0.02, False),  # two axes may be off, each by its own delay
        ("vibration:Z", "stick_slip:X", 0.007, False),  # the rule compares with effects of the mean
    ],
)
def test_a_residue_is_weak_and_of_the_same_form(strong: str, weak: str, share: float, residue: bool) -> None:
    told = residues([effect(strong, 1e4), effect(weak, share * 1e4)], SCATTER)
    assert set(told) == ({weak} if residue else set())
    assert all(strong in why for why in told.values())


def test_what_two_related_names_share_belongs_to_the_stronger_one() -> None:
    """Evidences of a case in which only air refraction is true."""
    pair = [effect("air_refraction", 68.9), effect("laser_cosine", 2.9)]
    assert residues(pair, SCATTER) == {}
    without = {("air_refraction", "laser_cosine"): 202.8, ("laser_cosine", "air_refraction"): 136.7}
    told = residues(pair, SCATTER, without)
    assert ties(pair, SCATTER, without) == frozenset()
    assert told == {
        "laser_cosine": "evidence 3, only 1.4% of the evidence of air_refraction: "
        "the effect may be only the deviation of air_refraction from its formula"
    }


def sticking(axis: int, backlash_um: float) -> Case:
    """The small campaign with a lost motion of X and teeth of 1.5 um while one axis creeps below 2 mm/s."""
    case, rng = campaign(backlash_um=backlash_um), np.random.default_rng(2)
    runs = []
    for r in case.runs:
        v, moves = r.path.at.v_mm_s[:, axis], float(np.ptp(r.path.at.q_mm[:, axis]) > 0)
        teeth = moves * 1.5e-3 * rng.uniform(-1.0, 1.0, v.size) * np.exp(-np.square(v / 2.0)) * r.path.look[:, axis]
        runs.append(replace(r, deviation_mm=None if r.deviation_mm is None else r.deviation_mm + teeth))
    return replace(case, runs=tuple(runs))


def test_a_stick_slip_where_the_strong_effect_of_another_axis_leaves_no_scatter_keeps_its_name() -> None:
    found = discover(sticking(2, backlash_um=30.0), TURNS)
    assert [e.label for e in found.effects] == ["backlash:X", "stick_slip:Z"]
    assert found.effects[1].evidence < 1e-4 * found.effects[0].evidence
    assert abs(found.effects[1].strength - 1.5) < 2.0 * found.effects[1].u_strength


def test_scatter_at_the_reversals_of_the_strong_effect_itself_may_be_its_residue() -> None:
    found = discover(sticking(0, backlash_um=30.0), TURNS)
    assert [e.label for e in found.effects] == ["backlash:X"]
    assert "may be only the deviation of backlash:X" in dict(found.rejected)["stick_slip:X"]


def test_a_strong_effect_as_rough_as_the_scatter_may_leave_it() -> None:
    """Readings that jump by 10 um from one to the next where Z creeps leave teeth of 1.5 um if their form is a little wrong."""
    case = sticking(2, backlash_um=0.0)
    problem = whiten(case, baseline_of(case))
    teeth = VarianceFinding("stick_slip", "Z", 1.5, 0.1, {"v_c": 2.0}, 50.0, Localization())
    rest = whole_rest(problem, solve(problem, []))
    jumps = np.resize([1.0, -1.0], rest.size)[:, None]
    for size_um, pairs in ((1e-3, {("stick_slip:Z", "angular_error:EAX")}), (10.0, set())):
        effect_of_x = replace(by_name("angular_error"), signal=lambda paths, key, values: [jumps])
        solved = replace(solve(problem, []), picks=(Pick(effect_of_x, "EAX"),), coefficients=(np.array([1e-3 * size_um]),))
        assert too_smooth(problem, solved, [teeth], rest) == pairs
        assert too_smooth(problem, replace(solved, picks=(Pick(effect_of_x, "EAZ"),)), [teeth], rest) == set()
    assert too_smooth(problem, solved, [], rest) == set()


def test_a_near_tie_of_two_related_names_rejects_neither_and_is_told() -> None:
    air, cosine = pair = [effect("air_refraction", 70.0), effect("laser_cosine", 68.0)]
    without = {("air_refraction", "laser_cosine"): 20_070.0, ("laser_cosine", "air_refraction"): 20_068.0}
    assert residues(pair, SCATTER, without) == residues(pair[::-1], SCATTER, without) == {}
    pairs = ties(pair, SCATTER, without)
    assert pairs == {(air.label, cosine.label), (cosine.label, air.label)}
    named = _with_ties({0: air, 3: cosine}, pairs)
    assert (named[0].alternatives, named[3].alternatives) == ((("laser_cosine", 2.0),), (("air_refraction", -2.0),))
    assert set(_confounded(list(named.values()))) == {"air_refraction", "laser_cosine"}
    assert answered(named[0])["alternatives"] == ["laser_cosine"]


@pytest.mark.parametrize(("weak", "residue", "tied"), [(34.0, True, False), (36.0, False, True), (70.0, False, True)])
def test_shared_evidence_rejects_only_a_name_with_at_most_half_of_the_others_own(weak: float, residue: bool, tied: bool) -> None:
    pair = [effect("air_refraction", 70.0), effect("laser_cosine", weak)]
    without = {("air_refraction", "laser_cosine"): 20_070.0, ("laser_cosine", "air_refraction"): 20_000.0 + weak}
    assert bool(residues(pair, SCATTER, without)) is residue
    assert bool(ties(pair, SCATTER, without)) is tied


def test_a_rival_with_weak_shared_evidence_is_no_tie() -> None:
    pair = [effect("air_refraction", 70.0), effect("laser_cosine", 68.0)]
    assert ties(pair, SCATTER, {("air_refraction", "laser_cosine"): 75.0, ("laser_cosine", "air_refraction"): 73.0}) == frozenset()


def test_the_strongest_name_is_never_a_residue() -> None:
    labels = ("backlash:X", "reversal_spike:X", "vibration:Z", "servo_mismatch:X")
    for evidence in np.random.default_rng(4).lognormal(3.0, 4.0, (50, 4)):
        told = residues([effect(n, float(v)) for n, v in zip(labels, evidence, strict=True)], SCATTER)
        assert labels[int(np.argmax(evidence))] not in told


def test_a_parameter_of_the_scatter_claims_no_certainty() -> None:
    named = _of_scatter(VarianceFinding("vibration", "Z", 1.0, 0.1, {"frequency_hz": 7.0}, 50.0, Localization()))
    assert math.isnan(named.parameters["frequency_hz"][1])
    answer = answered(named)["parameters"]
    assert answer["frequency_hz"] == 7.0
    assert "u_frequency_hz" not in answer
    assert json.loads(json.dumps(answer, allow_nan=False)) == answer


def test_only_rivals_that_the_price_rule_does_not_exclude_are_confounded() -> None:
    named = replace(effect("backlash:X", 900.0), alternatives=(("lateral_play:EYX", 5.9), ("servo_mismatch:X", 6.1), ("ram_sag", 800.0)))
    assert _confounded([named, named]) == ("lateral_play:EYX",)
    assert answered(named)["alternatives"] == ["lateral_play:EYX", "servo_mismatch:X", "ram_sag"]
