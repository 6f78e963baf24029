"""A temperature column that does not follow the warm-up the readings show, while another one does, is doubted by name."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from abbe.models.arrays import F1
from abbe.models.discovery.sensors import FEWEST_RUNS, exchanged_sensor
from abbe.models.effects.columns import warmth
from abbe.models.effects.path import Path
from tests.models.discovery.discovery_paths import bar, circle

TAU_S = 3600.0
Course = Callable[[F1], F1]


def warm(t_s: F1) -> F1:
    return 20.0 + 3.0 * warmth(t_s, TAU_S)


def hall(t_s: F1) -> F1:
    """The day in the hall: it has its own course."""
    return 20.0 + 0.5 * np.sin(t_s / 1500.0)


def runs(n: int = 12, **sensors: Course) -> list[Path]:
    paths = [bar(f"r{k:02d}", circle((0, 1)), 600.0 + 900.0 * k) for k in range(n)]
    return [replace(p, at=replace(p.at, temp_c={s: course(p.at.t_s) for s, course in sensors.items()})) for p in paths]


def doubt(paths: list[Path], name: str = "axis_thermal_growth", key: str = "X") -> str:
    return exchanged_sensor(paths, name, key, {"tau_s": TAU_S})


def test_exchanged_columns_are_named() -> None:
    said = doubt(runs(x=hall, y=warm))
    assert "temp_x_C does not follow the warm-up" in said
    assert "temp_y_C does (1.00)" in said


@pytest.mark.parametrize(
    "paths",
    [runs(x=warm, y=hall), runs(x=warm, y=warm), runs(x=hall, y=hall), runs(y=warm), runs(), runs(FEWEST_RUNS - 1, x=hall, y=warm)],
    ids=["own column follows", "both follow", "none follows", "no own column", "no columns", "too few runs"],
)
def test_nothing_is_doubted_without_a_better_column(paths: list[Path]) -> None:
    assert doubt(paths) == ""


def test_only_effects_with_a_sensor_of_their_own_are_judged() -> None:
    assert doubt(runs(x=hall, y=warm), "squareness_thermal", "XY") == ""
    assert "temp_spindle_C" in doubt(runs(spindle=hall, y=warm), "spindle_thermal_drift", "Z")


def test_a_column_that_stands_still_follows_nothing() -> None:
    assert "correlation 0.00" in doubt(runs(x=lambda t: np.full(t.size, 20.0), y=warm))
