"""Long ball-bar runs become means of equal blocks; everything else stays as it is."""

from __future__ import annotations

import numpy as np
import pytest

from service.workflows import thinned as module
from service.workflows.thinned import thinned
from tests.unit.service.discovery_bench import circle


def test_short_campaigns_stay_as_they_are() -> None:
    runs = [circle(1, "identify"), circle(2, "sealed")]
    assert thinned(runs) is runs


def test_long_ones_become_means(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 100)
    laser = circle(3, "identify") | {"test": "laser_linear"}
    first = circle(1, "identify")
    first["columns"]["valid"] = [0] * 3 + [1] * 2 + [0] + [1] * 114
    runs = [first, circle(2, "holdout"), circle(4, "sealed"), laser]
    short = thinned(runs)  # 240 measured readings of the ball-bar: blocks of three
    assert [len(r["columns"]["t_s"]) for r in short] == [40, 40, 120, 120]
    assert short[2:] == runs[2:]
    columns = short[0]["columns"]
    assert columns["valid"] == [0] + [1] * 39
    deviation = np.array(first["columns"]["deviation_mm"])
    assert columns["deviation_mm"][1] == pytest.approx(deviation[3:5].mean())  # the flagged one does not count
    assert columns["deviation_mm"][5] == pytest.approx(deviation[15:18].mean())
    assert columns["x_mm"][5] == first["columns"]["x_mm"][16]  # a point of the path: the mean of three lies inside the circle
    assert columns["direction"] == first["columns"]["direction"][:40]
    assert np.all(np.diff(columns["t_s"]) > 0)
    assert len(first["columns"]["t_s"]) == 120


def test_a_block_over_lost_readings_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "MOST_READINGS", 20)
    run = circle(1, "identify")
    lost = [i for i in range(120) if not 40 <= i < 70]
    run["columns"] = {name: [values[i] for i in lost] for name, values in run["columns"].items()}
    short = thinned([run])[0]["columns"]  # blocks of five, one of them from reading 40 to 74
    assert len(short["t_s"]) == 18
    whole = thinned([circle(1, "identify")])[0]["columns"]
    assert set(short["x_mm"]) <= set(run["columns"]["x_mm"])
    assert len(whole["t_s"]) == 20
