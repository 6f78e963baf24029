"""Difference of two sets of tables: nine curves on one grid, the largest change with its place, and a report."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.compensation.tables import NineTables
from abbe.models.machine import AXES
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.errors import TableRefused
from abbe.service.rendering.document import Document, PictureBlock, Section, TextTable
from abbe.service.rendering.plots.tables import CurveChange, change_plot
from abbe.service.storage.store import Store

ACTIVE = "ACTIVE"
HEADINGS = ("table", "old max (µm)", "new max (µm)", "largest change (µm)", "U (µm)", "at (mm)", "rms change (µm)")


@dataclass(frozen=True, slots=True)
class TableDifference:
    """The names of the two sets and their nine curves."""

    new: str
    old: str
    curves: tuple[CurveChange, ...]


def compare(store: Store, number: int, with_what: str) -> TableDifference:
    """Compare a proposal with the table that it was made on (``ACTIVE``), or with another proposal (its number).

    Raises
    ------
    TableRefused
        There is no such table or proposal, or it belongs to another machine.
    """
    proposed = load(store, number)
    if with_what.upper() == ACTIVE:
        name = f"the table in force when the proposal was made ({proposed.candidate.base_crc:08X})"
        return TableDifference(f"proposal {number}", name, changes(proposed.base_tables, proposed.tables))
    if not with_what.isdigit():
        raise TableRefused(f"--with {with_what!r} is neither ACTIVE nor the number of a proposal", "abbe comp show lists them")
    other = load(store, int(with_what))
    if other.candidate.machine != proposed.candidate.machine:
        raise TableRefused(
            f"proposal {number} cannot be compared with proposal {with_what}, which is for machine {other.candidate.machine!r}",
            f"compare proposals of {proposed.candidate.machine!r}",
        )
    return TableDifference(f"proposal {number}", f"proposal {with_what}", changes(other.tables, proposed.tables))


def changes(old: NineTables | None, new: NineTables) -> tuple[CurveChange, ...]:
    """Compare nine new tables with nine old ones on the grid of the new ones; ``old`` None: no correction was in force."""
    found = []
    for a, moved in enumerate(AXES):
        grid = new.position_mm[a]
        for i, corrected in enumerate(AXES):
            before = np.zeros(grid.size)
            if old is not None:
                before = np.interp(grid, old.position_mm[a], old.correction_mm[a][:, i])
            found.append(CurveChange(moved, corrected, grid, before, new.correction_mm[a][:, i], new.u_mm[a][:, i]))
    return tuple(found)


def rows(found: TableDifference) -> list[tuple[str, ...]]:
    """Return one row of text per table, µm, with the expanded uncertainty U (k = 2)."""
    out: list[tuple[str, ...]] = []
    for c in found.curves:
        k, change = c.worst, c.change_mm
        values = (_um(np.abs(c.old_mm).max()), _um(np.abs(c.new_mm).max()), f"{change[k] * 1e3:+.2f}", _um(2.0 * c.u_mm[k]))
        rms = float(np.sqrt(np.mean(change**2)))
        out.append((f"{c.corrected} over {c.moved}", *values, f"{c.position_mm[k]:g}", _um(rms)))
    return out


def largest(found: TableDifference) -> str:
    """Return a sentence on the largest change in all nine tables."""
    c = max(found.curves, key=lambda one: abs(one.change_mm[one.worst]))
    k = c.worst
    size, expanded = c.change_mm[k] * 1e3, 2e3 * c.u_mm[k]
    place = f"in the table of {c.corrected} over {c.moved} at {c.position_mm[k]:g} mm"
    return f"largest change: {size:+.2f} µm (U = {expanded:.2f} µm, k = 2) {place}"


def diff_report(found: TableDifference, proposed: Proposed) -> Document:
    """Report of the changes of a proposal: numbers and curves."""
    p = proposed.predicted
    lead = (
        f"{proposed.candidate.machine}: {found.new}, made from campaign {proposed.campaign} by {proposed.by} at {proposed.utc}.",
        f"Compared with {found.old}.",
        f"The model promises {p.before_mm * 1e3:.1f} → {p.after_mm * 1e3:.1f} µm rms over the volume "
        f"(U = {2e3 * p.u_model_mm:.1f} µm, k = 2). The {largest(found)}.",
        *(f"Against it: {reason}" for reason in proposed.reasons),
    )
    title = f"{found.new} against {found.old.split(' (')[0]}"
    caption = (
        "Corrections are added to the command. Band: expanded uncertainty (k = 2) of each new entry relative to the first of its table."
    )
    sections = (
        Section("What changes", [*lead, PictureBlock(caption, [change_plot(found.curves)], "wide")]),
        Section("The nine tables", [TextTable(HEADINGS, rows(found))]),
    )
    return Document(kind="table-change", title=title, sections=sections, signatures=())


def _um(mm: float) -> str:
    return f"{mm * 1e3:.2f}"
