"""The comparisons of the four papers, counted."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Literal

from abbe.service.reference.comparison import STATUSES, Comparison, Source, Status

Paper = Literal["pahk", "kwon", "yang", "wang"]
TITLES: dict[Paper, str] = {
    "pahk": "Pahk 1995: numerical CMM (paper 000)",
    "kwon": "Kwon et al. 2004: position error of a 3-DOF parallel mechanism (paper 001)",
    "yang": "Yang and Kim: hemispherical helix ball-bar test (paper 002)",
    "wang": "Wang: laser vector measurement, part I (paper 004)",
}
FORMAT = "abbe-papers/1"


@dataclass(frozen=True, slots=True)
class PaperResult:
    """One paper with its comparisons: printed numbers, numbers of math.md (see `comparison`), and own checks, counted separately."""

    paper: Paper
    title: str
    comparisons: tuple[Comparison, ...]

    def of(self, *sources: Source) -> list[Comparison]:
        """Return the comparisons with numbers of these sources, one source after the other."""
        return [c for source in sources for c in self.comparisons if c.source == source]

    @property
    def numbers(self) -> list[Comparison]:
        """The comparisons with printed numbers, then with those of math.md."""
        return self.of("paper", "math.md")

    def counts(self, source: Source = "paper") -> dict[Status, int]:
        """Count the numbers of a source by status."""
        counted = [c.status for c in self.of(source) if not c.again]
        return {status: counted.count(status) for status in STATUSES[source]}

    def to_document(self) -> dict[str, Any]:
        """Return the JSON value for ``--json``."""
        return {
            "paper": self.paper,
            "title": self.title,
            "numbers": self.counts(),
            "numbers_of_math_md": self.counts("math.md"),
            "own_checks": self.counts("own check"),
            "rows": [{"paper": self.paper, **c.to_document()} for c in self.numbers],
            "checks": [{"paper": self.paper, **c.to_document()} for c in self.of("own check")],
        }


def results(papers: Iterable[Paper] = tuple(TITLES)) -> list[PaperResult]:
    """Compute the numbers of papers, in the order of `TITLES`."""
    wanted = set(papers)
    # Import a paper's module on demand, because scipy loads slowly.
    return [
        PaperResult(paper, title, tuple(import_module(f"abbe.service.reference.papers.{paper}").comparisons()))
        for paper, title in TITLES.items()
        if paper in wanted
    ]


def document(found: Sequence[PaperResult]) -> dict[str, Any]:
    """Return the JSON document for ``--json``."""
    return {"format": FORMAT, "papers": [f.to_document() for f in found]}
