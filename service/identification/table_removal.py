"""Subtract the effect of an active compensation table beyond smooth corrections from a campaign's readings.

The table is known exactly, from the controller or the database. Its moves of the axes suffer lost motion, and interpolation and rounding
add to them: both effects are subtracted. The machine's lost motion is solved first, preferably without step diagonals, in which the table
alone moves axes that are commanded to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables, smooth_of
from abbe.models.solvers.applied_tables import AppliedTables
from abbe.models.solvers.joint import solve_joint
from abbe.service.campaign_data.campaign_checks import check_files, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import with_changed_readings
from abbe.service.domain.run import BarSetup, Run
from abbe.service.domain.solution_file import LostMotion, TableRemoval
from abbe.service.errors import TableMismatch
from abbe.service.runs.observations import run_data
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import images_of
from abbe.service.tables.nine_tables import tables_from_image

NOTHING = AppliedTables(np.zeros_like)
NOT_REMOVED = "the effect of tables beyond smooth corrections, above all with lost motion, is still in the readings"


@dataclass(frozen=True)
class RemovedTable:
    """A table whose effect is subtracted. ``force``: its whole effect, with lost motion; ``stays``: the part that stays in the readings."""

    force: AppliedTables
    stays: AppliedTables


@dataclass(frozen=True)
class CampaignTable:
    """The table that a campaign was measured with; None if none acted, or if it cannot be removed (``why``)."""

    table: NineTables | None = None
    why: str = ""


NO_TABLE = CampaignTable()


def campaign_table(store: Store | None, campaign: Campaign) -> CampaignTable:
    """Return the table with which all identify runs of a campaign were measured, from its folder, else from the database."""
    stated = [r.table for r in campaign.runs if r.identifies]
    acted = [one for one in stated if one.acting_crc is not None]
    crc = acted[0].acting_crc if acted else None
    if crc is None:
        return NO_TABLE
    if len(acted) < len(stated) or any(one.crc != crc for one in acted):
        return CampaignTable(None, f"the runs were measured with different compensation tables: {NOT_REMOVED}")
    image = campaign.tables.get(crc)
    if image is None and store is not None:
        image = images_of(store)(crc)
    if image is None:
        where = " or ".join(["this folder"] * (campaign.folder is not None) + ["this database"] * (store is not None))
        sure = any(one.acting for one in acted)  # runs of older versions do not state whether a table acted
        return CampaignTable(None, f"measured with table {crc:08X}, which is not in {where}: {NOT_REMOVED}" if sure else "")
    try:
        return CampaignTable(tables_from_image(image))
    except TableMismatch:
        return CampaignTable(None, f"measured with table {crc:08X}, of a kind that cannot be read: {NOT_REMOVED}")


def remove_table(campaign: Campaign, table: NineTables | None) -> Campaign:
    """Return the campaign as if every axis had followed smooth corrections by ``table``, which was active during the measurement.

    ``removed`` of the result then names the table and the assumed lost motion with its uncertainty. Runs with another table than the
    identify runs, or without one, stay unchanged. Without a ``table`` the campaign stays unchanged.

    Raises
    ------
    CampaignRefused
        The data of a run contradict its description.
    """
    used = [r for r in campaign.runs if r.identifies]
    if table is None or not used:
        return campaign
    refuse(check_files(campaign.site.doc, used))  # refuse an inconsistent run here with one line instead of failing in the solver
    lost = _lost_motion(campaign.site, used, table)
    crc = used[0].table.crc
    removed = TableRemoval(crc=crc, lost_motion_mm={axis: LostMotion(value=v, u=u) for axis, (v, u) in lost.items()})
    out = removed_table(table, np.array([v for v, _ in lost.values()]))
    runs = [_subtracted(run, out) if _had_table(run, crc) else run for run in campaign.runs]
    return replace(campaign, runs=runs, removed=removed)


def _had_table(run: Run, crc: int | None) -> bool:
    return run.table.crc == crc and run.table.acting is not False


def table_line(removed: TableRemoval) -> str:
    """Return one line about the removed table."""
    lost = ", ".join(f"{axis} {one.value * 1e3:.1f} µm (u {one.u * 1e3:.1f})" for axis, one in removed.lost_motion_mm.items())
    which = "" if removed.crc is None else f" {removed.crc:08X}"
    return f"table{which} was in force: its effect beyond smooth corrections is subtracted from the readings, with lost motion {lost}"


def removed_table(table: NineTables, lost_mm: F1) -> RemovedTable:
    """Return the amounts to subtract from readings measured with ``table`` on a machine with this lost motion of X, Y, Z, mm.

    A table that polynomials do not fit, made by hand or for pitch errors, may correct errors outside the models. Then only the effect of
    lost motion on its moves is subtracted.
    """
    return RemovedTable(AppliedTables(table.correction_at, lost_mm), AppliedTables(smooth_of(table) or table.correction_at))


def subtract_table(runs: list[Run], out: RemovedTable) -> list[Run]:
    """Subtract a table's effect from runs; one of an artefact or without readings stays unchanged."""
    return [_subtracted(run, out) for run in runs]


def _lost_motion(site: Site, used: list[Run], table: NineTables) -> dict[str, tuple[float, float]]:
    """Solve lost motion and its u by axis, mm, after subtracting the whole table, whose interpolation would look like reversals."""
    plain = [r for r in used if r.is_bar or r.is_artefact or not r.laser.order]
    runs = subtract_table(plain or used, RemovedTable(AppliedTables(table.correction_at), NOTHING))
    return solve_joint(site.machine, tuple(run_data(r) for r in runs)).backlash_mm()


def _subtracted(run: Run, out: RemovedTable) -> Run:
    if run.is_sealed or run.is_artefact:
        return run
    axes, reading = run.columns.q_mm, run.columns.readings_mm.copy()
    known = np.isfinite(axes).all(axis=1)
    reading[known] -= _added_mm(run, axes[known], out.force) - _added_mm(run, axes[known], out.stays)
    return with_changed_readings(run, reading, "table" if run.table.crc is None else f"table {run.table.crc:08X}")


def _added_mm(run: Run, axes_mm: F2, force: AppliedTables) -> F1:
    return force.bar_mm(axes_mm, run.setup.centre_mm) if isinstance(run.setup, BarSetup) else force.laser_mm(axes_mm, run.beam)
