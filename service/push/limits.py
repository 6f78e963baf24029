"""Limits of a table to be pushed (reliability.md 3.3). Exceeding one rejects the table; nothing is ever clamped to a limit."""

from __future__ import annotations

import hashlib
from dataclasses import asdict, dataclass

from abbe.service.push.entries import canonical


@dataclass(frozen=True, slots=True)
class PushLimits:
    """Every limit that can reject a table. Lengths mm, times h, temperatures °C. Defaults are those of reliability.md 3.3.

    Parameters
    ----------
    value_mm, change_mm : float
        Largest absolute value, largest change against the table in force.
    step_mm, slope : float
        Largest difference of neighbours; the same per mm of travel.
    second_mm : float
        Largest second difference.
    gain, k : float
        Least relative improvement of the residual; and by how many expanded uncertainties it has to exceed.
    share : float
        The uncertainty may be at most this share of the predicted improvement.
    age_h, temperature_c, drift_mm, runs : float, pair, float, int
        Oldest measurement, window of the air, largest drift between its first and last run, fewest runs.
    unattended_h, walk_mm : float
        Unattended: hours between two pushes; largest change of the table over 30 days.
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

    def digest(self) -> str:
        """SHA-256 that an approval binds: it does not hold under other limits."""
        return hashlib.sha256(canonical(asdict(self))).hexdigest()
