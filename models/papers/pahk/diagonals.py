"""Length deviation of the four space diagonals and of other lines through the volume, with random error (P section 4).

Section 4 prints three squareness errors and four diagonal deviations of two machines, but not the curves of the other errors.
`best_assignment` tests whether squareness alone can explain the printed diagonals.
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
    """Return the deviation of a length from the deviations of its two ends.

    Parameters
    ----------
    ends_mm, deviations_mm : arrays, shape (2, 3)
        Nominal positions of start and end, and their deviations (actual minus nominal).

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
    # |w + c| - |w| = c (2w + c) / (|w + c| + |w|), without the difference of two long lengths.
    return LengthDeviation(float(way @ change) / nominal, float(change @ (2.0 * way + change)) / (actual + nominal))


def motions_length(kind: PahkType, ends_mm: F2, motions: F3, probe_mm: F1 | None = None, form: Form = "first") -> LengthDeviation:
    """Return the deviation of a length from the machine's ISO motions at its two ends, shape (2, 3 axes, 6)."""
    ends = np.asarray(ends_mm, dtype=np.float64)
    machine = pahk_machine(kind, np.array([[0.0, 1.0]] * 3), probe_mm)
    return length_deviation(ends, chain_deviation_mm(machine, ends, motions, form))


def space_diagonals(
    kind: PahkType, tables: ParameterTables, probe_mm: F1 | None = None, *, box_mm: F2 | None = None, form: Form = "first"
) -> dict[str, LengthDeviation]:
    """Return the length deviations of the four space diagonals.

    Parameters
    ----------
    probe_mm : array, shape (3,), optional
    box_mm : array, shape (3, 2), optional
        Default: the whole range of the tables.
    form : "first", "vector", "zyx" or "small"
        Kinematics of the deviations at the ends (`Form`).

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
    """Return the random error of a length, n . (deviation at the end - deviation at the start).

    Each squareness, and each function of an axis that has the same position at both ends, is one variable with one combined coefficient.
    A function at two positions is two variables, each with the R of its end;
    R must be 0 where a function is zero by definition.

    Parameters
    ----------
    ends_mm : array, shape (2, 3)
        Commanded start and end.
    random : two RandomErrors
        Random errors at start and end, with the same coverage; equal for squareness and for axes at rest.
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
        raise ValueError("length: both ends need the same coverage, and the same R for squareness and for functions of axes at rest")
    way = ends[1] - ends[0]
    gain = np.einsum("i,nip->np", way / np.linalg.norm(way), parameter_jacobian(kind, ends, probe_mm))
    one = (gain[1] - gain[0]) * end
    two = (gain[0] * start) ** 2 + (gain[1] * end) ** 2
    return float(np.sqrt(np.where(shared, one * one, two).sum()))


def shared_variables(ends_mm: F2) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return which of the 21 parameters are one variable for both ends of a length, shape (21,): squareness, functions of axes at rest."""
    rest = np.repeat(ends_mm[0] == ends_mm[1], 3)
    return np.concatenate([rest, rest, np.ones(3, dtype=bool)])


def squareness_diagonals_mm(type_name: str, volume_mm: F1, squareness_rad: F1) -> dict[str, float]:
    """Return the length deviations of the four body diagonals if squareness is the only error.

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
        By diagonal (``ppp``, ``npp``, ``pnp``, ``ppn``): actual minus nominal, mm, first order.

    Raises
    ------
    ValueError
        The type does not exist, or a shape is wrong.
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
    """Return the smallest misfit between four diagonal deviations in unknown order and three squareness errors.

    All 24 orders and both signs of the angles are tried. Each trial computes squareness by the scale-free contrasts
    (`abbe.models.solvers.step_diagonal.squareness_contrast`).

    Parameters
    ----------
    type_name, volume_mm, squareness_rad
        As in `squareness_diagonals_mm`.
    diagonals_mm : four numbers
        In any order.

    Returns
    -------
    misfit_rad, order
        Root of the sum of the squared differences from the given squareness in the best trial; diagonals of this trial by name.
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
