"""What a campaign holds already, so that a cause is a fact about these runs and a cure is something that is not there yet."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from abbe.models.arrays import F1
from abbe.models.machine import AXES, Machine
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.observe_setup import SAME_PLACE_MM, straight_line_of

ALONG = 1e-3
"""A line is along an axis, a diagonal across all of them, if no component (all components) of its direction is larger than this."""
STEP_ORDERS = ("XYZ", "ZYX", *("".join(p) for p in permutations("XYZ") if p not in (("X", "Y", "Z"), ("Z", "Y", "X"))))


@dataclass(frozen=True)
class Present:
    """Runs of a campaign by what they are.

    Attributes
    ----------
    lines : per axis, the places (mm) of the laser lines along it.
    stepped : step diagonals as (signs of the body diagonal, order of the steps).
    plain : int
        Diagonals that were run straight.
    cups : int
        Places where the ball-bar stood.
    """

    lines: tuple[tuple[F1, ...], tuple[F1, ...], tuple[F1, ...]]
    stepped: tuple[tuple[str, str], ...]
    plain: int
    cups: int

    @property
    def orders(self) -> tuple[str, ...]:
        """Orders in which diagonals were stepped."""
        return tuple(dict.fromkeys(order for _, order in self.stepped))

    @property
    def next_order(self) -> str:
        """The first usual order in which none was stepped yet (the last one if all were)."""
        return next((o for o in STEP_ORDERS if o not in self.orders), STEP_ORDERS[-1])

    @property
    def diagonals(self) -> int:
        """How many of the four body diagonals were stepped."""
        return len({name for name, _ in self.stepped})


def present(runs: tuple[RunData, ...]) -> Present:
    """Sort the runs of a campaign."""
    lines: tuple[list[F1], list[F1], list[F1]] = ([], [], [])
    stepped, plain, cups = [], 0, set()
    for run in runs:
        if run.centre_mm is not None:
            cups.add(tuple(np.round(run.centre_mm / SAME_PLACE_MM)))
            continue
        line = straight_line_of(run.axes_mm)
        if line is None:
            stepped += _stepped(run)
        elif (np.abs(line[1]) > ALONG).sum() == 1:
            lines[int(np.argmax(np.abs(line[1])))].append(line[0])
        elif (np.abs(line[1]) > ALONG).all():
            plain += 1
    return Present((tuple(lines[0]), tuple(lines[1]), tuple(lines[2])), tuple(stepped), plain, len(cups))


def _stepped(run: RunData) -> list[tuple[str, str]]:
    """A run in steps of one axis each across the volume: its body diagonal (direction does not matter) and its order."""
    steps = np.diff(run.axes_mm, axis=0)
    big = np.abs(steps) > ALONG * np.abs(steps).max()
    moves = [(int(np.argmax(b)), float(s[np.argmax(b)])) for b, s in zip(big, steps, strict=True) if b.sum() == 1]
    first = list(dict.fromkeys(axis for axis, _ in moves))
    if len(first) < len(AXES):
        return []
    signs = [np.sign(next(s for axis, s in moves if axis == a)) for a in range(3)]
    return [("".join("p" if s == signs[0] else "n" for s in signs), "".join(AXES[a] for a in first))]


def place_words(axis: int, place_mm: F1) -> str:
    """Where a line along an axis stands: "Y = 40 mm, Z = 30 mm"."""
    return ", ".join(f"{AXES[k]} = {place_mm[k]:.0f} mm" for k in range(3) if k != axis)


def free_corner(machine: Machine, axis: int, inner: np.ndarray[tuple[int, ...], np.dtype[np.float64]], places: tuple[F1, ...]) -> F1:
    """The corner of the inner volume (3, 2) across an axis that is farthest from the lines along it; without lines the lowest."""
    others = [k for k in range(3) if k != axis]
    corners = []
    for sides in product((0, 1), repeat=2):
        corner = inner[:, 0].copy()
        corner[others] = inner[others, sides]
        corners.append(corner)
    if not places:
        return corners[0]
    size = machine.length_mm[others]
    away = [min(float(np.linalg.norm((c - p)[others] / size)) for p in places) for c in corners]
    return corners[int(np.argmax(away))]


def on_opposite_edges(machine: Machine, axis: int, places: tuple[F1, ...]) -> bool:
    """Whether two lines along an axis stand at least half the stroke apart in both other axes."""
    others = [k for k in range(3) if k != axis]
    return any((np.abs(a - b)[others] >= 0.5 * machine.length_mm[others]).all() for a in places for b in places)
