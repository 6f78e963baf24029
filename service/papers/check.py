"""Round-trip checks of Abbe's functions on a paper's numbers. They prove the function, not the paper."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

from abbe.service.papers.row import Paper

Outcome = Literal["holds", "fails"]


@dataclass(frozen=True, slots=True)
class PaperCheck:
    """A number that must be reproduced within a bound.

    Attributes
    ----------
    paper, where : str
        Source of the numbers, and place of the bound or demand.
    expected, found, bound : float
        In ``unit``; the check holds if the two differ by less than ``bound``.
    how : str
        Functions that are checked.
    why : str
        Reason of the bound, and assumptions.
    series : str
        Group of the check; a group is shown in one line.
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
        """Outcome of the check."""
        return "holds" if abs(self.deviation) < self.bound else "fails"

    def doc(self) -> dict[str, Any]:
        """JSON value for ``--json``."""
        return {**asdict(self), "deviation": self.deviation, "status": self.status}


def count(checks: Sequence[PaperCheck]) -> dict[Outcome, int]:
    """Checks by outcome."""
    holding = sum(1 for c in checks if c.status == "holds")
    return {"holds": holding, "fails": len(checks) - holding}
