"""The papers as a report: printed and computed numbers, and the papers' pictures."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version

from abbe.service.reference.comparison import STATUSES, Comparison
from abbe.service.reference.paper_results import PaperResult
from abbe.service.reference.papers.pictures import figures
from abbe.service.reference.text import NONE, line_of
from abbe.service.rendering.document import Document, Lines, Section, TextTable

MARKS = {"reproduced": "✔", "consistent": "≈", "differs": "≠", "input": "▷", "not reproducible": "○", "holds": "✔", "fails": "✘"}
INTRODUCTION = (
    "Every number below stands in print; beside it is the number computed from the paper's own inputs. The status follows from the two."
    " Reproduced: computed from independent inputs and equal to the last printed digit. Consistent: not equal to that digit, but no farther"
    " apart than the rounding of the printed inputs allows (column “within”), or a bound that holds, or equal only under an assumption that"
    " the row names. Differs: farther apart. Input: given, or zero by construction, so there is nothing to compute. Not reproducible: the"
    " paper does not print the necessary inputs. Rows “math.md” compare numbers of the mathematical specification that comes with the"
    " vector files. They and own checks are not counted."
)
CHECKS = "An own check puts numbers of the paper into Abbe's functions and computes them back: it tests these functions, not the paper."
_UNIT_AFTER = re.compile(r"(?<=\d) (?=(?:µm|mm|nm|µrad|mrad|rad|°|%)(?!\w))")
"""Space between a number and its unit, where a line must not break."""


def papers_report(found: Sequence[PaperResult]) -> Document:
    """Return the report of papers; equal results give equal bytes."""
    summary = [(f.title, *(str(n) for n in f.counts().values())) for f in found]
    return Document(
        kind="papers",
        title="The four papers, recomputed",
        about={"abbe": version("abbe")},
        sections=(
            Section("Printed numbers", (INTRODUCTION, TextTable(("Paper", *STATUSES["paper"]), summary))),
            *(_paper(f) for f in found),
        ),
        signatures=(),
    )


def _paper(found: PaperResult) -> Section:
    notes: dict[str, int] = {}
    pictures = [replace(p, caption=_unbroken(p.caption)) for p in figures(found.paper)]
    numbers = _table("Printed", found.numbers, notes)
    checks = found.of("own check")
    own = [Section("Own checks on its numbers", (CHECKS, _table("Given", checks, notes)))] if checks else []
    return Section(found.title, (*pictures, numbers, *own, Section("How and why", (Lines(tuple(notes), numbered=True),))))


def _table(expected: str, comparisons: Sequence[Comparison], notes: dict[str, int]) -> TextTable:
    """Return the table of comparisons, and add its notes to ``notes``, the numbered notes of the section."""
    rows = []
    for comparison in comparisons:
        line = line_of(comparison)
        location = f"math.md, {line.location}" if comparison.source == "math.md" else line.location
        text = _unbroken(". ".join(part for part in (comparison.how, line.note) if part))
        cells = ("" if cell == NONE else cell for cell in (line.expected, line.computed, line.difference, line.within))
        status = f"{MARKS[line.status]} {line.status}".replace(" ", "\u00a0")
        rows.append((location, _unbroken(line.quantity), *cells, status, str(notes.setdefault(text, len(notes) + 1))))
    return TextTable(("Where", "Quantity", expected, "Computed", "Off by", "Within", "Status", "Note"), rows)


def _unbroken(text: str) -> str:
    """Put non-breaking spaces between numbers and units."""
    return _UNIT_AFTER.sub("\u00a0", text)
