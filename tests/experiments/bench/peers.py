"""What a user would take instead: homogeneous transforms in numpy, sympy's lambdify, pytransform3d's batches.

All three work the exact chain w-X-Y-b-Z-t (docs/explanation/conventions.md) and return actual minus nominal, shape (n, 3).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.arrays import F2, F3
from tests.experiments.bench.case import SIDE, Case


def htm(case: Case, *, small_angles: bool = False, even: bool = False) -> Callable[[], F2]:
    """(a) 4 x 4 matrices for every point, one for a carriage's rotation and one for its translation, multiplied by `numpy.matmul`.

    ``small_angles``: 1 and the angles in the matrix in place of Rodrigues' rotation. ``even``: `Case.even_look_up` for `numpy.interp`.
    """
    tool, square = np.append(case.tables.machine.tool_mm, 1.0), case.tables.squareness_rad
    rotation = _small_rotation if small_angles else _rotation
    values = case.even_look_up() if even else case.table_values

    def run() -> F2:
        v, p = values(), case.points
        tx, ty, tz = _translations(v, p, square)
        z = rotation(v[15:18])
        z[:, :3, 3] = tz  # tool side: the translation stands left of the rotation, so one matrix holds both
        total = rotation(v[3:6]) @ _shift(tx) @ rotation(v[9:12]) @ _shift(ty) @ z
        return (total @ tool)[:, :3] - p - tool[:3]

    return run


def pytransform3d(case: Case) -> Callable[[], F2]:
    """(c) The same chain with pytransform3d's batch functions: compact axis-angle to matrices, `concat_many_to_many`."""
    from pytransform3d.batch_rotations import matrices_from_compact_axis_angles
    from pytransform3d.trajectories import concat_many_to_many

    tool, square = np.append(case.tables.machine.tool_mm, 1.0), case.tables.squareness_rad

    def rotation(angles: F2) -> F3:
        out = np.zeros((angles.shape[1], 4, 4))
        out[:, :3, :3], out[:, 3, 3] = matrices_from_compact_axis_angles(angles.T), 1.0
        return out

    def run() -> F2:
        v, p = case.table_values(), case.points
        tx, ty, tz = _translations(v, p, square)
        total = rotation(v[15:18])
        total[:, :3, 3] = tz
        for step in (_shift(ty), rotation(v[9:12]), _shift(tx), rotation(v[3:6])):
            total = concat_many_to_many(total, step)
        return (total @ tool)[:, :3] - p - tool[:3]

    return run


def sympy(case: Case, *, open_grid: bool = False, even: bool = False, rule_g: bool = False) -> Callable[[], F2]:
    """(b) The exact chain as sympy expressions, compiled to numpy by `lambdify(cse=True)`; compiling is not timed.

    ``open_grid``: on the grid, give what depends on one axis as 100 numbers and let numpy broadcast, the most lambdify can be helped.
    ``even``: `Case.even_look_up` in place of `numpy.interp`. ``rule_g``: our first-order formula in place of the exact chain.
    """
    function = _lambdified(case, rule_g)
    values = case.even_look_up() if even else case.table_values

    def run() -> F2:
        v, p = values(), case.points
        return np.stack(function(*p.T, *v), axis=1)

    def run_open() -> F2:
        v, axes, shapes = [], [], np.eye(3, dtype=int) * (SIDE - 1) + 1
        for a, table in enumerate(case.tables.tables):
            nodes = np.linspace(*case.tables.range_mm[a], len(table))
            axes.append(case.axes[a].reshape(shapes[a]))
            v.extend(np.interp(case.axes[a], nodes, table[:, c]).reshape(shapes[a]) for c in range(6))
        return np.stack(np.broadcast_arrays(*function(*axes, *v)), axis=-1).reshape(-1, 3)

    return run_open if open_grid else run


def look_up(case: Case, *, open_grid: bool = False, even: bool = False) -> Callable[[], object]:
    """What of a peer's call is the look-up of table values."""
    if open_grid:
        nodes = [np.linspace(*case.tables.range_mm[a], len(t)) for a, t in enumerate(case.tables.tables)]
        return lambda: [np.interp(case.axes[a], nodes[a], t[:, c]) for a, t in enumerate(case.tables.tables) for c in range(6)]
    return case.even_look_up() if even else case.table_values


def _lambdified(case: Case, rule_g: bool):
    import sympy as sp

    axes = sp.symbols("x y z")
    values = [sp.symbols(" ".join(f"E{c}{a}" for c in "XYZABC")) for a in "XYZ"]
    c0y, b0z, a0z = (float(s) for s in case.tables.squareness_rad)
    square = [sp.zeros(3, 1), sp.Matrix([-c0y, 1, 0]) - sp.Matrix([0, 1, 0]), sp.Matrix([b0z, -a0z, 0])]
    tool = sp.Matrix([float(t) for t in case.tables.machine.tool_mm])
    p, first_order = tool, sp.zeros(3, 1)
    for j, work in ((2, False), (1, True), (0, True)):
        error, travel = sp.Matrix(values[j][:3]) + square[j] * axes[j], sp.eye(3)[:, j] * axes[j]
        if rule_g:
            first_order += error + sp.Matrix(values[j][3:]).cross(p + travel if work else p)
            p = p + travel
            continue
        d = error + travel
        ea, eb, ec = values[j][3:]
        rotation = sp.rot_axis3(-ec) * sp.rot_axis2(-eb) * sp.rot_axis1(-ea)  # sympy's rot_axis turn clockwise
        p = rotation * (p + d) if work else rotation * p + d
    result = first_order if rule_g else p - tool - sp.Matrix(axes)
    return sp.lambdify([*axes, *(s for v in values for s in v)], list(result), modules="numpy", cse=True)


def _translations(v: F2, p: F2, square: np.ndarray) -> list[F2]:
    """Travel, translational errors and squareness of the three carriages, shape (n, 3) each."""
    moves = [v[0:3].T.copy(), v[6:9].T.copy(), v[12:15].T.copy()]
    for a in range(3):
        moves[a][:, a] += p[:, a]
    moves[1][:, 0] -= square[0] * p[:, 1]
    moves[2][:, 0] += square[1] * p[:, 2]
    moves[2][:, 1] -= square[2] * p[:, 2]
    return moves


def _shift(t: F2) -> F3:
    out = np.zeros((len(t), 4, 4))
    out[:, [0, 1, 2, 3], [0, 1, 2, 3]] = 1.0
    out[:, :3, 3] = t
    return out


def _rotation(e: F2) -> F3:
    """Rotation by the vectors e, shape (3, n): Rodrigues, written out."""
    a, b, c = e
    angle = np.sqrt(a * a + b * b + c * c)
    s, h = np.sinc(angle / np.pi), 0.5 * np.sinc(angle / (2.0 * np.pi)) ** 2
    out = np.zeros((len(a), 4, 4))
    out[:, 0, 0], out[:, 0, 1], out[:, 0, 2] = 1.0 - h * (b * b + c * c), h * a * b - s * c, h * a * c + s * b
    out[:, 1, 0], out[:, 1, 1], out[:, 1, 2] = h * a * b + s * c, 1.0 - h * (a * a + c * c), h * b * c - s * a
    out[:, 2, 0], out[:, 2, 1], out[:, 2, 2] = h * a * c - s * b, h * b * c + s * a, 1.0 - h * (a * a + b * b)
    out[:, 3, 3] = 1.0
    return out


def _small_rotation(e: F2) -> F3:
    """1 plus the vectors e, shape (3, n), as a skew matrix."""
    a, b, c = e
    out = np.zeros((len(a), 4, 4))
    out[:, [0, 1, 2, 3], [0, 1, 2, 3]] = 1.0
    out[:, 1, 0], out[:, 0, 1] = c, -c
    out[:, 0, 2], out[:, 2, 0] = b, -b
    out[:, 2, 1], out[:, 1, 2] = a, -a
    return out
