"""Where the tool really is for given unknowns of the machine, exactly, and how each unknown moves it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2, F3, F4
from abbe.models.geometry.bases import Term, term_values
from abbe.models.geometry.chain import exact_deviation_mm
from abbe.models.geometry.jacobian import exact_jacobian
from abbe.models.machine import Machine

LOST = 3
"""Lost motion of X, Y, Z follows the smooth terms in the vector of unknowns."""


def with_tool(machine: Machine, tool_mm: F1 | None) -> Machine:
    """The machine with another tool, for rule G's levers; None: its own."""
    return machine if tool_mm is None else replace(machine, tool_mm=tool_mm)


@dataclass(frozen=True)
class AxisPlaces:
    """Commanded positions of one machine and tool with everything about them that no unknown changes.

    Attributes
    ----------
    machine : Machine
        With the tool that is in use.
    axes_mm : array, shape (n, 3)
    sign : array, shape (n, 3)
        Direction in which each axis last moved; zeros: lost motion left out.
    values : array, shape (n, terms)
        Value of each term's own function (`abbe.models.geometry.bases.term_values`).
    column : array of int, shape (terms,)
        Which of the 18 motions (axis x 6 + component) each term belongs to.
    """

    machine: Machine
    axes_mm: F2
    sign: F2
    values: F2
    column: np.ndarray[tuple[int, ...], np.dtype[np.intp]]

    @classmethod
    def of(cls, machine: Machine, terms: tuple[Term, ...], axes_mm: F2, sign: F2) -> AxisPlaces:
        """Evaluate the terms' functions at commanded positions (n, 3)."""
        column = np.array([6 * t.axis + t.component for t in terms], dtype=np.intp)
        return cls(machine, axes_mm, sign, term_values(terms, axes_mm, machine.stroke_mm), column)

    def motions(self, theta: F1) -> F3:
        """Error motions, squareness and lost motion included, shape (n, 3 axes, 6), for unknowns that begin with terms and lost motion."""
        terms = self.values.shape[1]
        pick = np.zeros((terms, 18))
        pick[np.arange(terms), self.column] = theta[:terms]
        out: F3 = (self.values @ pick).reshape(-1, 3, 6)
        for a in range(3):
            out[:, a, a] -= 0.5 * self.sign[:, a] * theta[terms + a]
        return out

    def deviation_mm(self, motions: F3) -> F2:
        """Exact deviation of the tool, finite rotations, shape (n, 3), mm."""
        return exact_deviation_mm(self.machine, self.axes_mm, motions)

    def slope(self, motions: F3) -> F4:
        """Derivative of the exact deviation with respect to the error motions, shape (n, 3, 3 axes, 6)."""
        return exact_jacobian(self.machine, self.axes_mm, motions)

    def rows(self, direction: F2, slope: F4) -> F2:
        """What a reading in the given directions (n, 3) takes of every term and lost motion, shape (n, terms + 3)."""
        seen = (direction[:, None, :] @ slope.reshape(-1, 3, 18))[:, 0, :]
        lost = -0.5 * self.sign * seen[:, [0, 7, 14]]
        return np.concatenate([self.values * seen[:, self.column], lost], axis=1)
