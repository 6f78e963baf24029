"""The rows of the four papers, counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, get_args

from abbe.service.papers.check import Outcome, PaperCheck, count
from abbe.service.papers.row import Paper, PaperRow, Source, Status

TITLES: dict[Paper, str] = {
    "pahk": "Pahk 1995: numerical CMM (paper 000)",
    "kwon": "Kwon et al. 2004: position error of a 3-DOF parallel mechanism (paper 001)",
    "yang": "Yang and Kim: hemispherical helix ball-bar test (paper 002)",
    "wang": "Wang: laser vector measurement, part I (paper 004)",
}
FORMAT = "abbe-papers/1"
CHECKED: frozenset[Paper] = frozenset({"kwon", "yang"})
"""Papers with checks of Abbe's functions."""


@dataclass(frozen=True, slots=True)
class PaperResult:
    """One paper with its rows and with checks of Abbe's functions, which are counted separately."""

    paper: Paper
    title: str
    rows: tuple[PaperRow, ...]
    checks: tuple[PaperCheck, ...]

    def counts(self, source: Source = "paper") -> dict[Status, int]:
        """Count of numbers by status: those of the paper, or those that math.md adds."""
        rows = [r for r in self.rows if r.source == source and not r.again]
        return {status: sum(1 for r in rows if r.status == status) for status in get_args(Status)}

    def check_counts(self) -> dict[Outcome, int]:
        """Count of checks by outcome."""
        return count(self.checks)

    def doc(self) -> dict[str, Any]:
        """For ``--json``."""
        return {
            "paper": self.paper,
            "title": self.title,
            "numbers": self.counts(),
            "numbers_of_math_md": self.counts("math.md"),
            "own_checks": self.check_counts(),
            "rows": [r.doc() for r in self.rows],
            "checks": [c.doc() for c in self.checks],
        }


def results(papers: Iterable[Paper] = tuple(TITLES)) -> list[PaperResult]:
    """Compute the rows of papers in the order of `TITLES`: first the printed numbers, then those that math.md adds."""
    wanted = set(papers)
    found = []
    for paper, title in TITLES.items():
        if paper in wanted:
            # Load a paper's module on demand: scipy loads slowly.
            module = import_module(f"abbe.service.papers.{paper}")
            rows: list[PaperRow] = module.rows()
            checks: list[PaperCheck] = module.checks() if paper in CHECKED else []
            own = [r for r in rows if r.source == "paper"]
            found.append(PaperResult(paper, title, (*own, *(r for r in rows if r.source != "paper")), tuple(checks)))
    return found


def document(found: Sequence[PaperResult]) -> dict[str, Any]:
    """JSON document for ``--json``."""
    return {"format": FORMAT, "papers": [f.doc() for f in found]}
