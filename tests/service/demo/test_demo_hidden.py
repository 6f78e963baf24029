"""The demonstration of a discovery judges itself against the sealed truth, and says so when it was wrong."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from abbe.models.discovery.answer import Localization, Significance
from abbe.service.campaign_data.decimation import picked
from abbe.service.demo.demo_hidden import HiddenDemo, NewMeasurement, hidden_json, judged, truth_lines
from abbe.service.demo.simulator_process import HiddenTruth
from abbe.service.domain.finding import EffectFound, Finding, GapUm
from abbe.service.effects.effect_sums import _usual
from tests.run_documents import run_of

PLAY = {"name": "lateral_play", "key": "EYX", "parameters": {"strength": 6.0}, "wild": 7}
SURGE = {"name": "counterbalance_surge", "key": "", "parameters": {"strength": 4.0}, "wild": 0}


def effect(label, family="structure"):
    name, _, key = label.partition(":")
    size = {"strength": 6.0, "u_strength": 0.1, "unit": "um", "remedy": "mechanics", "remedy_text": "adjust"}
    return EffectFound(label=label, name=name, key=key, title=name, family=family, kind="mean", **size)


def demo(hidden, verdict, *labels):
    location = Localization(axes=("X",), table=(Significance("axis", "X", 40.0, 1e-9),))
    finding = Finding(verdict=verdict, effects=tuple(effect(n) for n in labels), location=location)
    gap = GapUm(before_um=2.0, after_um=0.5, floor_um=0.5)
    return HiddenDemo(
        site=None, folder=Path(), started_utc="", finding=finding, journal=SimpleNamespace(version=1),
        anew=NewMeasurement(gap, {"a": gap}), hidden=hidden and HiddenTruth(**hidden),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("hidden", "answer", "right"),
    [
        (None, ("none",), True),
        (None, ("unknown",), False),
        (None, ("named", "lateral_play:EYX"), False),
        (PLAY, ("named", "lateral_play:EYX"), True),
        (PLAY, ("named", "lateral_play:EZX"), False),
        (PLAY, ("named", "lateral_play:EYX", "vibration:Y"), False),
        (PLAY, ("unknown",), False),
        (PLAY, ("none",), False),
        (SURGE, ("unknown",), True),
        (SURGE, ("named", "vibration:Z"), False),
        (SURGE, ("unknown", "vibration:Z"), False),
    ],
)
def test_only_the_hidden_name_and_no_other_is_right(hidden, answer, right):
    found = demo(hidden, *answer)
    assert judged(found)[0] is right
    assert truth_lines(found)[0].endswith(" RIGHT." if right else " WRONG.")


def test_the_truth_is_told_with_its_size_and_shape():
    assert truth_lines(demo(PLAY, "none"))[1] == "  its true parameters: strength 6; its shape deviates from the formula in the catalogue"
    assert truth_lines(demo(SURGE, "unknown"))[1] == "  its true parameters: strength 4"
    assert "but so was vibration:Y, which is not in the machine" in judged(demo(PLAY, "named", "lateral_play:EYX", "vibration:Y"))[1]


def test_json_has_the_answer_and_the_truth_apart():
    doc = hidden_json(demo(PLAY, "named", "lateral_play:EYX"))
    assert (doc["hidden"], doc["right"], doc["effects"][0]["label"]) == (PLAY, True, "lateral_play:EYX")
    assert doc["where"] == {"axes": ("X",)}
    assert doc["anew"]["gap"] == {"before_um": 2.0, "after_um": 0.5, "floor_um": 0.5}


def test_picked_readings_are_real_ones_and_lasers_stay():
    def run(test, n, deviation=True):
        t = [float(k) for k in range(n)]
        return run_of({"test": test, "columns": {"t_s": t, "deviation_mm": t if deviation else None, "valid": [1] * n}})

    runs = [run("ballbar_helix", 70), run("ballbar_circle", 30), run("laser_diagonal", 9), run("ballbar_helix", 50, deviation=False)]
    first, second, laser, sealed = picked(runs, 25)
    assert first.columns.t_s.tolist() == [2.0 + 4.0 * k for k in range(17)]
    assert first.columns.readings_mm.tolist() == first.columns.t_s.tolist()
    assert len(second.columns) == 7
    assert (laser, sealed) == (runs[2], runs[3])
    assert picked(runs, 100) is runs


def test_a_new_set_up_of_an_instrument_is_expected_to_be_like_the_others_where_these_agree():
    entry = effect("dead_path:X", "instrument")
    assert _usual(entry, np.array([2.0, 4.0])) == 3.0
    assert _usual(entry, np.array([2.0, -4.0])) == 0.0
    assert _usual(replace(entry, family="drive"), np.array([2.0, 4.0])) == 0.0
    assert _usual(entry, np.array([2.0])) == 0.0
