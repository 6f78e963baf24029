"""`abbe vectors`: check independent vector files against the public functions."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli import BAD_INPUT, complain
from abbe.service.cli.common import JsonOption, print_json, print_table
from abbe.service.errors import FileFormatError

if TYPE_CHECKING:
    from abbe.service.vectors.checks import Checks


def vectors(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Folder with vector files (*.json).")],
    as_json: JsonOption = False,
) -> None:
    """Compute every number of the vector files from the files' own inputs and compare. Exit 1: one is off; 2: a file is unusable."""
    from abbe.service.vectors.run import READERS, examine, vector_files

    files = vector_files(folder)
    checked = []
    for path in files:
        if not as_json:
            typer.echo(f"{path.name} ...", err=True)
        checked.append(examine(path))
    missing = sorted(set(READERS) - {path.name for path in files})
    ok = all(c.ok for c in checked)
    complete = not missing and not any(c.error for c in checked)
    if as_json:
        docs = [c.doc() for c in checked]
        print_json({"format": "abbe-vectors/1", "ok": ok, "complete": complete, "files": docs, "missing": missing})
    else:
        _print(checked, missing, len(READERS))
    for c in checked:
        if c.error:
            complain(FileFormatError.code, c.error)
    if not ok:
        raise typer.Exit(BAD_INPUT if any(c.error for c in checked) else 1)


def _print(checked: list[Checks], missing: list[str], known: int) -> None:
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
        for line in _notes(c):
            typer.echo(line)
    for name in missing:
        typer.echo(f"not in this folder: {name}")
    typer.echo(_last(checked, missing, known))


def _notes(c: Checks) -> list[str]:
    lines: list[str] = []
    for q in (*c.quantities.values(), *c.forms.values()):
        lines += [f"DEVIATES {text}" for text in q.failures]
    for q in c.quantities.values():
        if q.rounding != "float64":
            lines.append(f"rounding of {c.file} {q.name}: {q.floor:.0e} {q.unit} or {q.relative:.0e} of the value, {q.rounding}")
    for q in c.forms.values():
        verdict = "ok" if q.ok else "DEVIATES"
        lines.append(f"form of inputs {c.file} {q.name} ({q.values} numbers, nothing computes them): {verdict}")
    lines += [f"found by trial, {c.file} does not state it: {text}" for text in c.assumptions]
    lines += [f"REFUSED {c.file}: {c.refused}"] if c.refused else []
    lines += [f"not computable {c.file} {n.name} ({n.numbers} numbers): {n.why}" for n in c.not_computable]
    lines += [f"NOT USED {text}" for text in c.unread[:5]]
    lines += [f"NOT USED {len(c.unread) - 5} more of {c.file}"] if len(c.unread) > 5 else []
    return lines


def _last(checked: list[Checks], missing: list[str], known: int) -> str:
    """Return the verdict: how much was there, how much of that was computed, and whether it holds."""
    bad = [c for c in checked if c.error]
    usable = len(checked) - len(bad)
    computed = sum(q.values for c in checked for q in c.quantities.values())
    forms = sum(q.values for c in checked for q in c.forms.values())
    left = sum(n.numbers for c in checked for n in c.not_computable)
    holds = "all hold" if all(c.ok for c in checked) else "NOT all hold"
    parts = [f"{usable} of {known} files", f"{computed} values compared", f"{forms} checked for their form only"]
    parts += [f"{left} not computable"] if left else []
    parts += [f"{len(bad)} files UNUSABLE"] if bad else []
    return ", ".join([*parts, holds]) + (", NOT complete" if missing or bad else "")
