"""Exact kinematics of a three-axis machine with finite rotations (docs/explanation/conventions.md, "Exact kinematics"), and lost motion.

Lost motion of the drives is a play operator, whose output depends on where the axis came from.
"""

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.scenario import AXES, MachineConfig, parse_chain
from abbe.simulators.truth.draws import Draws


class Geometry:
    """The nominal machine: ``low_mm``, ``high_mm``, ``tool_mm`` (3,), ``pivots_mm`` (3, 3); axes of ``work_side`` and ``tool_side``."""

    def __init__(self, config: MachineConfig) -> None:
        self.work_side, self.tool_side = parse_chain(config.chain)
        strokes = np.array([getattr(config.stroke_mm, axis) for axis in AXES])
        self.low_mm: F = strokes[:, 0].copy()
        self.high_mm: F = strokes[:, 1].copy()
        self.pivots_mm: F = np.array([getattr(config.pivots_mm, axis) for axis in AXES])
        self.tool_mm: F = np.array(config.tool_mm)


class Machine:
    """The true machine: actual position of the tool in workpiece coordinates as a function of the axis positions."""

    def __init__(self, geometry: Geometry, draws: Draws) -> None:
        self.geometry = geometry
        self.draws = draws
        self.extra_scale: F = np.zeros(3)
        """Scale error (mm/mm) added after the draw, about the start of each stroke."""

    def motions(self, axis: int, position_mm: F) -> tuple[F, F]:
        """Return translational (mm, with squareness) and angular (rad) error of one carriage at n positions: two arrays (n, 3)."""
        function = self.draws.motions[axis]
        if position_mm.size == 1:
            values = function(position_mm)
        else:
            new = np.diff(position_mm, prepend=np.nan) != 0.0  # evaluate repeated positions of a resting axis once
            values = function(position_mm[new])[np.cumsum(new) - 1]
        shift = values[:, :3].copy()
        shift[:, axis] += self.extra_scale[axis] * (position_mm - self.geometry.low_mm[axis])
        c0y, b0z, a0z = self.draws.squareness
        if axis == 1:
            shift[:, 0] -= c0y * position_mm
        elif axis == 2:
            shift[:, 0] += b0z * position_mm
            shift[:, 1] -= a0z * position_mm
        return shift, values[:, 3:]

    def tool_position(self, axes_mm: F) -> F:
        """Return the position of the functional point relative to the workpiece, mm: axis positions (n, 3) give (n, 3).

        Without errors the result is axis positions + tool_mm.
        """
        geometry = self.geometry
        point = np.broadcast_to(geometry.tool_mm, axes_mm.shape)
        for axis in reversed(geometry.tool_side):  # from the tool inwards to the bed
            shift, angle = self.motions(axis, axes_mm[:, axis])
            shift[:, axis] += axes_mm[:, axis]
            pivot = geometry.pivots_mm[axis]
            point = pivot + rotate(angle, point - pivot) + shift
        for axis in reversed(geometry.work_side):  # from the bed outwards to the workpiece
            shift, angle = self.motions(axis, axes_mm[:, axis])
            shift[:, axis] += axes_mm[:, axis]
            pivot = geometry.pivots_mm[axis]
            point = pivot + rotate(angle, point + shift - pivot)
        return point

    def turned(self, axes_mm: F) -> F:
        """Return the tool's rotation against the workpiece, (n, 3) rad, at axis positions (n, 3): the carriages' sum to first order."""
        total: F = np.sum([self.motions(axis, axes_mm[:, axis])[1] for axis in range(3)], axis=0)
        return total


def rotate(angle_rad: F, vector: F) -> F:
    """Rotate n vectors by n rotation vectors (right-handed, Rodrigues): both (n, 3)."""
    square = np.einsum("ij,ij->i", angle_rad, angle_rad)
    first, second = _factors(square)
    once = _cross(angle_rad, vector)
    turned: F = vector + first[:, None] * once + second[:, None] * _cross(angle_rad, once)
    return turned


def _factors(square: F) -> tuple[F, F]:
    """Return sin(theta) / theta and (1 - cos(theta)) / theta^2 from theta^2; below 0.01 rad three terms of the series are exact."""
    if square.size and square.max() < 1e-4:
        return 1.0 - square / 6.0 * (1.0 - square / 20.0), 0.5 - square / 24.0 * (1.0 - square / 30.0)
    theta = np.sqrt(square)
    return np.sinc(theta / np.pi), 0.5 * np.sinc(theta / (2.0 * np.pi)) ** 2


def _cross(a: F, b: F) -> F:
    """Return the cross product of rows; numpy's own function is several times slower on short arrays."""
    out = np.empty(b.shape)
    out[:, 0] = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    out[:, 1] = a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]
    out[:, 2] = a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return out


class Play:
    """Three independent play operators with memory.

    An axis with lost motion B that moves in direction s is at drive position - s B/2; after a reversal the axis rests until the drive has
    travelled B.
    """

    def __init__(self, backlash_mm: F, start_mm: F) -> None:
        self._half = [0.5 * float(b) for b in backlash_mm]
        # A machine that homed towards its positive ends last moved in + direction.
        self.position_mm: F = start_mm - 0.5 * backlash_mm

    def run(self, drive_mm: F) -> F:
        """Return the axis positions (n, 3), mm, that follow n successive drive positions (n, 3), mm."""
        out = np.empty_like(drive_mm)
        for axis in range(3):
            out[:, axis] = self._run_axis(drive_mm[:, axis], self._half[axis], float(self.position_mm[axis]))
        self.position_mm = out[-1].copy()
        return out

    def ahead(self, drive_mm: F) -> F:
        """Return the result of `run` without changing the state."""
        kept = self.position_mm
        out = self.run(drive_mm)
        self.position_mm = kept
        return out

    @staticmethod
    def _run_axis(drive_mm: F, half_mm: float, start_mm: float) -> F | float:
        """Follow the drive of one axis; while the drive stays within the play, the axis rests."""
        if float(drive_mm.max()) - half_mm <= start_mm <= float(drive_mm.min()) + half_mm:
            return start_mm
        position = start_mm
        track = []
        for drive in drive_mm.tolist():
            if position < drive - half_mm:
                position = drive - half_mm
            elif position > drive + half_mm:
                position = drive + half_mm
            track.append(position)
        return np.array(track)
