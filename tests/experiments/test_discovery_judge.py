"""The judge of the discovery on answers whose marks can be told by hand."""

from typing import Any

import numpy as np
import pytest

from tests.experiments.campaigns.discovery_judge import Tally, judge, label, located


def truth(kind: str = "single", **effect: Any) -> dict[str, Any]:
    """A truth with one laser and one bar run, 2 um apart with and without the effect."""
    known = {
        "label": "backlash:X", "name": "backlash", "key": "X", "in_catalogue": kind != "unknown", "aliases": [],
        "explained_by_catalogue": [],
        "separated_by": {}, "snr_local": 3.0, "snr_total": 90.0, "parameters": {"strength": 4.0}, "where": {}, "predictable": True,
    }  # fmt: skip
    n = np.arange(40)
    noise = 1e-3 * 0.5 * np.where(n % 2, 1.0, -1.0)
    run = {
        "test": "ballbar_helix", "sigma_um": 0.5, "deviation_mm": noise.tolist(), "clean_mm": [0.0] * 40, "without_effect_mm": [2e-3] * 40,
        "xyz_mm": [[0.0, 0.0, 0.0]] * 40, "setup_seen": True, "info": {},
    }  # fmt: skip
    effects = [] if kind == "null" else [{**known, **effect}]
    return {"case": "c", "kind": kind, "plan": "full", "effects": effects, "sealed_runs": {"r1": run}}


def answer(*effects: dict[str, Any], verdict: str = "named", **more: Any) -> dict[str, Any]:
    return {"case": "c", "verdict": verdict, "effects": list(effects), "predictions": {"r1": [0.0] * 40}, **more}


NAMED = {"name": "backlash", "key": "X", "evidence": 9.0, "parameters": {"strength": 4.2, "u_strength": 0.15}}


def test_a_right_name() -> None:
    tally = Tally()
    assert judge(tally, truth(), answer(NAMED))
    assert tally.counts["one effect, snr_local >= 2"] == [1, 1]
    assert tally.counts["false names"] == [0, 1]
    assert tally.counts["truth within +-2u"] == [1, 1]
    assert tally.samples["strength error, snr_local >= 2"] == [pytest.approx(0.05)]
    assert tally.samples["sealed runs, seen, rms/floor"] == [pytest.approx(1.0)]
    assert tally.samples["gap closed"] == [pytest.approx(1.0)]


def test_the_weaker_name_does_not_count_as_first() -> None:
    tally = Tally()
    other = {"name": "servo_mismatch", "key": "Y", "evidence": 20.0}
    assert not judge(tally, truth(), answer(NAMED, other))
    assert tally.counts["one effect, snr_local >= 2"] == [0, 1]
    assert tally.counts["false names"] == [1, 2]


def test_an_alias_counts_and_must_be_stated() -> None:
    twin = truth(aliases=["lateral_play:EYX"], separated_by={"lateral_play:EYX": ["second_feed"]})
    tally = Tally()
    assert judge(
        tally, twin, answer({"name": "lateral_play", "key": "EYX", "alternatives": ["backlash:X"]}, next_test={"adds": ["second_feed"]})
    )
    assert judge(tally, twin, answer(NAMED))
    assert tally.counts["ambiguity stated where there is one"] == [1, 2]
    assert tally.counts["... separating measurement proposed"] == [1, 2]


def test_what_nobody_can_see_is_not_asked_for_but_false_names_count() -> None:
    tally = Tally()
    assert judge(tally, truth(snr_total=8.0), answer({"name": "servo_mismatch", "key": "Y"}))
    assert tally.counts == {"false names": [1, 1]}


def test_nulls_and_unknowns() -> None:
    tally = Tally()
    assert judge(tally, truth("null"), answer(verdict="none"))
    assert not judge(tally, truth("null"), answer(NAMED))
    assert tally.counts["null: false alarms"] == [1, 2]
    strange = truth("unknown", name="ball_form", label="ball_form", where={"angular_lobes": 3})
    assert judge(tally, strange, answer(verdict="unknown", where={"angular_lobes": 3}))
    assert not judge(tally, strange, answer(verdict="none"))
    assert tally.counts["outside of the catalogue: unknown"] == [1, 2]
    assert tally.counts["... located"] == [1, 2]


def test_predictions_that_miss_the_effect_close_no_gap() -> None:
    tally = Tally()
    judge(tally, truth(), answer(NAMED, predictions={"r1": [2e-3] * 40}))
    assert tally.samples["gap closed"] == [pytest.approx(0.0)]
    assert tally.counts["sealed runs, seen, <= 1.10 floor"] == [0, 1]


@pytest.mark.parametrize(
    ("where", "said", "right"),
    [
        ({"time_s": [100.0, 200.0]}, {"time_s": [255.0, 300.0]}, True),
        ({"time_s": [100.0, 200.0]}, {"time_s": [265.0, 300.0]}, False),
        ({"position_mm": [0.0, 0.0, 0.0], "radius_mm": 20.0}, {"position_mm": [30.0, 20.0, 0.0]}, True),
        ({"period_s": 40.0}, {"period_s": 44.5}, False),
        ({"angular_lobes": 4}, {}, False),
        ({}, {}, None),
    ],
)
def test_located(where: dict[str, Any], said: dict[str, Any], right: bool | None) -> None:
    assert located(where, said) is right


def test_labels() -> None:
    assert label({"name": "backlash", "key": "X"}) == label("backlash:X") == "backlash:X"
    assert label({"name": "ram_sag", "key": "Y"}) == "ram_sag"
