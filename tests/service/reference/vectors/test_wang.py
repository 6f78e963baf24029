"""Wang's vectors through `abbe vectors`' reader and through the production solver."""

import json

import numpy as np
import pytest

from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import travel_sign
from abbe.models.machine import Machine
from abbe.models.paths import DIAGONALS, diagonal_ends, step_diagonal, straight_line
from abbe.models.solvers.least_squares import analyse, project_out
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import run_design, setup_unknowns
from abbe.models.solvers.priors import Priors
from abbe.service.reference.vector_results import check_file
from tests.service.reference.vectors.altering import missed


def test_every_number_of_the_file_is_used_and_agrees(shared):
    checks = check_file(shared / "vectors" / "wang_step_diagonal.json")
    assert checks.ok, [f for q in checks.quantities.values() for f in q.failures] + checks.unread
    assert [n.numbers for n in checks.not_computable] == [1]  # one draw of noise
    assert checks.quantities["rank and effective rank"].values == 8 * 5 * 2
    assert checks.quantities["worst distance after compensation"].values == 5


def test_an_altered_eighth_digit_is_found(shared):
    assert not missed(shared, "wang_step_diagonal", lambda path: path[0] in ("cases", "squareness", "inc"), count=4, seed=2)


FXYZ = Machine("w-b-X-Y-Z-t", np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 400.0]]))
"""Bed, X, Y, Z towards the tool: chain of math.md 5.5, tool 0."""


def laser(label: str, p: np.ndarray) -> RunData:
    """A run whose mirror keeps its direction, as in the paper."""
    n, beam = len(p), (p[-1] - p[0]) / np.linalg.norm(p[-1] - p[0])
    t_s = np.arange(n) * 1.0
    return RunData(label, label, "laser", p, np.zeros(n), travel_sign(p), t_s, np.ones(n), beam=beam, mirror_turns=False)


def diagonals(orders: tuple[str, ...]) -> list[RunData]:
    ends = {d: diagonal_ends(FXYZ.stroke_mm, d) for d in DIAGONALS}
    return [laser(f"{d}{o}", step_diagonal(*ends[d], 10, o, back=False)) for o in orders for d in DIAGONALS]


def edges(sides: tuple[int, ...], axes: str = "XYZ") -> list[RunData]:
    out = []
    for side in sides:
        for letter in axes:
            a = "XYZ".index(letter)
            start = FXYZ.stroke_mm[:, side].copy()
            end = start.copy()
            start[a], end[a] = FXYZ.stroke_mm[a]
            out.append(laser(f"{letter}{side}", straight_line(start, end, 11, back=False)))
    return out


@pytest.mark.parametrize(
    ("experiment", "runs", "tilts"),
    [
        ("ideal mirror", diagonals(("XYZ",)), False),
        ("8 tilt unknowns", diagonals(("XYZ",)), True),
        ("8 tilt + linear laser X", diagonals(("XYZ",)) + edges((0,), "X"), True),
        ("8 tilt + linear laser X,Y", diagonals(("XYZ",)) + edges((0,), "XY"), True),
        ("8 tilt + linear laser X,Y,Z", diagonals(("XYZ",)) + edges((0,)), True),
        ("two orders XYZ,ZYX, 16 tilt", diagonals(("XYZ", "ZYX")), True),
        ("two orders + linear X,Y,Z, 16 tilt", diagonals(("XYZ", "ZYX")) + edges((0,)), True),
        ("two orders + linear XYZ on 2 edges, 16 tilt", diagonals(("XYZ", "ZYX")) + edges((0, 1)), True),
    ],
)
def test_ranks_of_the_joint_solver_are_those_of_the_independent_table(shared, experiment, runs, tilts):
    reference = json.loads((shared / "vectors" / "wang_step_diagonal.json").read_text())["ranks"][experiment]
    setup = setup_unknowns(tuple(runs), Priors())
    for degree in (1, 2, 3):
        terms = smooth_terms(degree)
        a = np.concatenate([run_design(FXYZ, terms, r, setup) for r in runs])
        first = len(terms) + 3
        nuisance = [
            first + k for k, n in enumerate(setup.names) if tilts and n.startswith("tilt_")
        ]  # the table knows neither zero nor drift
        found = analyse(tuple(t.name for t in terms), project_out(a[:, : len(terms)], a[:, nuisance]))
        assert found.rank == reference[degree - 1][0]
