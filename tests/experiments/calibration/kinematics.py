"""The tool of a machine in the workpiece frame by homogeneous matrices, one per carriage, for any of the 24 chains.

Signs: docs/explanation/conventions.md, "Exact kinematics". Written from that page alone; nothing of the product is imported.

A carriage on the tool side stands in the frame of the one before it as T(travel + pivot) R(E) T(-pivot). A table is carried by the one
nearer to the bed and moves against the tool: its own pose is T(pivot - travel) R(-E) T(-pivot), and the tool is seen through its inverse.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

F = np.ndarray
Curve = Callable[[F], F]
"""An error motion over the position from the start of the stroke, mm: value in µm or µrad, same shape."""


@dataclass(frozen=True)
class Play:
    """Lost motion of one axis that depends on the position, and what it takes along sideways; µm, over mm from the start of the stroke."""

    lost_um: Curve
    sideways_um: F

    def at(self, position_mm: F, sign: F, axis: int) -> F:
        """Displacement, shape (n, 3), mm: moving in direction s the axis stands at -s B/2."""
        out = np.outer(sign, 0.5e-3 * self.sideways_um)
        out[:, axis] = -0.5e-3 * sign * self.lost_um(position_mm)
        return out


@dataclass(frozen=True)
class Drift:
    """A spindle that grows along Z and one screw that grows warm, both exponentially from t = 0; amounts µm and µm/m."""

    spindle_um: float
    spindle_s: float
    screw_axis: int
    screw_um_per_m: float
    screw_s: float


@dataclass(frozen=True)
class TrueMachine:
    """A machine with its 18 error motions, three squareness errors, and what no rigid model has (play, drift).

    ``curves[j][c]``: component c (EX EY EZ EA EB EC) of the motion of carriage j. ``squareness``: C0Y, B0Z, A0Z, rad. The tool's end is
    the spindle reference. ``mirror_turns``: a laser's flat mirror on the spindle turns with the angular errors, as on a real machine.
    """

    chain: str
    stroke_mm: F
    pivots_mm: F
    curves: tuple[tuple[Curve, ...], ...]
    squareness: F
    play: tuple[Play, ...] = ()
    drift: Drift | None = None
    mirror_turns: bool = True

    @property
    def sides(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Carriages from workpiece to bed and from bed to tool, as indices."""
        work, tool = self.chain.removeprefix("w-").removesuffix("-t").split("b")
        return tuple("XYZ".index(c) for c in work if c in "XYZ"), tuple("XYZ".index(c) for c in tool if c in "XYZ")

    def motions(self, axes_mm: F) -> F:
        """Error motions without squareness, shape (n, 3, 6), mm and rad."""
        out = np.empty((len(axes_mm), 3, 6))
        for j in range(3):
            x = axes_mm[:, j] - self.stroke_mm[j, 0]
            for c in range(6):
                out[:, j, c] = (1e-3 if c < 3 else 1e-6) * self.curves[j][c](x)
        return out

    def deviation_mm(self, axes_mm: F, sign: F | None = None, t_s: F | None = None) -> F:
        """Actual minus nominal of the tool relative to the workpiece, shape (n, 3).

        ``sign`` (n, 3): direction in which each axis last moved; None: mean of both. ``t_s`` (n,): time; None: no drift.
        """
        motions = self.motions(axes_mm)
        travel = axes_mm - self.stroke_mm[:, 0]
        c0y, b0z, a0z = self.squareness
        motions[:, 1, 0] -= c0y * travel[:, 1]
        motions[:, 2, 0] += b0z * travel[:, 2]
        motions[:, 2, 1] -= a0z * travel[:, 2]
        if sign is not None:
            for j, play in enumerate(self.play):
                motions[:, j, :3] += play.at(travel[:, j], sign[:, j], j)
        if self.drift is not None and t_s is not None:
            j, warm = self.drift.screw_axis, 1.0 - np.exp(-t_s / self.drift.screw_s)
            motions[:, j, j] += 1e-6 * self.drift.screw_um_per_m * warm * travel[:, j]
        off = tool_in_workpiece(self.sides, self.pivots_mm, axes_mm, motions) - axes_mm
        if self.drift is not None and t_s is not None:
            off[:, 2] -= 1e-3 * self.drift.spindle_um * (1.0 - np.exp(-t_s / self.drift.spindle_s))
        return off

    def mirror(self, axes_mm: F, normal: F) -> F:
        """Normal of a mirror on the spindle, as the angular errors turn it against the workpiece, shape (n, 3)."""
        motions, (work, tool) = self.motions(axes_mm), self.sides
        out = np.tile(normal, (len(axes_mm), 1))[..., None]
        if not self.mirror_turns:
            return out[..., 0]
        for j in (*reversed(tool), *reversed(work)):
            out = _turn(motions[:, j, 3:])[:, :3, :3] @ out
        return out[..., 0]


def tool_in_workpiece(sides: tuple[tuple[int, ...], tuple[int, ...]], pivots_mm: F, axes_mm: F, motions: F) -> F:
    """Spindle reference in the workpiece frame, shape (n, 3), mm; ``motions`` (n, 3, 6) with squareness, mm and rad."""
    n = len(axes_mm)
    travel = axes_mm[:, :, None] * np.eye(3)[None] + motions[:, :, :3]
    work, tool = sides
    end = np.tile([0.0, 0.0, 0.0, 1.0], (n, 1))[..., None]
    for j in reversed(tool):
        end = _shift(travel[:, j] + pivots_mm[j]) @ _turn(motions[:, j, 3:]) @ _shift(np.tile(-pivots_mm[j], (n, 1))) @ end
    for j in reversed(work):
        table = _shift(pivots_mm[j] - travel[:, j]) @ _turn(-motions[:, j, 3:]) @ _shift(np.tile(-pivots_mm[j], (n, 1)))
        end = np.linalg.solve(table, end)
    out: F = end[:, :3, 0]
    return out


def _shift(by_mm: F) -> F:
    out = np.tile(np.eye(4), (len(by_mm), 1, 1))
    out[:, :3, 3] = by_mm
    return out


def _turn(vector: F) -> F:
    """Rotation by a vector (Rodrigues), shape (n, 4, 4)."""
    angle = np.linalg.norm(vector, axis=1)[:, None, None]
    k = np.zeros((len(vector), 3, 3))
    k[:, 0, 1], k[:, 0, 2], k[:, 1, 2] = -vector[:, 2], vector[:, 1], -vector[:, 0]
    k -= np.swapaxes(k, 1, 2)
    out = np.tile(np.eye(4), (len(vector), 1, 1))
    out[:, :3, :3] += np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2 * (k @ k)
    return out


def without_rigid_motion(points_mm: F, deviation: F) -> F:
    """Deviation with the best-fit small rigid motion over the points removed, same shape and unit."""
    arm = points_mm - points_mm.mean(axis=0)
    design = np.concatenate([np.tile(np.eye(3), (len(arm), 1, 1)), np.stack([np.cross(e, arm) for e in np.eye(3)], axis=2)], axis=2)
    flat = design.reshape(-1, 6)
    out: F = deviation - (flat @ np.linalg.lstsq(flat, deviation.ravel(), rcond=None)[0]).reshape(-1, 3)
    return out
