"""Input of a discovery: runs with paths, readings and roles, and which errors the present simulation includes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from abbe.models.arrays import F1
from abbe.models.effects.path import Path
from abbe.models.machine import Machine
from abbe.models.solvers.observations import RunData

Role = Literal["identify", "holdout", "sealed"]


@dataclass(frozen=True)
class CaseRun:
    """One run. ``deviation_mm`` (n,) is None for a sealed run; ``valid`` (n,) is False for readings that the instrument flagged."""

    path: Path
    role: Role
    deviation_mm: F1 | None
    valid: np.ndarray[tuple[int], np.dtype[np.bool_]]
    u_length_mm: float | None = None
    length_calibrated: bool | None = None

    def data(self) -> RunData:
        """Return the run as solver input with all its readings; flagged readings, and those of a sealed run, are set to zero."""
        p = self.path
        reading = np.zeros(p.n) if self.deviation_mm is None else np.where(self.valid, self.deviation_mm, 0.0)
        bar = p.kind == "bar"
        return RunData(
            p.label, p.setup, p.kind, p.at.q_mm, reading, p.at.sign, p.at.t_s, np.ones(p.n),
            centre_mm=p.centre_mm if bar else None, radius_mm=p.radius_mm if bar else None, beam=None if bar else p.look[0],
            u_length_mm=self.u_length_mm, length_calibrated=self.length_calibrated, tool_mm=p.machine.tool_mm,
        )  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A campaign to be searched.

    Attributes
    ----------
    includes : frozenset of str
        Errors that the present simulation includes: ``rigid6`` or ``rigid21``, ``setup_centre_offset``, ``bar_length_error``,
        ``mirror_tilt``.
    resolution_mm : smallest step of the readings of "bar" and "laser".
    """

    name: str
    machine: Machine
    includes: frozenset[str]
    runs: tuple[CaseRun, ...]
    resolution_mm: dict[str, float]

    def of(self, *roles: Role) -> tuple[CaseRun, ...]:
        """Return the runs with one of the roles, in the order of ``runs``."""
        return tuple(r for r in self.runs if r.role in roles)
