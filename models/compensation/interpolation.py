"""Between the nodes of a table: straight lines along one axis, trilinear in a grid, end values held; and the best fit of such a table."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1, F2, F4

FIT_SAMPLES = 5
"""Sampled positions per cell when a function is fitted: the fit of a parabola is then within 2 % of the continuous one."""


def cells(nodes_mm: F1, position_mm: F1) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.intp]], F1]:
    """Cell of each position and its place in it (0 at the cell's first node, 1 at its last; never outside, so end values are held)."""
    index = np.clip(np.searchsorted(nodes_mm, position_mm, side="right") - 1, 0, nodes_mm.size - 2)
    share = (position_mm - nodes_mm[index]) / (nodes_mm[index + 1] - nodes_mm[index])
    return index, np.clip(share, 0.0, 1.0)


def trilinear(nodes_mm: tuple[F1, F1, F1], values: F4, axes_mm: F2) -> F2:
    """Trilinear interpolation in a grid.

    Parameters
    ----------
    nodes_mm : three arrays
        Increasing positions of the nodes on X, Y, Z.
    values : array, shape (nx, ny, nz, m)
    axes_mm : array, shape (n, 3)
        Positions; outside the grid the nearest value on its surface.

    Returns
    -------
    array, shape (n, m)
    """
    index, share = zip(*(cells(nodes_mm[a], axes_mm[:, a]) for a in range(3)), strict=True)
    out = np.zeros((axes_mm.shape[0], values.shape[3]))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod([share[a] if corner[a] else 1.0 - share[a] for a in range(3)], axis=0)
        out += weight[:, None] * values[index[0] + corner[0], index[1] + corner[1], index[2] + corner[2]]
    return out


def fit_positions(nodes_mm: F1) -> F1:
    """Positions at which a function of one axis is sampled for a fit: `FIT_SAMPLES` in the middle of equal parts of every cell."""
    part = (np.arange(FIT_SAMPLES) + 0.5) / FIT_SAMPLES
    return np.asarray((nodes_mm[:-1, None] + np.diff(nodes_mm)[:, None] * part).ravel())


def fit_operator(nodes_mm: F1) -> F2:
    """Node values of the least-squares broken line from the values at `fit_positions`, shape (nodes, samples).

    Node values of the function itself put all of a curve's departure from its chord on one side, h^2 f''/8 in the middle of a cell of
    length h; the best broken line shares it out and leaves about 0.4 times as much rms of a parabola (0.6 of the distances in a volume).
    """
    x = fit_positions(nodes_mm)
    index, share = cells(nodes_mm, x)
    hat = np.zeros((x.size, nodes_mm.size))
    rows = np.arange(x.size)
    hat[rows, index], hat[rows, index + 1] = 1.0 - share, share
    return np.asarray(np.linalg.pinv(hat))
