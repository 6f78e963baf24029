"""The rehearsal of a measurement: the dry run as a table, all positions or a picture, and the NC program. Nothing moves."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from abbe.service.cli.common import answer, print_json, print_table

if TYPE_CHECKING:
    from abbe.service.sequences.check import DryRun
    from abbe.service.sequences.steps import CampaignPlan
    from abbe.service.site import Site

HAIR = 1e-6
"""Tolerance, mm: a position this close to a whole number counts as whole."""


@dataclass(frozen=True, slots=True)
class Rehearsal:
    """Replacement of a measurement: a dry run, optionally with all positions or a picture, or an NC program in the dialect ``nc``."""

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
            Two options do not go together, or an output file would overwrite an input.
        """
        from abbe.service.errors import ConfigError
        from abbe.service.rendering.document_page import form_of

        if self.picture is not None and not self.dry_run:
            raise ConfigError("--picture draws a dry run", "add --dry-run")
        if self.picture is not None:
            form_of(self.picture)
        if self.path and not self.dry_run:
            raise ConfigError("--path prints the positions of a dry run", "add --dry-run")
        if self.nc and self.out is None:
            raise ConfigError("--nc DIALECT and --out FILE go together", "give both")
        if self.nc and self.dry_run:
            raise ConfigError("--nc and --dry-run do not go together", "give one of them")
        for target in (self.picture, self.out):
            if target is not None and any(target.resolve() == s.resolve() for s in sources):
                raise ConfigError(f"{target} would be overwritten", "give another file name")
        return self.dry_run or bool(self.nc)

    def run(self, site: Site, plan: CampaignPlan, runs: tuple[DryRun, ...], *, as_json: bool) -> None:
        """Print or draw the dry run, or write the NC program."""
        from abbe.service.rendering.document_page import write_document
        from abbe.service.rendering.page_file import write_page
        from abbe.service.report.dry_run_page import dry_run_report
        from abbe.service.sequences.nc.write import nc_program

        if self.nc and self.out is not None:
            made = nc_program(site.name, site.machine, plan, self.nc, site.nc)
            write_page(made.text, self.out)
            if made.warning:
                typer.echo(f"warning: {made.warning}", err=True)
            doc = {"program": str(self.out), "dialect": self.nc, "size": made.size, "warning": made.warning}
            answer(doc, f"NC program: {self.out} ({self.nc}), {made.size}; read it before you run it", as_json=as_json)
            return
        if self.picture is not None:
            write_document(dry_run_report(site.name, site.machine, plan, runs), self.picture)
        if as_json:
            print_json(dry_run_doc(plan, runs, every=self.path))
            return
        print_path(plan) if self.path else print_dry_run(plan.name, runs)
        if self.picture is not None:
            typer.echo(f"picture: {self.picture}")


def dry_run_doc(plan: CampaignPlan, runs: tuple[DryRun, ...], *, every: bool) -> dict[str, Any]:
    """Return the dry run for programs: one object per test; ``every``: with each commanded position, mm."""
    from abbe.service.domain.document import document
    from abbe.service.sequences.check import positions

    tests = [document(run) for run in runs]
    if every:
        for doc, test in zip(tests, plan.tests, strict=True):
            doc["positions_mm"] = [list(map(float, at)) for at in positions(test.steps)]
    return {"campaign": plan.name, "duration_s": sum(run.duration_s for run in runs), "tests": tests}


def print_path(plan: CampaignPlan) -> None:
    """Print every commanded position of the plan, one CSV line each: test, X, Y, Z in mm."""
    from abbe.service.sequences.check import positions

    typer.echo("test,x_mm,y_mm,z_mm")
    for test in plan.tests:
        for x, y, z in positions(test.steps):
            typer.echo(f"{test.label},{x:.5f},{y:.5f},{z:.5f}")


HEADINGS = ("test", "kind", "s", "mm", "X", "Y", "Z", "mm/min", "points")


def print_dry_run(name: str, runs: tuple[DryRun, ...]) -> None:
    """Print one line per test: time, path, extent, largest speed, readings."""
    rows = [
        (r.label, r.test, f"{r.duration_s:.0f}", f"{r.path_mm:.0f}", *_extent(r), f"{r.fastest_mm_min:.0f}", str(r.readings)) for r in runs
    ]
    typer.echo(f"{name}: {sum(r.duration_s for r in runs) / 60:.1f} min of machine time, mounting not counted; X, Y, Z in mm")
    print_table(HEADINGS, rows)


def _extent(run: DryRun) -> tuple[str, ...]:
    """Return lowest and highest position of each axis, rounded outwards to whole mm."""
    return tuple(f"{math.floor(lo + HAIR)}..{math.ceil(hi - HAIR)}" for lo, hi in zip(run.lowest_mm, run.highest_mm, strict=True))
