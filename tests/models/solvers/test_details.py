"""Details of motions at the places of a step test: which runs share them, and that readings and derivatives hold them."""

from dataclasses import replace

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.machine import Machine
from abbe.models.paths import diagonal_ends, step_diagonal, straight_line
from abbe.models.solvers.engine import MOST_PLACES, with_details
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import predict, run_jacobian, setup_unknowns
from abbe.models.solvers.priors import Priors

BOX = np.array([[0.0, 600.0], [0.0, 500.0], [0.0, 450.0]])
MACHINE = Machine("w-X-Y-b-Z-t", BOX)
TERMS = smooth_terms(2)
STEPS = 5


def laser(label: str, path: np.ndarray) -> RunData:
    n, way = len(path), path[int(np.argmax(np.linalg.norm(path - path[0], axis=1)))] - path[0]
    zero = np.zeros((n, 3))
    return RunData(label, label, "laser", path, np.zeros(n), zero, np.arange(n) * 1.0, np.ones(n), beam=way / np.linalg.norm(way))


RUNS = tuple(laser(name, step_diagonal(*diagonal_ends(BOX, name), STEPS)) for name in ("ppp", "npp"))


def detailed(runs: tuple[RunData, ...]) -> list[str]:
    return [n for n in with_details(setup_unknowns(runs, Priors()), runs, Priors()).names if n.startswith("detail_")]


def test_two_step_diagonals_share_the_details_of_the_places_where_both_stop() -> None:
    names = detailed(RUNS)
    assert len(names) == len(set(names)) == 9 * (STEPS + 1)  # nine motions, as many as one diagonal has
    assert set(names) == set(detailed(RUNS[:1]))
    assert {"detail_EXX_120", "detail_EYX_120", "detail_EZX_120", "detail_EXZ_450"} <= set(names)


def test_a_line_along_an_axis_shows_one_motion_and_a_dense_one_none() -> None:
    line = np.array([[0.0, 250.0, 200.0], [600.0, 250.0, 200.0]])
    assert {n.split("_")[1] for n in detailed((laser("x", straight_line(*line, 11)),))} == {"EXX"}
    assert detailed((laser("x", straight_line(*line, MOST_PLACES + 1)),)) == []


def test_readings_hold_a_detail_once_and_count_from_the_first_record() -> None:
    setup = with_details(setup_unknowns(RUNS, Priors()), RUNS, Priors())
    theta = np.zeros(len(TERMS) + 3 + len(setup.names))
    theta[len(TERMS) + 3 + setup.names.index("detail_EXX_120")] = 2e-3
    for run in RUNS:
        there = np.abs(run.axes_mm[:, 0] - 120.0) < 1e-6
        assert run.beam is not None
        assert predict(MACHINE, TERMS, run, setup, theta) == pytest.approx(2e-3 * run.beam[0] * there, abs=1e-12)
        jacobian = run_jacobian(MACHINE, TERMS, run, setup, theta)
        assert jacobian[:, len(TERMS) + 3 + setup.names.index("detail_EXX_120")] == pytest.approx(run.beam[0] * there)
    start = "detail_EXX_0"
    theta = np.where(np.arange(theta.size) == len(TERMS) + 3 + setup.names.index(start), 2e-3, 0.0)
    first = predict(MACHINE, TERMS, RUNS[0], setup, theta)
    assert first[0] == 0.0
    assert first[-1] == pytest.approx(0.0 if RUNS[0].axes_mm[-1, 0] == 0.0 else -2e-3 * float(np.abs(RUNS[0].beam[0])))  # type: ignore[index]


def test_a_run_of_another_name_has_no_details() -> None:
    setup = with_details(setup_unknowns(RUNS, Priors()), RUNS, Priors())
    theta = np.full(len(TERMS) + 3 + len(setup.names), 0.0)
    theta[-1] = 1e-3
    other = replace(RUNS[0], label="later", setup="later")
    assert predict(MACHINE, TERMS, other, setup, theta) == pytest.approx(np.zeros(len(other.axes_mm)))
