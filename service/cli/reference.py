"""`abbe papers` and `abbe vectors`: compare computed numbers with those printed in four papers and in independent files of test vectors."""

from __future__ import annotations

import sys
import textwrap
from collections.abc import Mapping, Sequence
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli import BAD_INPUT, complain
from abbe.service.cli.common import JsonOption, conclude, print_json, print_table
from abbe.service.errors import FileFormatError

if TYPE_CHECKING:
    from rich.console import Console

    from abbe.service.reference.comparison import Comparison, Source, Status
    from abbe.service.reference.paper_results import PaperResult
    from abbe.service.reference.vector_checks import Checks

WIDTH = 120
"""Width of piped output, columns; a terminal has its own."""

HEADINGS = ("where", "quantity", "printed", "computed", "off by", "within", "status", "note")
DROPPED = (("within", 112), ("off by", 100), ("note", 76), ("where", 72))
"""Columns to leave out of a narrow table, each with the width below which it is left out: a status must not be broken."""

NAME = 12
"""Minimum width of the column of names, the only one that may wrap."""

PARTS: dict[Source, tuple[str, str]] = {
    "paper": ("", "printed numbers"),
    "math.md": ("Stated by math.md, the specification of Abbe's formulas", "numbers of math.md"),
    "own check": ("Own checks: numbers that are put in must come back", "own checks (no printed numbers)"),
}
"""For each source of numbers, the title of its table (empty: the paper's title), and the name of its numbers in the summary."""

LEGEND = (
    "reproduced: computed from independent inputs, and equal to the last printed digit; consistent: off by no more than rounded inputs"
    " allow (column within), or a bound that holds; input: given, nothing to compute; not reproducible: the paper does not give the inputs"
)


class PaperName(StrEnum):
    """Names of the four papers, as ``--paper`` takes them."""

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
    """Compute the numbers that the four papers print, show printed and computed numbers side by side, and say why some cannot be
    computed."""
    from abbe.service.reference.paper_results import TITLES, document, results

    found = results(TITLES if paper is None else (paper.value,))
    if html is not None:
        from abbe.service.reference.page import papers_report
        from abbe.service.rendering.document_page import write_document

        write_document(papers_report(found), html)
    if as_json:
        print_json(document(found))
        return
    from rich.console import Console

    show_papers(found, Console(highlight=False) if sys.stdout.isatty() else Console(highlight=False, width=WIDTH))
    if html is not None:
        typer.echo(f"report: {html}")
    conclude("abbe papers --html papers.html" if html is None else "abbe effects")


def vectors(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with files of test vectors (*.json).")],
    as_json: JsonOption = False,
) -> None:
    """Recompute every number of the files from their own inputs, and compare. Exit code 1: a number deviates; 2: a file is unusable."""
    from abbe.service.reference.vector_results import check_file, document, vector_files

    checked = []
    for path in vector_files(folder):
        if not as_json:
            typer.echo(f"{path.name} ...", err=True)
        checked.append(check_file(path))
    doc = document(checked)
    if as_json:
        print_json(doc)
    else:
        _show_vectors(checked, doc["missing"])
        conclude("abbe papers")
    bad = [c.error for c in checked if c.error]
    for error in bad:
        complain(FileFormatError.code, error)
    if not doc["ok"]:
        raise typer.Exit(BAD_INPUT if bad else 1)


def show_papers(found: Sequence[PaperResult], console: Console) -> None:
    """Write the tables, their notes and their counts; the console's width decides which columns wrap or are dropped."""
    for result in found:
        notes: dict[str, int] = {}
        for source, (title, _) in PARTS.items():
            headings = tuple("given" if source == "own check" and name == "printed" else name for name in HEADINGS)
            _paper_table(console, title or result.title, headings, result.of(source), notes)
        for text, key in notes.items():
            _wrapped(console, text, f"{key:>3}  ")
        for source, (_, name) in PARTS.items():
            _count(console, result.counts(source), name)
        console.print()
    _wrapped(console, LEGEND)


def _paper_table(console: Console, title: str, headings: Sequence[str], comparisons: Sequence[Comparison], notes: dict[str, int]) -> None:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    from abbe.service.reference.text import lines

    if not comparisons:
        return
    dropped = {name for name, width in DROPPED if console.width < width}
    kept = [i for i, name in enumerate(headings) if name not in dropped]
    table = Table(title=title, box=SIMPLE_HEAD, title_justify="left", padding=(0, 1, 0, 0), pad_edge=False)
    for i in kept:
        folds = headings[i] == "quantity"
        table.add_column(headings[i], no_wrap=not folds, min_width=max(len(headings[i]), NAME if folds else 0))
    for line in lines(comparisons):
        key = str(notes.setdefault(line.note, len(notes) + 1)) if line.note else ""
        cells = (line.location, line.quantity, line.expected, line.computed, line.difference, line.within, line.status, key)
        table.add_row(*(Text(cells[i]) for i in kept))  # Text: brackets in names are not markup
    console.print(table)


def _wrapped(console: Console, text: str, first: str = "") -> None:
    width = min(WIDTH, console.width) - 2
    console.print(textwrap.fill(text, width, initial_indent=first, subsequent_indent=" " * len(first)), markup=False, soft_wrap=True)


def _count(console: Console, counts: Mapping[Status, int], name: str) -> None:
    if total := sum(counts.values()):
        _wrapped(console, f"{total} {name}: " + ", ".join(f"{count} {status}" for status, count in counts.items()))


def _show_vectors(checked: list[Checks], missing: list[str]) -> None:
    rows = [
        [
            c.file,
            q.name,
            str(q.cases),
            str(q.values),
            f"{q.max_abs:.1e} {q.unit}",
            f"{q.allowed:.1e}",
            f"{q.max_rel:.1e}",
            "ok" if q.ok else "DEVIATES",
        ]
        for c in checked
        for q in c.quantities.values()
    ]
    print_table(["file", "quantity", "cases", "values", "largest deviation", "allowed there", "relative", ""], rows)
    for c in checked:
        for line in _vector_notes(c):
            typer.echo(line)
    for name in missing:
        typer.echo(f"not in this folder: {name}")
    typer.echo(_vector_verdict(checked, missing))


def _vector_notes(c: Checks) -> list[str]:
    lines: list[str] = []
    for q in (*c.quantities.values(), *c.forms.values()):
        lines += [f"DEVIATES {text}" for text in q.failures]
    for q in c.quantities.values():
        if q.rounding != "float64":
            lines.append(f"rounding of {c.file} {q.name}: {q.floor:.0e} {q.unit} or {q.relative:.0e} of the value, {q.rounding}")
    for q in c.forms.values():
        verdict = "ok" if q.ok else "DEVIATES"
        lines.append(f"inputs {c.file} {q.name} ({q.values} numbers, checked only for their form): {verdict}")
    lines += [f"found by trial, {c.file} does not state it: {text}" for text in c.assumptions]
    lines += [f"REFUSED {c.file}: {c.refused}"] if c.refused else []
    lines += [f"not computable {c.file} {n.name} ({n.numbers} numbers): {n.why}" for n in c.not_computable]
    lines += [f"NOT USED {text}" for text in c.unread[:5]]
    lines += [f"NOT USED {len(c.unread) - 5} more of {c.file}"] if len(c.unread) > 5 else []
    return lines


def _vector_verdict(checked: list[Checks], missing: list[str]) -> str:
    """Return one line: how many files were usable, how many of their numbers were compared, and whether all agree."""
    from abbe.service.reference.vector_results import READERS

    bad = sum(1 for c in checked if c.error)
    computed = sum(q.values for c in checked for q in c.quantities.values())
    forms = sum(q.values for c in checked for q in c.forms.values())
    left = sum(n.numbers for c in checked for n in c.not_computable)
    parts = [f"{len(checked) - bad} of {len(READERS)} files", f"{computed} values compared", f"{forms} checked for their form only"]
    parts += [f"{left} not computable"] if left else []
    parts += [f"{bad} files UNUSABLE"] if bad else []
    parts += ["all hold" if all(c.ok for c in checked) else "NOT all hold"]
    return ", ".join(parts) + (", NOT complete" if missing or bad else "")
