"""`abbe errors`: actual positions of the tool, from known error functions."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from abbe.service.cli.common import JsonOption, print_table

if TYPE_CHECKING:
    from abbe.service.verification.deviations import Deviations

ROWS = 20


def errors(
    machine: Annotated[Path, typer.Option("--machine", metavar="FILE", help="Machine file (TOML), or a machine object (TOML or JSON).")],
    errors_file: Annotated[Path, typer.Option("--errors", metavar="FILE", help="Error functions (abbe-errors/1).")],
    points: Annotated[Path, typer.Option("--points", metavar="FILE", help="CSV: x_mm,y_mm,z_mm; optional direction_x.., tool_x_mm..")],
    exact: Annotated[bool, typer.Option("--exact", help="Finite rotations instead of first order.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Deviation of the tool at points, for a machine whose error functions are known. Points outside the strokes are refused."""
    from abbe.service.verification.deviations import deviations, deviations_json

    found = deviations(machine, errors_file, points, exact=exact)
    if as_json:
        for piece in deviations_json(found):  # one line: indenting a hundred thousand points takes seconds
            sys.stdout.write(piece)
        sys.stdout.write("\n")
    else:
        _print(found)


def _print(found: Deviations) -> None:
    from abbe.service.verification.deviations import MEANING

    count, norm, u = len(found.points.lines), found.norm_mm, found.u_mm
    headings = ["x", "y", "z", "dX", "dY", "dZ", "norm"]
    if u is not None:
        headings += [f"U({name})" for name in headings[3:]]
    rows = []
    for k in range(min(count, ROWS)):
        cells = [f"{value:g}" for value in found.points.axes_mm[k]]
        cells += [f"{value * 1e3:.4f}" for value in (*found.deviation_mm[k], norm[k])]
        rows.append(cells + ([] if u is None else [f"{2e3 * value:.4f}" for value in u[k]]))
    expanded = "" if u is None else ", U = expanded uncertainty (k = 2)"
    print_table(headings, rows, title=f"{found.machine}: deviation in µm at positions in mm, {found.model}{expanded}")
    if count > ROWS:
        typer.echo(f"{count - ROWS} more points; --json lists all")
    worst = int(norm.argmax())
    at = ", ".join(f"{value:g}" for value in found.points.axes_mm[worst])
    spread = "" if u is None else f" (U = {2e3 * u[worst, 3]:.4f} µm)"
    typer.echo(f"{count} points, largest deviation {norm[worst] * 1e3:.4f} µm{spread} at ({at})")
    typer.echo(MEANING)
    typer.echo(found.uncertainty)
    for text in found.warnings:
        typer.echo(f"warning: {text}")
