"""`abbe papers`: every printed number of the four papers beside the computed one."""

from __future__ import annotations

import sys
import textwrap
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, print_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from rich.console import Console

    from abbe.service.papers.check import Outcome
    from abbe.service.papers.row import PaperRow, Status
    from abbe.service.papers.run import PaperResult

WIDTH = 120
"""Width of piped output, columns; a terminal has its own."""

HEADINGS = ("where", "quantity", "printed", "computed", "off by", "within", "status", "note")
CHECK_HEADINGS = ("check", "given", "came back", "off by", "bound", "status", "note")
FOLDED = frozenset({"quantity", "check"})
"""Columns that may wrap; the others hold one word or number."""

DROPPED = (("within", 112), ("off by", 100), ("note", 76), ("where", 72), ("given", 72))
"""Columns to drop first, each with the width below which it is dropped: a status must stay in one piece."""

NAME = 12
"""Minimum width of a column of names."""

LEGEND = (
    "reproduced: computed from independent inputs and equal to the last printed digit; consistent: apart by no more than what rounded"
    " inputs allow (within), or a bound that holds; input: given, nothing to compute; not reproducible: the paper does not hold what it"
    " takes"
)


class PaperName(StrEnum):
    """The four papers."""

    pahk = "pahk"
    kwon = "kwon"
    yang = "yang"
    wang = "wang"


def papers(
    paper: Annotated[PaperName | None, typer.Option("--paper", help="Only this paper.", show_default=False)] = None,
    as_json: JsonOption = False,
    html: Annotated[
        Path | None, typer.Option("--html", metavar="FILE", help="Also write a report with the papers' pictures.", show_default=False)
    ] = None,
) -> None:
    """Compute the numbers that the four papers print, beside the printed ones, and state why some cannot be computed."""
    from abbe.service.papers.run import TITLES, document, results

    found = results(TITLES if paper is None else (paper.value,))
    if html is not None:
        from abbe.service.papers.page import write_page

        write_page(found, html)
    if as_json:
        print_json(document(found))
        return
    from rich.console import Console

    show(found, Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=WIDTH))
    if html is not None:
        typer.echo(f"report: {html}")


def show(found: Sequence[PaperResult], console: Console) -> None:
    """Write the tables, their notes and their counts; the console's width decides which columns wrap or are dropped."""
    for result in found:
        notes: dict[str, int] = {}
        _numbers(console, result.title, [r for r in result.rows if r.source == "paper"], notes)
        _numbers(console, "Stated by math.md", [r for r in result.rows if r.source != "paper"], notes)
        _checks(console, result, notes)
        for text, key in notes.items():
            _wrapped(console, text, f"{key:>3}  ")
        _count(console, result.counts(), "printed numbers")
        _count(console, result.counts("math.md"), "numbers of math.md")
        _count(console, result.check_counts(), "own checks (no printed numbers)")
        console.print()
    _wrapped(console, LEGEND)


def _numbers(console: Console, title: str, rows: Sequence[PaperRow], notes: dict[str, int]) -> None:
    from abbe.service.papers.text import lines

    cells = [
        (line.where, line.quantity, line.printed, line.computed, line.difference, line.within, line.status, _key(line.note, notes))
        for line in lines(rows)
    ]
    if cells:
        _table(console, title, HEADINGS, cells)


def _checks(console: Console, result: PaperResult, notes: dict[str, int]) -> None:
    from abbe.service.papers.text import check_lines

    cells = [(*line[:-1], _key(line[-1], notes)) for line in check_lines(result.checks)]
    if cells:
        _table(console, "Own checks on its numbers: what comes back is what was put in", CHECK_HEADINGS, cells)


def _key(note: str, notes: dict[str, int]) -> str:
    return str(notes.setdefault(note, len(notes) + 1)) if note else ""


def _table(console: Console, title: str, headings: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    dropped = {name for name, width in DROPPED if console.width < width}
    kept = [i for i, name in enumerate(headings) if name not in dropped]
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    for i in kept:
        folds = headings[i] in FOLDED
        table.add_column(headings[i], no_wrap=not folds, min_width=max(len(headings[i]), NAME if folds else 0))
    for row in rows:
        table.add_row(*(Text(row[i]) for i in kept))  # Text: brackets in names are not markup
    console.print(table)


def _wrapped(console: Console, text: str, first: str = "") -> None:
    width = min(WIDTH, console.width) - 2
    console.print(textwrap.fill(text, width, initial_indent=first, subsequent_indent=" " * len(first)), markup=False, soft_wrap=True)


def _count(console: Console, counts: Mapping[Status, int] | Mapping[Outcome, int], name: str) -> None:
    if total := sum(counts.values()):
        _wrapped(console, f"{total} {name}: " + ", ".join(f"{count} {status}" for status, count in counts.items()))
