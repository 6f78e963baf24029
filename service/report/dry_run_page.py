"""A dry run as a document: paths in three views, and the time and travel of each test."""

from __future__ import annotations

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.service.domain.artefact import ARTEFACT_TEST
from abbe.service.domain.machine import Point
from abbe.service.domain.run import BarSetup
from abbe.service.rendering.document import Document, PictureBlock, Section, TextTable
from abbe.service.rendering.numbers import MM, Unit
from abbe.service.rendering.plots.views import DrawnTest, three_views
from abbe.service.sequences.check import DryRun
from abbe.service.sequences.steps import CampaignPlan, MountBar, MoveTo, ReadBar, ReadLaser, RecordPath, TestPlan, TouchFeature

NAMES = {
    "ballbar_helix": "ball-bar helix",
    "ballbar_circle": "ball-bar circle",
    "laser_diagonal": "laser diagonal",
    "laser_linear": "laser line",
    ARTEFACT_TEST: "points of an artefact",
}


def dry_run_report(name: str, machine: Machine, plan: CampaignPlan, runs: tuple[DryRun, ...]) -> Document:
    """A checked plan: paths in three views with strokes, set-ups, bars and cups, and a row for each test."""
    seconds, readings = sum(r.duration_s for r in runs), sum(r.readings for r in runs)
    used = [f"{AXES[a]} {min(r.lowest_mm[a] for r in runs):.0f} to {max(r.highest_mm[a] for r in runs):.0f} mm" for a in range(3)]
    mounted = sum(t.mounts for t in plan.tests)
    lead = (
        f"{name}: {len(runs)} tests in {mounted} set-ups, {seconds / 60.0:.1f} min of machine time, {readings} readings.",
        f"Strokes used: {', '.join(used)}. Largest speed {max(r.fastest_mm_min for r in runs):.0f} mm/min.",
    )
    headings = ("No", "Test", "Set-up", "Kind", "s", "path mm", "X mm", "Y mm", "Z mm", "mm/min", "readings")
    rows = tuple(_row(k, test, run) for k, (test, run) in enumerate(zip(plan.tests, runs, strict=True), start=1))
    caption = (
        "Numbers: tests that begin a set-up, in the order of measuring. Rest the pointer on a dot to read what is set up there. "
        "Nothing has moved."
    )
    drawn = PictureBlock(caption, [picture(machine, plan)], "wide")
    note = "Machine time, without the time that a person needs for mounting."
    sections = (Section("Paths", [*lead, drawn]), Section("Tests in order", [TextTable(headings, rows), note]))
    return Document(kind="dry-run", title=f"Dry run: {plan.name}", sections=sections, signatures=())


def picture(machine: Machine, plan: CampaignPlan, unit: Unit = MM) -> str:
    """The paths of a plan in three views with strokes, set-ups, bars and cups, as SVG; ``unit``: unit of the axes."""
    return three_views(machine.stroke_mm, [_drawn(k, test) for k, test in enumerate(plan.tests, start=1)], unit=unit)


def _row(k: int, test: TestPlan, run: DryRun) -> tuple[str, ...]:
    extent = (f"{run.lowest_mm[a]:.0f} to {run.highest_mm[a]:.0f}" for a in range(3))
    numbers = (f"{run.duration_s:.0f}", f"{run.path_mm:.0f}", *extent, f"{run.fastest_mm_min:.0f}", str(run.readings))
    return (str(k), run.label, test.setup_id, NAMES.get(run.test, run.test), *numbers)


def _drawn(order: int, test: TestPlan) -> DrawnTest:
    path, setup = np.array(_read_places(test)), test.setup
    kind, radius = ("bar", setup.radius_mm) if isinstance(setup, BarSetup) else ("laser", 0.0)
    mounted = ", bar mounted here" if any(isinstance(s, MountBar) for s in test.steps) else ""
    text = f"{test.label}: {NAMES.get(test.test, test.test)}{mounted}"
    return DrawnTest(order, kind, text, path, setup.place_mm, radius, test.mounts)


def _read_places(test: TestPlan) -> list[Point]:
    """Positions of all readings, in order: those of recorded paths and of single readings."""
    out: list[Point] = []
    here: Point | None = None
    for step in test.steps:
        if isinstance(step, MoveTo):
            here = step.target_mm
        elif isinstance(step, RecordPath):
            out += step.points_mm
        elif isinstance(step, ReadLaser | ReadBar) and here is not None:
            out.append(here)
        elif isinstance(step, TouchFeature):
            out.append(step.centre_mm)
    return out
