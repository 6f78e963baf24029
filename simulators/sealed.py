"""The ``truth`` command: error figures and drawn parameters of a scenario's machine, with a compensation image or without."""

import struct
from collections.abc import Callable

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.cnc import bank
from abbe.simulators.hidden.live import live_of
from abbe.simulators.scenario import Scenario, ScenarioError
from abbe.simulators.truth.draws import describe, draw_machine
from abbe.simulators.truth.machine import Geometry, Machine

Correction = Callable[[F], F]
"""Maps commanded positions (n, 3) mm to the corrections added to them, (n, 3) mm."""

DIAGONALS = {"ppp": (1, 1, 1), "npp": (-1, 1, 1), "pnp": (1, -1, 1), "ppn": (1, 1, -1)}
DIAGONAL_POINTS = 31
FINE_NODES = 13


def no_correction(command_mm: F) -> F:
    """Return zero corrections."""
    return np.zeros_like(command_mm)


def grid(machine: Machine, nodes: int) -> F:
    """Return the nodes of a cubic grid over the full stroke: (nodes^3, 3) mm, X outermost."""
    low, high = machine.geometry.low_mm, machine.geometry.high_mm
    axes = [np.linspace(low[a], high[a], nodes) for a in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def deviation(machine: Machine, command_mm: F, correction: Correction = no_correction) -> F:
    """Return actual - nominal position at n commanded positions: (n, 3) mm. Mean of both approach directions (no backlash), no drift."""
    actual = machine.tool_position(command_mm + correction(command_mm))
    nominal: F = command_mm + machine.geometry.tool_mm
    return actual - nominal


def without_rigid_motion(points_mm: F, deviation_mm: F) -> F:
    """Return deviations (n, 3) mm minus their best-fit rigid motion (translation + small rotation, least squares)."""
    arm = points_mm - points_mm.mean(axis=0)
    n = len(arm)
    design = np.zeros((n, 3, 6))
    design[:, [0, 1, 2], [0, 1, 2]] = 1.0
    design[:, 0, 4], design[:, 0, 5] = arm[:, 2], -arm[:, 1]
    design[:, 1, 3], design[:, 1, 5] = -arm[:, 2], arm[:, 0]
    design[:, 2, 3], design[:, 2, 4] = arm[:, 1], -arm[:, 0]
    flat = design.reshape(-1, 6)
    motion, *_ = np.linalg.lstsq(flat, deviation_mm.reshape(-1), rcond=None)
    rest: F = deviation_mm - (flat @ motion).reshape(-1, 3)
    return rest


def without_one_axis_functions(deviation_mm: F, nodes: int) -> F:
    """Return the deviations on a cubic grid, (nodes^3, 3) mm, that would remain with nine perfect one-axis tables.

    The tables are the least-squares sum of one-axis functions: on a full product grid this is the mean plus the main effects.
    """
    field = deviation_mm.reshape(nodes, nodes, nodes, 3)
    mean = field.mean(axis=(0, 1, 2))
    effects = [field.mean(axis=tuple(b for b in range(3) if b != a), keepdims=True) - mean for a in range(3)]
    rest: F = field - mean - effects[0] - effects[1] - effects[2]
    return rest.reshape(-1, 3)


def rms_norm(vectors: F) -> float:
    """Return the root mean square of the vectors' lengths."""
    return float(np.sqrt(np.mean(np.sum(vectors * vectors, axis=1))))


def body_diagonals_um(machine: Machine, correction: Correction = no_correction, inside_mm: float = 0.0) -> dict[str, float]:
    """Return the range (max - min) of the deviation along each body diagonal of the box ``inside_mm`` inside the strokes, µm."""
    low, high = machine.geometry.low_mm + inside_mm, machine.geometry.high_mm - inside_mm
    result = {}
    for name, signs in DIAGONALS.items():
        forward = np.array(signs) > 0
        begin, end = np.where(forward, low, high), np.where(forward, high, low)
        points = begin + np.linspace(0.0, 1.0, DIAGONAL_POINTS)[:, None] * (end - begin)
        along = deviation(machine, points, correction) @ ((end - begin) / np.linalg.norm(end - begin))
        result[name] = 1000.0 * float(along.max() - along.min())
    return result


def best_nine_tables_rms_um(machine: Machine, nodes: int = FINE_NODES) -> float:
    """Return the rms of the deviations in µm that nine perfect one-axis tables would leave on this machine, rigid motion removed."""
    points = grid(machine, nodes)
    rest = without_one_axis_functions(deviation(machine, points), nodes)
    return 1000.0 * rms_norm(without_rigid_motion(points, rest))


def report(machine: Machine, correction: Correction, nodes: int, *, arrows: bool = False, inside_mm: float = 0.0) -> dict[str, object]:
    """Return all error figures of the machine with a correction (µm); ``arrows`` adds grid and deviation vectors for plotting.

    ``inside_mm``: as in `body_diagonals_um`.
    """
    points = grid(machine, nodes)
    rest = without_rigid_motion(points, deviation(machine, points, correction))
    diagonals = body_diagonals_um(machine, correction, inside_mm)
    figures: dict[str, object] = {
        "max_body_diagonal_um": max(diagonals.values()),
        "body_diagonals_um": diagonals,
        "volumetric_rms_um": 1000.0 * rms_norm(rest),
        "volumetric_max_um": 1000.0 * float(np.linalg.norm(rest, axis=1).max()),
        "best_nine_tables_rms_um": best_nine_tables_rms_um(machine),
        "nodes": nodes,
    }
    if arrows:
        figures["grid_mm"] = points.tolist()
        figures["deviation_um"] = (1000.0 * rest).tolist()
    return figures


def plane_rms_um(machine: Machine, correction: Correction, box_mm: list[float]) -> float:
    """Return the rms deviation in a plane of X and Y, µm, rigid motion in it removed. ``box_mm``: lowest and highest X, then Y, and Z."""
    x0, x1, y0, y1, z = box_mm
    axes = np.meshgrid(np.linspace(x0, x1, FINE_NODES), np.linspace(y0, y1, FINE_NODES), indexing="ij")
    points = np.stack([*axes, np.full(axes[0].shape, z)], axis=-1).reshape(-1, 3)
    flat = deviation(machine, points, correction) * [1.0, 1.0, 0.0]
    arm = points - points.mean(axis=0)
    turn = np.stack([-arm[:, 1], arm[:, 0]], axis=1)
    own = flat[:, :2] - flat[:, :2].mean(axis=0)
    rest = own - turn * (np.sum(turn * own) / np.sum(turn * turn))
    return 1000.0 * rms_norm(rest)


def truth(
    scenario: Scenario,
    image: bytes | None,
    nodes: int,
    *,
    arrows: bool = False,
    plane: list[float] | None = None,
    inside_mm: float = 0.0,
) -> dict[str, object]:
    """Return the true errors of a scenario's machine; ``image`` is a compensation image as big-endian bytes, None for no correction.

    ``plane``: box of which `plane_rms_um` is added; ``inside_mm``: as in `body_diagonals_um`.
    """
    draws = draw_machine(scenario)
    machine = Machine(Geometry(scenario.machine), draws)
    secret = live_of(scenario.hidden, machine.geometry.low_mm, machine.geometry.high_mm)
    hidden: dict[str, object] = {} if secret is None else {"hidden": secret.describe()}
    correction = no_correction if image is None else _correction(image)
    flat: dict[str, object] = {} if plane is None else {"plane_rms_um": plane_rms_um(machine, correction, plane)}
    return {**report(machine, correction, nodes, arrows=arrows, inside_mm=inside_mm), **describe(draws), **hidden, **flat}


def _correction(image: bytes) -> bank.Correction:
    if len(image) % 2:
        raise ScenarioError("bank image: it has an odd number of bytes")
    try:
        return bank.parse(list(struct.unpack(f">{len(image) // 2}H", image)))[1]
    except bank.ImageError as exc:
        raise ScenarioError(f"bank image: {exc}") from exc
