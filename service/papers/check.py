"""Checks of our own functions on a paper's numbers. What comes back is what was put in: proof of the function, not of the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from abbe.service.papers.row import Paper

Outcome = Literal["holds", "fails"]


@dataclass(frozen=True, slots=True)
class PaperCheck:
    """A number that has to come back within a bound.

    Attributes
    ----------
    paper, where : str
        Whose numbers are used, and where the bound or the demand stands.
    quantity, unit : str
    expected, found, bound : float
        In ``unit``; holds when the two are nearer than ``bound``.
    how : str
        Through which functions.
    why : str
        Why this bound, and what is assumed.
    series : str
        Name of the group that a check belongs to; people see a group in one line.
    """

    paper: Paper
    where: str
    quantity: str
    unit: str
    expected: float
    found: float
    bound: float
    how: str
    why: str
    series: str

    @property
    def deviation(self) -> float:
        """Found minus expected."""
        return self.found - self.expected

    @property
    def status(self) -> Outcome:
        """What the numbers say."""
        return "holds" if abs(self.deviation) < self.bound else "fails"

    def doc(self) -> dict[str, Any]:
        """For ``--json``."""
        return {**asdict(self), "deviation": self.deviation, "status": self.status}


def count(checks: Sequence[PaperCheck]) -> dict[Outcome, int]:
    """Checks by outcome."""
    holding = sum(1 for c in checks if c.status == "holds")
    return {"holds": holding, "fails": len(checks) - holding}
