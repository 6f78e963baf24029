"""Space diagonals of a machine that is only out of square, and whether printed diagonals can come from squareness alone (math.md 8).

Pahk's section 4 prints three squareness errors and four diagonal deviations of two machines; the curves of all other errors are lost.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from abbe.models.arrays import F1
from abbe.models.notation.pahk import iso_squareness, motions_from_pahk, pahk_type
from abbe.models.papers.pahk.diagonals import motions_length
from abbe.models.paths.lines import DIAGONALS, diagonal_ends
from abbe.models.solvers.step_diagonal import squareness_contrast


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
    """How near four diagonal deviations of unknown order come to three squareness errors.

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
