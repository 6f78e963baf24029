"""A probe's lobing map: values on a grid of directions, read between its nodes, refused where nothing was measured (math.md 7)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.papers.probe.frame import direction_angles

PERIOD = 2.0 * np.pi
EDGE_RAD = 1e-9
"""How far below the last measured circle rounding of an angle may put a direction that is on it."""


@dataclass(frozen=True)
class LobingMap:
    """Probe error by touching direction, on circles of colatitude times equidistant longitudes, with one value at the pole.

    Parameters
    ----------
    colatitude_rad : array, shape (m,)
        Circles from the pole outwards, increasing, all above 0 and at most pi.
    longitude_rad : array, shape (k,)
        Increasing, within one turn; the map goes round.
    values_mm : array, shape (m, k)
        Probe(phi, theta): positive where the reading is too near the sphere's centre (the probe triggers late).
    pole_mm : float
        The value at the pole, for every longitude.

    Raises
    ------
    ValueError
        Wrong shapes, order or numbers.
    """

    colatitude_rad: F1
    longitude_rad: F1
    values_mm: F2
    pole_mm: float

    def __post_init__(self) -> None:
        """Check and normalise once."""
        for name in ("colatitude_rad", "longitude_rad", "values_mm"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))
        ph, th, v = self.colatitude_rad, self.longitude_rad, self.values_mm
        if ph.ndim != 1 or th.ndim != 1 or ph.size < 1 or th.size < 2 or v.shape != (ph.size, th.size):
            raise ValueError(f"lobing map: values {v.shape} do not fit {ph.shape} circles and {th.shape} longitudes")
        if not (np.isfinite(ph).all() and np.isfinite(th).all() and np.isfinite(v).all() and np.isfinite(self.pole_mm)):
            raise ValueError("lobing map: all numbers must be finite")
        if ph[0] <= 0.0 or ph[-1] > np.pi or (np.diff(ph) <= 0.0).any() or (np.diff(th) <= 0.0).any() or th[-1] - th[0] >= PERIOD:
            raise ValueError("lobing map: circles must increase within (0, pi], longitudes within one turn")

    def at_angles(self, colatitude_rad: F1, longitude_rad: F1) -> F1:
        """Probe error at colatitudes and longitudes, bilinear between the nodes, periodic in longitude.

        Parameters
        ----------
        colatitude_rad, longitude_rad : arrays, shape (n,), or numbers

        Returns
        -------
        array, shape (n,), mm

        Raises
        ------
        ValueError
            An angle is not finite, or a direction lies beyond the outermost circle: there are no data, and none are invented.
        """
        ph, th = np.broadcast_arrays(np.asarray(colatitude_rad, dtype=np.float64), np.asarray(longitude_rad, dtype=np.float64))
        if not (np.isfinite(ph).all() and np.isfinite(th).all()):
            raise ValueError("lobing map: colatitude and longitude must be finite")
        outermost = float(self.colatitude_rad[-1])
        beyond = (ph < 0.0) | (ph > outermost + EDGE_RAD)
        if beyond.any():
            where = f"colatitude {np.rad2deg(ph[beyond].max()):.3f} degrees"
            raise ValueError(f"lobing map: {int(beyond.sum())} directions beyond the outermost circle ({where}): no data there")
        circles, table = self._closed()
        i, u = _cell(circles, np.minimum(ph, outermost))
        turn = np.append(self.longitude_rad, self.longitude_rad[0] + PERIOD)
        k, w = _cell(turn, self.longitude_rad[0] + np.mod(th - self.longitude_rad[0], PERIOD))
        inner = (1.0 - w) * table[i, k] + w * table[i, k + 1]
        outer = (1.0 - w) * table[i + 1, k] + w * table[i + 1, k + 1]
        return np.asarray((1.0 - u) * inner + u * outer)

    def at(self, probe_direction: F2) -> F1:
        """Probe error for OUTWARD directions in the probe frame, shape (..., 3); as `at_angles`."""
        return self.at_angles(*direction_angles(probe_direction))

    def _closed(self) -> tuple[F1, F2]:
        """Circles with the pole, values with the pole's row and the first longitude repeated at the end."""
        rows = np.vstack([np.full(self.longitude_rad.size, self.pole_mm), self.values_mm])
        return np.concatenate([[0.0], self.colatitude_rad]), np.hstack([rows, rows[:, :1]])


def _cell(nodes: F1, at: F1) -> tuple[np.ndarray[tuple[int, ...], np.dtype[np.intp]], F1]:
    """Index of the node before each position, and the position's share of the way to the next one."""
    k = np.clip(np.searchsorted(nodes, at, side="right") - 1, 0, nodes.size - 2)
    return k, np.asarray((at - nodes[k]) / (nodes[k + 1] - nodes[k]))
