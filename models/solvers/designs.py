"""Least-squares design rows of single experiments, for any error functions, and what such a problem can determine.

A `Field` gives the deviation per unit of every parameter; ball-bar and laser rows are its projections. Ranks are counted with columns of
unit length and the set-up unknowns projected out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from abbe.models.arrays import F1, F2, F3
from abbe.models.solvers.least_squares import EFFECTIVE_TOLERANCE, RANK_TOLERANCE, project_out, singular_values, svd, unit_columns

Field = Callable[[F2], F3]
"""Function of commanded workpiece coordinates (n, 3), mm, that returns the deviation per unit of each parameter (n, 3, p)."""


@dataclass(frozen=True)
class DesignRows:
    """Readings of one experiment per unit of the machine's parameters, shape (n, p), and of its set-up unknowns, shape (n, k)."""

    machine: F2
    setup: F2


def bar_rows(field: Field, points_mm: F2, centre_mm: F1) -> DesignRows:
    """Linearised ball-bar readings about one cup, n . (delta - delta0) (Yang and Kim eq 8); set-up: cup offset (3) and bar length (1).

    Parameters
    ----------
    field : Field
    points_mm, centre_mm : array, shape (n, 3) and (3,)
        Commanded workpiece coordinates; the cup stands where the tool is at ``centre_mm``.
    """
    d = points_mm - centre_mm
    n = d / np.linalg.norm(d, axis=1, keepdims=True)
    along_normal = np.einsum("ni,nik->nk", n, field(points_mm) - field(centre_mm[None]))
    return DesignRows(along_normal, np.concatenate([-n, np.ones((len(n), 1))], axis=1))


def laser_rows(field: Field, path_mm: F2, beam: F1, across: F2) -> DesignRows:
    """Displacement along a beam since the first record, which has no row of its own; set-up: mirror tilts in two directions.

    Parameters
    ----------
    field : Field
    path_mm : array, shape (n + 1, 3)
        Commanded positions, the reference first.
    beam, across : array, shape (3,) and (2, 3)
        Nominal beam and the two directions in which the mirror may tilt, unit vectors.
    """
    f = field(path_mm)
    d = path_mm[1:] - path_mm[0]
    return DesignRows(np.einsum("i,nik->nk", beam, f[1:] - f[0]), d @ across.T)


def vector_rows(field: Field, points_mm: F2) -> DesignRows:
    """All components of the deviation at points, an upper bound for any instrument; no set-up unknowns."""
    f = field(points_mm)
    flat = f.reshape(-1, f.shape[2])
    return DesignRows(flat, np.zeros((flat.shape[0], 0)))


def stacked(parts: list[F2], setups: list[tuple[F2, tuple[int, ...]]]) -> tuple[F2, F2]:
    """Combine several experiments into one design: machine columns and set-up columns.

    Parameters
    ----------
    parts : list of (n_k, p) arrays
    setups : list of (array (n_k, q), columns)
        Set-up columns of each part, and for each column the index of its unknown in the whole problem; equal indices share an unknown.
    """
    width = 1 + max((c for _, columns in setups for c in columns), default=-1)
    blocks = []
    for part, (values, columns) in zip(parts, setups, strict=True):
        block = np.zeros((part.shape[0], width))
        for k, c in enumerate(columns):
            block[:, c] += values[:, k]
        blocks.append(block)
    return np.concatenate(parts), np.concatenate(blocks)


def ranks(a: F2, setup: F2) -> tuple[int, int]:
    """Rank and effective rank: singular values above 1e-9 and 1e-3 of the largest, unit columns, set-up projected out.

    Parameters
    ----------
    a, setup : array, shape (n, p) and (n, k)
        Readings (mm) per unit of the machine's parameters and of the set-up unknowns; k may be 0.

    Returns
    -------
    two integers, at most p: number of combinations of the machine's parameters that the readings determine, and that they determine well.
    """
    s = singular_values(project_out(unit_columns(a)[0], setup))
    return int((s > RANK_TOLERANCE * s[0]).sum()), int((s > EFFECTIVE_TOLERANCE * s[0]).sum())


def hidden_combination(a: F2, setup: F2, support: list[int]) -> tuple[F1, float]:
    """Find the combination of the parameters with indices ``support`` that leaves the least trace in the data.

    Returns
    -------
    weights : array, shape (len(support),)
        In units of the parameters, largest magnitude 1 and positive.
    trace : float
        Size of the combination's effect on the readings, relative to the effect of its parts without cancellation: 0 for a null vector.
    """
    b = project_out(a[:, support], setup)
    size = np.where(np.linalg.norm(b, axis=0) > 0, np.linalg.norm(b, axis=0), 1.0)
    _, _, vt = svd(b / size, full_matrices=True)
    v = vt[-1] / size
    w: F1 = v / v[int(np.argmax(np.abs(v)))]
    shown = float(np.linalg.norm(a[:, support] * w))
    return w, float(np.linalg.norm(b @ w)) / (shown if shown > 0 else 1.0)


def map_noise_gain(a: F2, setup: F2, predict: F3) -> F2:
    """Noise gain: standard deviation of every component of the predicted map per unit of reading noise, shape (m, 3).

    Combinations that leave no trace in the readings (singular values below 1e-9) are taken as zero; rigid motion is not removed.

    Parameters
    ----------
    predict : array, shape (m, 3, p)
        Deviation per unit of each parameter at the nodes of the map.
    """
    unit, factor = unit_columns(a)
    _, s, vt = svd(project_out(unit, setup), full_matrices=False)
    kept = s > RANK_TOLERANCE * s[0]
    gain = (predict * factor) @ (vt[kept].T / s[kept])
    return np.asarray(np.sqrt((gain**2).sum(axis=2)))


def shortest_solution(a: F2, y: F1, scale: F1) -> F1:
    """Least squares without a prior; among equally good solutions, the one with the smallest sum of (parameter / scale)**2.

    Without full rank the result depends on ``scale``, an assumption.

    Parameters
    ----------
    a : array, shape (n, p)
        Readings, mm, per unit of each parameter, set-up unknowns included.
    y : array, shape (n,)
        Readings, mm.
    scale : array, shape (p,)
        Typical size of each parameter in its own unit; 0 holds the parameter at zero.

    Returns
    -------
    array, shape (p,), the parameters in their own units.
    """
    x = scipy.linalg.lstsq(a * scale, y, cond=RANK_TOLERANCE, lapack_driver="gelsd")[0]
    return np.asarray(x * scale)
