"""Subtract the effect of an active table beyond its smooth corrections from a campaign's readings; the remaining machine errors stay.

The table was read from the controller or is in the database, so its moves are known exactly. Subtracted are the effect of the lost motion
on these moves, and what interpolation and rounding added to them. The machine's lost motion is solved first, from the runs in which axes
reverse by command and not while they are commanded to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.tables import NineTables, smooth_of
from abbe.models.solvers.in_force import AppliedTables
from abbe.models.solvers.joint import solve_joint
from abbe.service.campaign_data.campaign_checks import check_files, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import with_changed_columns
from abbe.service.domain.solution_file import LostMotion, TableTakenOut
from abbe.service.errors import TableMismatch
from abbe.service.runs.observations import beam_of, run_data
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import images_of
from abbe.service.tables.nine_tables import tables_from_image

Runs = list[dict[str, Any]]
NOTHING = AppliedTables(np.zeros_like)
NOT_REMOVED = "what it did beyond smooth corrections, with the lost motion above all, is still in the readings"


@dataclass(frozen=True)
class RemovedTable:
    """``force``: the applied tables, lost motion included; ``stays``: the part that stays in the readings."""

    force: AppliedTables
    stays: AppliedTables


@dataclass(frozen=True)
class CampaignTable:
    """The table that a campaign was measured with; None if none acted, or if it cannot be removed (``why``)."""

    table: NineTables | None = None
    why: str = ""


NO_TABLE = CampaignTable()


def campaign_table(store: Store, campaign: Campaign) -> CampaignTable:
    """The table of this database with which all identify runs of a campaign were measured."""
    documents = [r.get("table") or {} for r in campaign.runs if r["role"] == "identify"]
    acted = [one for one in documents if one.get("crc") is not None and one.get("acting") is not False]
    if not acted:
        return NO_TABLE
    crc = int(acted[0]["crc"])
    if len(acted) < len(documents) or any(int(one["crc"]) != crc for one in acted):
        return CampaignTable(None, f"these runs were not all measured with one table: {NOT_REMOVED}")
    image = images_of(store)(crc)
    if image is None:
        sure = any(one.get("acting") for one in acted)  # runs of older versions do not state whether a table acted
        return CampaignTable(None, f"measured with table {crc:08X}, which this database does not know: {NOT_REMOVED}" if sure else "")
    try:
        return CampaignTable(tables_from_image(image))
    except TableMismatch:
        return CampaignTable(None, f"measured with table {crc:08X}, of a kind that cannot be read: {NOT_REMOVED}")


def remove_table(campaign: Campaign, table: NineTables | None) -> Campaign:
    """The campaign as if every axis had followed smooth corrections by ``table``, which was active during the measurement.

    ``removed`` of the result then names the table and the assumed lost motion with its uncertainty. Runs with another table than the
    identify runs, or without one, stay unchanged. Without a ``table`` the campaign stays unchanged.

    Raises
    ------
    CampaignRefused
        The data of a run contradict its description.
    """
    used = [r for r in campaign.runs if r["role"] == "identify"]
    if table is None or not used:
        return campaign
    refuse(check_files(campaign.site.doc, used))  # refuse an inconsistent run here with one line instead of failing in the solver
    lost = _lost_motion(campaign.site, used, table)
    crc = (used[0].get("table") or {}).get("crc")
    removed = TableTakenOut(crc=crc, lost_motion_mm={axis: LostMotion(value=v, u=u) for axis, (v, u) in lost.items()})
    out = removed_table(table, np.array([v for v, _ in lost.values()]))
    runs = [_subtracted(run, out) if _had_table(run, crc) else run for run in campaign.runs]
    return replace(campaign, runs=runs, removed=removed)


def _had_table(run: dict[str, Any], crc: int | None) -> bool:
    table = run.get("table") or {}
    return table.get("crc") == crc and table.get("acting") is not False


def table_line(removed: TableTakenOut) -> str:
    """One line about the removed table."""
    lost = ", ".join(f"{axis} {one.value * 1e3:.1f} µm (u {one.u * 1e3:.1f})" for axis, one in removed.lost_motion_mm.items())
    which = "" if removed.crc is None else f" {removed.crc:08X}"
    return f"table{which} was in force: what it did beyond smooth corrections is taken out of the readings, with lost motion {lost}"


def removed_table(table: NineTables, lost_mm: F1) -> RemovedTable:
    """What to subtract from readings that were measured with ``table`` by a machine with this lost motion of X, Y, Z, mm.

    A table that polynomials do not fit, made by hand or of pitch errors, may correct errors outside these models: then only the effect of
    the lost motion on its moves is subtracted.
    """
    return RemovedTable(AppliedTables(table.correction_at, lost_mm), AppliedTables(smooth_of(table) or table.correction_at))


def subtract_table(runs: Runs, out: RemovedTable) -> Runs:
    """Runs after subtracting a table's effect; a run without readings stays unchanged."""
    return [_subtracted(run, out) for run in runs]


def _lost_motion(site: Site, used: Runs, table: NineTables) -> dict[str, tuple[float, float]]:
    """Lost motion and its u by axis, mm, from runs without the whole effect of the table, whose interpolation would look like reversals."""
    runs = subtract_table(
        [r for r in used if not r["setup"].get("order")] or used, RemovedTable(AppliedTables(table.correction_at), NOTHING)
    )
    return solve_joint(site.machine, tuple(run_data(r) for r in runs)).backlash_mm()


def _subtracted(run: dict[str, Any], out: RemovedTable) -> dict[str, Any]:
    if run["columns"]["deviation_mm"] is None:
        return run
    axes = np.column_stack([np.asarray(run["columns"][f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    reading = np.array(run["columns"]["deviation_mm"], dtype=np.float64)
    known = np.isfinite(axes).all(axis=1)
    reading[known] -= _added_mm(run, axes[known], out.force) - _added_mm(run, axes[known], out.stays)
    crc = (run.get("table") or {}).get("crc")
    return with_changed_columns(run, run["columns"] | {"deviation_mm": reading.tolist()}, "table" if crc is None else f"table {crc:08X}")


def _added_mm(run: dict[str, Any], axes_mm: F2, force: AppliedTables) -> F1:
    setup = run["setup"]
    if run["test"].startswith("laser"):
        return force.laser_mm(axes_mm, beam_of(setup, run["run_id"]))
    return force.bar_mm(axes_mm, np.asarray(setup["centre_mm"], dtype=np.float64))
