"""The nominal machine: chain of carriages, strokes, pivots, tool."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from abbe.models.arrays import F1, F2, F3

AXES = ("X", "Y", "Z")


@dataclass(frozen=True)
class Machine:
    """Nominal geometry of a 3-axis machine (docs/explanation/conventions.md).

    Parameters
    ----------
    chain : str
        Carriages from workpiece ``w`` over the bed ``b`` to the tool ``t``, e.g. ``"w-X-Y-b-Z-t"``; X, Y, Z once each.
    stroke_mm : array, shape (3, 2)
        First and last commanded position of X, Y, Z.
    pivots_mm : array, shape (3, 3)
        Pivot of the X, Y, Z carriage: table frame for a work-side carriage, relative to the spindle reference for a tool-side one.
    tool_mm : array, shape (3,)
        Vector from the spindle reference to the functional point.

    Raises
    ------
    ValueError
        The chain is invalid, an array has another shape or holds a number that is not finite, or a stroke is empty.
    """

    chain: str
    stroke_mm: F2
    pivots_mm: F2 = field(default_factory=lambda: np.zeros((3, 3)))
    tool_mm: F1 = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        """Check the geometry and turn it into float64 arrays."""
        for name, shape in (("stroke_mm", (3, 2)), ("pivots_mm", (3, 3)), ("tool_mm", (3,))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f"machine: {name} must hold finite numbers in shape {shape}; its shape is {value.shape}")
            object.__setattr__(self, name, value)
        if (self.stroke_mm[:, 1] <= self.stroke_mm[:, 0]).any():
            raise ValueError("machine: every stroke_mm must run from its smaller to its larger position")
        split_chain(self.chain)

    @property
    def length_mm(self) -> F1:
        """Stroke lengths of X, Y, Z, shape (3,)."""
        length: F1 = self.stroke_mm[:, 1] - self.stroke_mm[:, 0]
        return length

    @property
    def centre_mm(self) -> F1:
        """Middle of the strokes, shape (3,)."""
        centre: F1 = 0.5 * (self.stroke_mm[:, 0] + self.stroke_mm[:, 1])
        return centre


def split_chain(chain: str) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the carriages of a chain as axis indices: (work side from workpiece to bed, tool side from bed to tool).

    Raises
    ------
    ValueError
        The chain is not ``w-...-b-...-t`` with X, Y, Z once each.
    """
    parts = chain.split("-")
    carriages = [p for p in parts if p in AXES]
    if len(parts) != 6 or parts[0] != "w" or parts[-1] != "t" or parts.count("b") != 1 or sorted(carriages) != list(AXES):
        raise ValueError(f"chain {chain!r}: expected w-...-b-...-t with X, Y, Z once each, e.g. w-X-Y-b-Z-t")
    bed = parts.index("b")
    return tuple(AXES.index(p) for p in parts[1:bed]), tuple(AXES.index(p) for p in parts[bed + 1 : -1])


def lever_masks(chain: str) -> F3:
    """Return a mask, shape (3 carriages, 3 axes): 1 where the commanded travel of an axis is part of the lever arm of a carriage, else 0.

    Rule G (docs/explanation/conventions.md) counts, on the tool side, the travels of the carriages nearer the tool, and on the work side
    all travels except those of carriages nearer the workpiece.
    """
    work, tool = split_chain(chain)
    mask = np.zeros((3, 3))
    for k, j in enumerate(tool):
        mask[j, list(tool[k + 1 :])] = 1.0
    for k, j in enumerate(work):
        mask[j] = 1.0
        mask[j, list(work[:k])] = 0.0
    return mask


def levers_mm(machine: Machine, axes_mm: F2, tool_mm: F1 | F2 | None = None) -> F3:
    """Return the lever arms r_j of rule G (docs/explanation/conventions.md) at commanded positions, mm.

    Parameters
    ----------
    axes_mm : array, shape (n, 3)
    tool_mm : array, shape (3,) or (n, 3), optional
        Tool vector in place of ``machine.tool_mm``: one for all positions or one per position.

    Returns
    -------
    array, shape (n, 3 carriages, 3)

    Raises
    ------
    ValueError
        ``tool_mm`` has another shape.
    """
    travel: F3 = np.asarray(axes_mm, dtype=np.float64)[:, None, :] * lever_masks(machine.chain)[None]
    tool = machine.tool_mm if tool_mm is None else np.asarray(tool_mm, dtype=np.float64)
    if tool.shape not in ((3,), (travel.shape[0], 3)):
        raise ValueError(f"tool_mm: expected shape (3,) or ({travel.shape[0]}, 3), got {tool.shape}")
    return travel + (tool[:, None, :] if tool.ndim == 2 else tool) - machine.pivots_mm[None]


def with_tool(machine: Machine, tool_mm: F1 | None) -> Machine:
    """Return the machine with another tool vector; with None, the machine itself."""
    return machine if tool_mm is None else replace(machine, tool_mm=tool_mm)
