"""Blunders among readings are named with run, position, direction and size; usual scatter, whole steps and drift are not."""

from __future__ import annotations

import numpy as np
import pytest

from abbe.service.domain.run import Run
from abbe.service.rendering.phrases import LANGUAGES, phrase
from abbe.service.verification.far_readings import far_angles, far_readings
from abbe.service.verification.iso_report import evaluate
from tests.languages import english
from tests.run_documents import run_of

AT = np.arange(0.0, 550.0, 50.0)
ROWS = np.random.default_rng(5).normal(0.0, 0.5, (5, 2, AT.size))


def cycles_of(off_um: np.ndarray, *, blunders: dict[tuple[int, int, int], float] | None = None) -> Run:
    """A run of X with these deviations by cycle, direction (out, back) and target, µm; ``blunders`` are added, µm."""
    off = off_um.copy()
    for place, size in (blunders or {}).items():
        off[place] += size
    there = np.concatenate([AT, AT[::-1]])
    deviation = np.concatenate([np.concatenate([out, back[::-1]]) for out, back in off])
    n = len(off)
    columns = {"x_mm": np.tile(there, n), "direction": np.tile(np.repeat([1.0, -1.0], AT.size), n), "deviation_mm": 1e-3 * deviation}
    setup = {"setup_id": "L", "axis": "X", "start_mm": [0.0, 0.0, 0.0], "end_mm": [500.0, 0.0, 0.0]}
    return run_of({"run_id": "r01", "test": "laser_linear", "setup": setup, "columns": columns})


def test_a_mistyped_target_is_named_and_stays_in_the_figures() -> None:
    """590 instead of 490: 100 mm. The line is a remark of the report, and the figures still use the reading."""
    run = cycles_of(ROWS, blunders={(2, 1, 9): 100e3})
    (line,) = far_readings([run])
    assert line.startswith("run r01, the reading at X 450 mm, moving in -, lies 100000 µm from the median of this position and direction")
    told = evaluate([run])
    assert line in told.remarks
    assert next(f.value for f in told.figures if f.symbol == "A") > 1e5


def test_a_small_blunder_has_its_sign_and_the_scatter_beside_it() -> None:
    (line,) = far_readings([cycles_of(ROWS, blunders={(0, 0, 3): -12.0})])
    assert "at X 150 mm, moving in +, lies −11.6 µm" in line
    usual = float(line.partition("scatter by ")[2].partition(" ")[0])
    assert 0.4 < usual < 0.6


def test_many_of_them_are_counted() -> None:
    lines = far_readings([cycles_of(ROWS, blunders={(k % 5, 0, k): 50.0 for k in range(8)})])
    assert len(lines) == 6
    assert lines[-1] == "3 more readings lie as far from the others of their position and direction"


@pytest.mark.parametrize(
    "off_um",
    [
        ROWS,
        ROWS[:3],
        np.zeros((5, 2, AT.size)),
        np.eye(5)[:, :1, None] * np.ones((5, 2, AT.size)),
        np.where(ROWS > 1.0, 1.0, 0.0),
        ROWS + 20.0 * np.exp(-np.arange(5.0) / 2.0)[:, None, None],
    ],
    ids=["normal", "three cycles", "no scatter", "one cycle a step off", "rare steps", "warming up"],
)
def test_usual_readings_are_not_named(off_um: np.ndarray) -> None:
    assert far_readings([cycles_of(off_um + 3.0 * np.round(AT / 100.0))]) == []


def test_a_blunder_in_a_file_without_scatter_is_named_alone() -> None:
    steps = np.where(ROWS > 1.0, 0.1, 0.0)
    assert len(far_readings([cycles_of(steps, blunders={(1, 0, 4): 100.0})])) == 1


def test_two_readings_do_not_show_which_is_wrong() -> None:
    assert far_readings([cycles_of(ROWS[:2], blunders={(1, 0, 4): 1e5})]) == []


def test_angles_beside_the_runs_are_looked_at_too() -> None:
    each = [
        (at, way, 1e-6 * float(v)) for cycle in ROWS for way, row in zip((1, -1), cycle, strict=True) for at, v in zip(AT, row, strict=True)
    ]
    each[4] = (*each[4][:2], 1e-3)
    position, direction, deviation = (list(one) for one in zip(*each, strict=True))
    read = {"kind": "angle", "file": "x.rta", "setup_id": "A1", "axis": "X"}
    found = far_angles({"readings": [read | {"position_mm": position, "direction": direction, "deviation": deviation}]})
    assert [line.partition(", moving")[0] for line in found] == ["x.rta, the reading at X 200 mm"]
    assert " µrad from the median" in found[0]


@pytest.mark.parametrize("lang", LANGUAGES[1:])
def test_the_lines_are_in_the_languages_of_reports(lang: str) -> None:
    lines = far_readings([cycles_of(ROWS, blunders={(k % 5, 0, k): 50.0 for k in range(8)})])
    assert not [line for line in lines if english(lang, phrase(lang, line), frozenset(lines))]


def test_a_place_that_scatters_more_is_no_blunder() -> None:
    rough = np.random.default_rng(5).normal(0.0, np.where(AT < 400.0, 0.1, 1.5), (5, 2, AT.size))
    assert far_readings([cycles_of(rough)]) == []


def test_among_equal_readings_the_only_other_one_is_named() -> None:
    (line,) = far_readings([cycles_of(np.zeros((5, 2, AT.size)), blunders={(2, 1, 9): 100e3})])
    assert "lies 100000 µm from the median" in line
