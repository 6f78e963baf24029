"""`abbe measure` without a machine: print the dry run, draw it, or write an NC program."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from abbe.service.sequences.check import DryRun
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import Site


HAIR = 1e-6
"""Tolerance, mm: a position this close to a whole number counts as whole."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """The request: a dry run (with every position, with a picture), or an NC program in a dialect."""

    dry_run: bool
    path: bool
    picture: Path | None
    nc: str
    out: Path | None

    def check(self, sources: tuple[Path, ...]) -> bool:
        """Return whether anything is requested instead of a measurement.

        Raises
        ------
        ConfigError
            Options that do not go together, or an output file that would overwrite an input.
        """
        from abbe.service.errors import ConfigError
        from abbe.service.rendering.document_page import form_of

        if self.picture is not None and not self.dry_run:
            raise ConfigError("--picture draws a dry run", "add --dry-run")
        if self.picture is not None:
            form_of(self.picture)
        if self.path and not self.dry_run:
            raise ConfigError("--path prints the positions of a dry run", "add --dry-run")
        if bool(self.nc) != (self.out is not None):
            raise ConfigError("--nc DIALECT and --out FILE go together", "give both")
        if self.nc and self.dry_run:
            raise ConfigError("--nc and --dry-run do not go together", "give one of them")
        for target in (self.picture, self.out):
            if target is not None and any(target.resolve() == s.resolve() for s in sources):
                raise ConfigError(f"{target} would be overwritten", "give another file name")
        return self.dry_run or bool(self.nc)

    def run(self, site: Site, plan: CampaignPlan, runs: tuple[DryRun, ...]) -> None:
        """Print or draw the dry run, or write the NC program."""
        from abbe.service.rendering.document_page import write_document
        from abbe.service.rendering.page_file import write_page
        from abbe.service.report.dry_run_page import dry_run_report
        from abbe.service.sequences.nc.write import nc_program

        if self.nc and self.out is not None:
            made = nc_program(site.name, site.machine, plan, self.nc, site.nc)
            write_page(made.text, self.out)
            typer.echo(f"NC program: {self.out} ({self.nc}), {made.size}; read it before it runs")
            if made.warning:
                typer.echo(f"warning: {made.warning}", err=True)
            return
        print_path(plan) if self.path else print_dry_run(plan.name, runs)
        if self.picture is not None:
            write_document(dry_run_report(site.name, site.machine, plan, runs), self.picture)
            typer.echo(f"picture: {self.picture}")


def print_path(plan: CampaignPlan) -> None:
    """Print every commanded position of the plan, one CSV line each: test, X, Y, Z in mm."""
    from abbe.service.sequences.check import positions

    typer.echo("test,x_mm,y_mm,z_mm")
    for test in plan.tests:
        for x, y, z in positions(test.steps):
            typer.echo(f"{test.label},{x:.5f},{y:.5f},{z:.5f}")


HEADINGS = ("test", "kind", "s", "mm", "X", "Y", "Z", "mm/min", "points")
NAMES = 2
"""Number of leading columns that hold names, which wrap; the others hold numbers, which stay whole at any width."""
NARROWEST = 8


def print_dry_run(name: str, runs: tuple[DryRun, ...]) -> None:
    """Print one line a test: time, path, extent, largest speed, readings."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    rows = [
        (r.label, r.test, f"{r.duration_s:.0f}", f"{r.path_mm:.0f}", *_extent(r), f"{r.fastest_mm_min:.0f}", str(r.readings)) for r in runs
    ]
    widths = [max(map(len, column)) for column in zip(HEADINGS, *rows, strict=True)]
    gap = 2
    least = sum(widths[NAMES:]) + NAMES * NARROWEST + gap * len(HEADINGS)
    wide = Console().width if sys.stdout.isatty() else sum(widths) + gap * len(HEADINGS)
    table = Table(box=None, padding=(0, gap, 0, 0), pad_edge=False)
    for k, (heading, width) in enumerate(zip(HEADINGS, widths, strict=True)):
        if k < NAMES:
            table.add_column(heading, overflow="fold", min_width=min(NARROWEST, width))
        else:
            table.add_column(heading, justify="right", no_wrap=True, min_width=width)
    for row in rows:
        table.add_row(*map(Text, row))
    typer.echo(f"{name}: {sum(r.duration_s for r in runs) / 60:.1f} min of machine time, mounting not counted; X, Y, Z in mm")
    Console(highlight=False, width=max(wide, least)).print(table)


def _extent(run: DryRun) -> tuple[str, ...]:
    """Return lowest and highest position of each axis, rounded outwards to whole mm."""
    return tuple(f"{math.floor(lo + HAIR)}..{math.ceil(hi - HAIR)}" for lo, hi in zip(run.lowest_mm, run.highest_mm, strict=True))
