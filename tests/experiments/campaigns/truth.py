"""The true field and the true value of every model parameter of a simulated machine, by definition.

Conventions. A motion of carriage j is projected orthogonally on Legendre polynomials over its stroke: c_k = (2k + 1)/2 * integral of f(u)
P_k(u), u from -1 to 1. ``EXX.k`` (positioning, k >= 1), ``EYX.k`` (straightness, k >= 2) and ``EAX.k`` (angle, k >= 1) are that c_k. The
model counts positioning and angles from zero at the start of the stroke; what that leaves of an angle, the constant
E0 = c_0 + sum over 1 <= k <= order of c_k P_k(-1), turns the lever arm, and a lever that grows with a travel makes a line: a slope of the
commanded position. These slopes, the least-squares slopes of the straightnesses (k = 1) and the drawn squareness add up to one matrix M
(deviation = M @ position). Its symmetric off-diagonal part is squareness: C0Y = -(Mxy + Myx), B0Z = Mxz + Mzx, A0Z = -(Myz + Mzy); its
antisymmetric part is a rotation of the frame and no parameter. With ``order`` None, E0 is the angle at the start of the stroke itself.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from abbe.simulators.campaign.sampler import Rig

NODES = 120
COMPONENTS = "XYZABC"


@dataclass(frozen=True)
class TrueParameters:
    """What the parameters of the joint model are on a machine whose motions are known.

    ``motions[j]``: the six motions of carriage j at positions (n,), mm, without squareness, shape (n, 6), mm and rad. ``work_side``,
    ``tool_side``: carriages from workpiece to bed and from bed to tool.
    """

    motions: Sequence[Callable[[np.ndarray], np.ndarray]]
    squareness: Sequence[float]
    stroke_mm: np.ndarray
    work_side: tuple[int, ...]
    tool_side: tuple[int, ...]

    def values(self, names: Sequence[str], order: int | None = None) -> np.ndarray:
        """True values of smooth terms and squareness (``EXX.2``, ``C0Y``), mm or rad, shape (len(names),)."""
        highest = max((int(n.partition(".")[2] or 0) for n in names), default=0)
        series = [self.series(axis, highest) for axis in range(3)]
        m = self.slopes(order)
        square = {"C0Y": -m[0, 1] - m[1, 0], "B0Z": m[0, 2] + m[2, 0], "A0Z": -m[1, 2] - m[2, 1]}
        out = np.empty(len(names))
        for i, name in enumerate(names):
            motion, _, k = name.partition(".")
            out[i] = series["XYZ".index(motion[2])][int(k), COMPONENTS.index(motion[1])] if k else square[name]
        return out

    def series(self, axis: int, order: int) -> np.ndarray:
        """Legendre coefficients of the six motions of one carriage (squareness left out), shape (order + 1, 6)."""
        u, weight = legendre.leggauss(NODES)
        low, high = self.stroke_mm[axis]
        values = self.motions[axis](low + 0.5 * (u + 1.0) * (high - low))
        return 0.5 * (2.0 * np.arange(order + 1) + 1.0)[:, None] * (legendre.legvander(u, order).T * weight) @ values

    def slopes(self, order: int | None = None) -> np.ndarray:
        """Matrix M above without its diagonal, rows: component of the deviation, columns: commanded axis."""
        c0y, b0z, a0z = self.squareness
        m = np.array([[0.0, -c0y, b0z], [0.0, 0.0, -a0z], [0.0, 0.0, 0.0]])
        for j in range(3):
            m[:, j] += self.series(j, 1)[1, :3] * 2.0 / float(np.ptp(self.stroke_mm[j]))
            for axis in _travels(self.work_side, self.tool_side, j):
                m[:, axis] += np.cross(self._resting_angle(j, order), np.eye(3)[axis])
        np.fill_diagonal(m, 0.0)
        return m

    def _resting_angle(self, axis: int, order: int | None) -> np.ndarray:
        if order is None:
            return self.motions[axis](self.stroke_mm[axis, :1])[0, 3:]
        c = self.series(axis, order)[:, 3:]
        return c.T @ np.array([(-1.0) ** k for k in range(order + 1)])


@dataclass(frozen=True)
class Truth:
    """What nobody measures: the machine of the independent simulator as it is."""

    rig: Rig

    def deviation_mm(self, points_mm: np.ndarray, tool_mm: np.ndarray | None = None) -> np.ndarray:
        """Deviation at commanded positions, mean of both approach directions, no drift, shape (n, 3)."""
        machine = self.rig.machine(tool_mm)
        return machine.tool_position(points_mm) - points_mm - machine.geometry.tool_mm

    def parameters(self, names: list[str], order: int | None = None) -> np.ndarray:
        """True values of many parameters (``EXX.2``, ``C0Y``, ``backlash_X``, ``bar_length_150``), mm or rad, shape (len(names),)."""
        g, draws = self.rig.geometry, self.rig.draws
        stroke = np.stack([g.low_mm, g.high_mm], axis=1)
        known = TrueParameters(draws.motions, tuple(draws.squareness), stroke, g.work_side, g.tool_side)
        smooth = [n for n in names if "_" not in n]
        values = dict(zip(smooth, known.values(smooth, order), strict=True))
        return np.array([values[n] if n in values else self._other(n) for n in names])

    def _other(self, name: str) -> float:
        if name.startswith("backlash_"):
            return float(self.rig.draws.backlash_mm["XYZ".index(name[-1])])
        return self.rig.bar_length_error_mm(float(name.removeprefix("bar_length_")))


def _travels(work: tuple[int, ...], tool: tuple[int, ...], j: int) -> tuple[int, ...]:
    """Axes whose travel is part of the lever arm of carriage j (rule G)."""
    if j in tool:
        return tool[tool.index(j) + 1 :]
    return tuple(a for a in range(3) if a not in work[: work.index(j)])
