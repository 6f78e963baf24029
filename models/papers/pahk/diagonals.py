"""Length deviation of lines through the volume, the four space diagonals first, with random error (math.md 2.2; P section 4).

Section 4 prints three squareness errors and four diagonal deviations of two machines; the curves of all other errors are lost.
`best_assignment` tries whether the printed diagonals can come from squareness only (math.md 8).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.notation.pahk import PahkType, iso_squareness, motions_from_pahk, pahk_machine, pahk_type
from abbe.models.papers.pahk.random_errors import RandomErrors, parameter_jacobian
from abbe.models.papers.pahk.volume_map import Form, ParameterTables, chain_deviation_mm
from abbe.models.paths import DIAGONALS, diagonal_ends
from abbe.models.solvers.step_diagonal import squareness_contrast


@dataclass(frozen=True)
class LengthDeviation:
    """Deviation of the distance between two points, mm.

    Parameters
    ----------
    first_order_mm : float
        n . (deviation at the end - deviation at the start), n the nominal direction.
    full_mm : float
        |actual end - actual start| - |nominal end - nominal start|.
    """

    first_order_mm: float
    full_mm: float


def length_deviation(ends_mm: F2, deviations_mm: F2) -> LengthDeviation:
    """Deviation of a length from the deviations of its two ends.

    Parameters
    ----------
    ends_mm, deviations_mm : arrays, shape (2, 3)
        Start and end: nominal positions and actual minus nominal.

    Raises
    ------
    ValueError
        Wrong shapes, or the ends coincide.
    """
    ends, off = np.asarray(ends_mm, dtype=np.float64), np.asarray(deviations_mm, dtype=np.float64)
    if ends.shape != (2, 3) or off.shape != (2, 3) or (ends[0] == ends[1]).all():
        raise ValueError("length: expected two different ends and their deviations, each of shape (2, 3)")
    way, change = ends[1] - ends[0], off[1] - off[0]
    actual, nominal = float(np.linalg.norm(way + change)), float(np.linalg.norm(way))
    # |w + c| - |w| = c (2w + c) / (|w + c| + |w|): no two metres are subtracted to get a micrometre.
    return LengthDeviation(float(way @ change) / nominal, float(change @ (2.0 * way + change)) / (actual + nominal))


def motions_length(kind: PahkType, ends_mm: F2, motions: F3, probe_mm: F1 | None = None, form: Form = "first") -> LengthDeviation:
    """Deviation of a length of a machine whose ISO motions at the two ends are known, shape (2, 3 axes, 6)."""
    ends = np.asarray(ends_mm, dtype=np.float64)
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3), probe_mm)
    return length_deviation(ends, chain_deviation_mm(machine, ends, motions, form))


def space_diagonals(
    kind: PahkType, tables: ParameterTables, probe_mm: F1 | None = None, *, box_mm: F2 | None = None, form: Form = "first"
) -> dict[str, LengthDeviation]:
    """Length deviations of the four space diagonals.

    Parameters
    ----------
    probe_mm : array, shape (3,), optional
    box_mm : array, shape (3, 2), optional
        Default: the whole range of the tables.
    form : "first", "vector", "zyx" or "small"
        How the deviations of the ends come about.

    Returns
    -------
    dict
        By ``ppp``, ``npp``, ``pnp``, ``ppn``.

    Raises
    ------
    ValueError
        The box reaches beyond the tables.
    """
    box = tables.stroke_mm if box_mm is None else np.asarray(box_mm, dtype=np.float64)
    out = {}
    for name in DIAGONALS:
        ends = np.stack(diagonal_ends(box, name))
        out[name] = motions_length(kind, ends, tables.motions(kind, ends), probe_mm, form)
    return out


def length_random_error_mm(kind: PahkType, ends_mm: F2, random: tuple[RandomErrors, RandomErrors], probe_mm: F1 | None = None) -> float:
    """Random error of a length: n . (deviation at the end - at the start) differentiated with respect to every variable.

    One variable with one combined coefficient: each squareness, and each function of an axis that stands at the same place at both ends.
    Two variables: a function at two different positions, each end with its own R. Functions that are zero by definition at one end (at
    their reference) have R = 0 there: say so in ``random``.

    Parameters
    ----------
    ends_mm : array, shape (2, 3)
        Commanded start and end.
    random : two RandomErrors
        At start and end, in the same coverage, with the same squareness; equal also for axes that stand still.
    probe_mm : array, shape (3,), optional

    Returns
    -------
    float
        mm, in the coverage of the inputs.

    Raises
    ------
    ValueError
        The ends coincide, or coverages or shared variables differ.
    """
    ends = np.asarray(ends_mm, dtype=np.float64)
    if ends.shape != (2, 3) or (ends[0] == ends[1]).all():
        raise ValueError("length: expected two different ends, shape (2, 3)")
    shared = shared_variables(ends)
    start, end = random[0].vector, random[1].vector
    if random[0].coverage != random[1].coverage or not np.array_equal(start[shared], end[shared]):
        raise ValueError("length: both ends need the same coverage, and one value for squareness and for functions of resting axes")
    way = ends[1] - ends[0]
    gain = np.einsum("i,nip->np", way / np.linalg.norm(way), parameter_jacobian(kind, ends, probe_mm))
    one = (gain[1] - gain[0]) * end
    two = (gain[0] * start) ** 2 + (gain[1] * end) ** 2
    return float(np.sqrt(np.where(shared, one * one, two).sum()))


def shared_variables(ends_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Which of the 21 parameters are the same variable at both ends of a length, shape (21,): squareness, and functions of axes at rest."""
    rest = np.repeat(ends_mm[0] == ends_mm[1], 3)
    return np.concatenate([rest, rest, np.ones(3, dtype=bool)])


def squareness_diagonals_mm(type_name: str, volume_mm: F1, squareness_rad: F1) -> dict[str, float]:
    """Length deviations of the four body diagonals when squareness is the only error.

    Parameters
    ----------
    type_name : str
        One of Pahk's ten types.
    volume_mm : array, shape (3,)
        Travels X, Y, Z.
    squareness_rad : array, shape (3,)
        alpha (XY), beta1 (XZ), beta2 (YZ), Pahk's signs.

    Returns
    -------
    dict
        By diagonal (``ppp``, ``npp``, ``pnp``, ``ppn``), mm, actual minus nominal, first order: n . (deviation at the end - at the start).

    Raises
    ------
    ValueError
        No such type, or wrong shapes.
    """
    kind = pahk_type(type_name)
    box = np.stack([np.zeros(3), np.asarray(volume_mm, dtype=np.float64)], axis=1)
    nothing = np.zeros((2, 3, 3))
    out = {}
    for name in DIAGONALS:
        ends = np.stack(diagonal_ends(box, name))
        out[name] = motions_length(kind, ends, motions_from_pahk(kind, ends, nothing, nothing, squareness_rad)).first_order_mm
    return out


def best_assignment(type_name: str, volume_mm: F1, squareness_rad: F1, diagonals_mm: Sequence[float]) -> tuple[float, dict[str, float]]:
    """Smallest misfit between four diagonal deviations of unknown order and three squareness errors.

    All 24 orders and both senses of angle are tried; every trial gives its squareness by the scale-free contrasts (math.md 5.3).

    Parameters
    ----------
    type_name, volume_mm, squareness_rad
        As in `squareness_diagonals_mm`.
    diagonals_mm : four numbers
        In any order.

    Returns
    -------
    misfit_rad, order
        Root of the sum of the squared differences to the given squareness in the best trial, and that trial's diagonals by name.
    """
    volume = np.asarray(volume_mm, dtype=np.float64)
    c0y, b0z, a0z = iso_squareness(pahk_type(type_name), squareness_rad)
    truth = np.array([c0y, -b0z, a0z])
    best, order = math.inf, dict[str, float]()
    for values in itertools.permutations(diagonals_mm):
        trial = dict(zip(DIAGONALS, values, strict=True))
        found = squareness_contrast(trial, volume)
        theta = np.array([found.theta_xy, found.theta_xz, found.theta_yz])
        for sense in (1.0, -1.0):
            misfit = float(np.linalg.norm(sense * theta - truth))
            if misfit < best:
                best, order = misfit, trial
    return best, order
