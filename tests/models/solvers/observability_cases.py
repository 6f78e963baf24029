"""The experiments of math.md 4.6 and 5.5 as runs of the product (no readings: only where they measure), and what is perfect in each."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.functions.monomials import monomials
from abbe.models.geometry.bases import smooth_terms
from abbe.models.geometry.chain import design, travel_sign
from abbe.models.geometry.volume import rigid_design, volume_grid
from abbe.models.machine import Machine
from abbe.models.notation import yang as yang_notation
from abbe.models.notation.yang import workpiece_mm
from abbe.models.papers.wang import model as wang_notation
from abbe.models.papers.yang.complete import monomial_field
from abbe.models.papers.yang.experiments import origin_plan
from abbe.models.paths import DIAGONALS, diagonal_ends, helix_points, step_diagonal, straight_line
from abbe.models.solvers.observability.rank import (
    Knowledge,
    ObservedInformation,
    campaign_columns,
    compressed,
    observed_information,
    perfect_setup,
    stated_knowledge,
)
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe import perpendicular, setup_unknowns
from abbe.models.solvers.priors import Priors

TRAVEL = np.array([812.8, 495.0, 508.0])
TOOL = np.array([0.0, 0.0, 150.0])
SCALES = np.stack([np.zeros(3), TRAVEL], axis=1)
ORIGINS = origin_plan(SCALES)
RADII = (175.0, 100.0)
YANG = yang_notation.machine(np.array([[0.0, 812.8], [0.0, 495.0], [-508.0, 0.0]]), TOOL)
FXYZ = wang_notation.machine(np.array([[0.0, 800.0], [0.0, 500.0], [0.0, 400.0]]))
BOTH_BARS = (("bar_length_175", "bar_length_100"),)
"""One sensor with two extension bars of known difference: one length error (math.md 4.6, "common r0")."""


@dataclass(frozen=True)
class Experiment:
    """Runs, kinds of set-up unknowns that are perfect, lengths that are one."""

    machine: Machine
    runs: tuple[RunData, ...]
    perfect: tuple[str, ...] = ()
    shared: tuple[tuple[str, ...], ...] = ()

    def knowledge(self, terms, setup) -> Knowledge:
        stated = replace(stated_knowledge(terms, self.runs, setup.names), shared=self.shared, lost_motion=False)
        return perfect_setup(stated, terms, setup, self.perfect)

    def seen(self, degree: int, extra: dict[str, np.ndarray] | None = None) -> ObservedInformation:
        terms, setup = smooth_terms(degree), setup_unknowns(self.runs, Priors())
        known = self.knowledge(terms, setup)
        known = replace(known, fixed={**known.fixed, **(extra or {})})
        return observed_information(compressed(campaign_columns(self.machine, terms, self.runs, setup)), known)


def laser(label: str, path: np.ndarray, beam: np.ndarray | None = None) -> RunData:
    n = len(path)
    way = path[int(np.argmax(np.linalg.norm(path - path[0], axis=1)))] - path[0]
    beam = way / np.linalg.norm(way) if beam is None else beam
    t_s = np.arange(n) * 1.0  # the papers' mirror keeps its direction
    return RunData(label, label, "laser", path, np.zeros(n), travel_sign(path), t_s, np.ones(n), beam=beam, mirror_turns=False)


def helix(label: str, origin: np.ndarray, radius: float, **stated) -> RunData:
    path = workpiece_mm(helix_points(origin, radius, turns=5.0, n=63))
    n = len(path)
    at = workpiece_mm(origin)
    return RunData(
        f"{label} {radius:g}", label, "bar", path, np.zeros(n), travel_sign(path), np.arange(n) * 1.0, np.ones(n), at, radius, **stated
    )


def yang_diagonals(sequential: bool = True) -> tuple[RunData, ...]:
    out = []
    for name in DIAGONALS:
        start, end = diagonal_ends(SCALES, name)
        out.append(
            laser(
                name, workpiece_mm(step_diagonal(start, end, 20, back=False) if sequential else straight_line(start, end, 21, back=False))
            )
        )
    return tuple(out)


def wang_diagonals(orders: tuple[str, ...]) -> tuple[RunData, ...]:
    ends = {name: diagonal_ends(FXYZ.stroke_mm, name) for name in DIAGONALS}
    return tuple(laser(f"{name}{o}", step_diagonal(*ends[name], 20, o, back=False)) for o in orders for name in DIAGONALS)


def wang_lines(axes: str = "XYZ", edges: tuple[int, ...] = (0,)) -> tuple[RunData, ...]:
    out = []
    for edge in edges:
        for letter in axes:
            a = "XYZ".index(letter)
            start, end = FXYZ.stroke_mm[:, edge].copy(), FXYZ.stroke_mm[:, edge].copy()
            start[a], end[a] = FXYZ.stroke_mm[a]
            out.append(laser(f"{letter}{edge}", straight_line(start, end, 20, back=False)))
    return tuple(out)


ONE = (helix("h0", ORIGINS[0], 175.0),)
TEN = tuple(helix(f"h{i}", o, r) for i, o in enumerate(ORIGINS) for r in RADII)
STEPS = yang_diagonals()

YANG_EXPERIMENTS = {
    "a1": Experiment(YANG, ONE, ("cup", "bar_length")),
    "a2": Experiment(YANG, ONE),
    "b1": Experiment(YANG, TEN, ("cup", "bar_length")),
    "b2": Experiment(YANG, TEN, ("bar_length",)),
    "b3": Experiment(YANG, TEN, (), BOTH_BARS),
    "b4": Experiment(YANG, TEN),
    "c1": Experiment(YANG, ONE + STEPS, ("tilt",)),
    "c2": Experiment(YANG, ONE + STEPS),
    "c3": Experiment(YANG, TEN + STEPS, (), BOTH_BARS),
    "c3'": Experiment(YANG, TEN + STEPS, ("tilt",), BOTH_BARS),
    "d1": Experiment(YANG, STEPS, ("tilt",)),
    "d2": Experiment(YANG, STEPS),
    "d3": Experiment(YANG, yang_diagonals(sequential=False)),
}
"""Experiments of math.md 4.6 by the letters of the vectors, except the vector maps e1 to e3, which are not runs."""

TWO = ("XYZ", "ZYX")
WANG_EXPERIMENTS = {
    "ideal mirror": Experiment(FXYZ, wang_diagonals(("XYZ",)), ("tilt",)),
    "8 tilt unknowns": Experiment(FXYZ, wang_diagonals(("XYZ",))),
    "8 tilt + linear laser X": Experiment(FXYZ, wang_diagonals(("XYZ",)) + wang_lines("X")),
    "8 tilt + linear laser X,Y": Experiment(FXYZ, wang_diagonals(("XYZ",)) + wang_lines("XY")),
    "8 tilt + linear laser X,Y,Z": Experiment(FXYZ, wang_diagonals(("XYZ",)) + wang_lines()),
    "two orders XYZ,ZYX, 16 tilt": Experiment(FXYZ, wang_diagonals(TWO)),
    "two orders + linear X,Y,Z, 16 tilt": Experiment(FXYZ, wang_diagonals(TWO) + wang_lines()),
    "two orders + linear XYZ on 2 edges, 16 tilt": Experiment(FXYZ, wang_diagonals(TWO) + wang_lines(edges=(0, 1))),
}
"""Experiments of math.md 5.5 by the names of the vectors."""


def squared_to_the_z_line(degree: int) -> dict[str, np.ndarray]:
    """Mirror tilts of the step diagonals if every mirror is square in the frame of Yang's paper: coefficients of the product's terms.

    An ideal mirror is square to something. The table of math.md 4.6 has it square in the paper's frame (tangent of the Z line at the zero
    of the scale), the product in its own (X the datum, lines by least squares). Between them lies a rotation that depends on the errors.
    It is found here by writing every monomial error of the paper in the product's terms plus a rigid motion.
    """
    terms, theirs = smooth_terms(degree), monomials(degree)
    grid = volume_grid(YANG.stroke_mm, degree + 3)
    tools = (TOOL, np.array([0.0, 0.0, 250.0]), np.array([100.0, 50.0, 150.0]))  # with one tool the terms are not unique
    rigid, ours, paper = [], [], []
    for k, tool in enumerate(tools):
        part = np.zeros((grid.shape[0] * 3, 3 + 3 * len(tools)))
        frame = rigid_design(grid).reshape(-1, 6)
        part[:, :3], part[:, 3 + 3 * k : 6 + 3 * k] = frame[:, 3:], frame[:, :3]  # one rotation for all tools, a shift for each
        rigid.append(part)
        ours.append(design(replace(YANG, tool_mm=tool), terms, grid).reshape(-1, len(terms)))
        paper.append(monomial_field(theirs, grid, TRAVEL, tool).reshape(-1, len(theirs)))
    whole = np.concatenate([np.concatenate(ours), np.concatenate(rigid)], axis=1)
    size = np.linalg.norm(whole, axis=0)
    wanted = np.concatenate(paper)
    found = np.linalg.lstsq(whole / size, wanted, rcond=1e-12)[0] / size[:, None]
    assert np.abs(whole @ found - wanted).max() < 1e-9 * np.abs(wanted).max()
    translate, rotate = found[: len(terms)], found[len(terms) : len(terms) + 3]
    rotation = rotate @ np.linalg.inv(translate)  # rotation of the paper's frame per unit of each of our terms
    out = {}
    for run in STEPS:
        for k, across in enumerate(perpendicular(run.beam)):
            out[f"tilt_{run.setup}_{k + 1}"] = np.cross(run.beam, rotation.T) @ across
    return out
