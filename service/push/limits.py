"""Limits of a table to be pushed, and the pushes that a control's capabilities allow.

A table beyond a limit is rejected; its values are never cut to the limit.
"""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass, fields

from abbe.service.domain.document import canonical


@dataclass(frozen=True, slots=True)
class PushLimits:
    """Every limit that can reject a table. Lengths mm, times h, temperatures °C.

    Parameters
    ----------
    value_mm, change_mm : float
        Largest absolute value, largest change against the table in force.
    step_mm, slope : float
        Largest difference of neighbouring values; the same per mm of travel.
    second_mm : float
        Largest second difference.
    gain, k : float
        Smallest predicted improvement of the rms: relative; and as a multiple of the model's standard uncertainty.
    beyond : float
        Largest part of a stroke, 0 to 1, that a table corrects beyond the positions of the runs, at either end.
    share : float
        Largest standard uncertainty of the model as a share of the predicted improvement.
    age_h, temperature_c, drift_mm, runs : float, pair, float, int
        Largest age of the measurement, range of the air temperature, largest rms residual of the solution in a newer run, fewest runs.
    unattended_h, walk_mm : float
        For unattended pushes: hours since the last kept push; largest change of a value over 30 days.
    """

    value_mm: float = 0.1
    change_mm: float = 0.05
    step_mm: float = 0.02
    slope: float = 0.002
    second_mm: float = 0.01
    gain: float = 0.1
    k: float = 2.0
    share: float = 0.5
    age_h: float = 72.0
    temperature_c: tuple[float, float] = (18.0, 24.0)
    drift_mm: float = 0.003
    runs: int = 3
    unattended_h: float = 24.0
    walk_mm: float = 0.05
    beyond: float = 0.25

    def digest(self) -> str:
        """SHA-256 of the limits. An approval binds it, and so does not hold under other limits."""
        return hashlib.sha256(canonical(asdict(self))).hexdigest()


@dataclass(frozen=True, slots=True)
class Capabilities:
    """Flags of one controller. Each is proved by its own commissioning test; an unproved one is False."""

    two_banks: bool = False
    swap_compares: bool = False
    """The controller refuses an activation when CRC or generation are not the expected ones."""
    generation: bool = False
    boot_id: bool = False
    interlocks: bool = False
    """The controller itself refuses an activation while the machine moves or an interlock is open."""
    lease: bool = False
    can_disable: bool = False
    """With one table only (`abbe.drivers.api.OneBank`), proved by ``abbe comp commission --one-bank``: the control refuses writes while the
    table acts, and a switch with a wrong CRC; switched off, it says so."""

    @property
    def level(self) -> int:
        """Allowed pushes. 3: unattended; 2: attended; 1: attended, one table; 0: none, the controller can only be read."""
        flags = [getattr(self, f.name) for f in fields(self) if f.name != "can_disable"]
        if all(flags):
            return 3
        if self.two_banks and self.generation and self.boot_id:
            return 2
        return 1 if self.can_disable else 0


NEEDS_ATTENDANCE = (
    "this controller is not proved to compare and swap, keep a lease and watch its axes: a person who approves has to be at the machine"
)


def objection(level: int, *, attended: bool) -> str:
    """Why a push is not allowed at this level; empty if it is."""
    if level >= 3:
        return ""
    if level in (1, 2):
        return "" if attended else NEEDS_ATTENDANCE
    return "this controller can only be read: export the table as a file"
