"""What a table in force did to a campaign's readings beyond its smooth corrections is taken out of them; what the table has left stays.

The table is read from the controller, or known to the database, so its moves are known exactly. Taken out is what the lost motion made of
them, and what interpolation and rounding added to them. The machine's lost motion is solved first, from the runs in which axes turn round
by command and not while they are told to rest.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.smooth import smooth_of
from abbe.models.compensation.tables import NineTables
from abbe.models.solvers.in_force import AppliedTables
from abbe.models.solvers.joint import solve_joint
from abbe.service.campaign_data.campaign_checks import check_files, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import changed
from abbe.service.domain.solution_file import LostMotion, TableTakenOut
from abbe.service.errors import TableMismatch
from abbe.service.runs.observations import beam_of, run_data
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import images_of
from abbe.service.tables.nine_tables import tables_from_image

Runs = list[dict[str, Any]]
NOTHING = AppliedTables(np.zeros_like)
STAYS = "what it did beyond smooth corrections, with the lost motion above all, is still in the readings"


@dataclass(frozen=True)
class RemovedTable:
    """``force``: what was in force, lost motion included; ``stays``: what of it stays in the readings."""

    force: AppliedTables
    stays: AppliedTables


@dataclass(frozen=True)
class TableThen:
    """The table that a campaign was measured with. None: none acted; or nothing can be taken out, and ``why`` says so."""

    table: NineTables | None = None
    why: str = ""


NO_TABLE = TableThen()


def table_then(store: Store, campaign: Campaign) -> TableThen:
    """The table that all runs of a campaign that identify were measured with, as this database knows it."""
    told = [r.get("table") or {} for r in campaign.runs if r["role"] == "identify"]
    acted = [one for one in told if one.get("crc") is not None and one.get("acting") is not False]
    if not acted:
        return NO_TABLE
    crc = int(acted[0]["crc"])
    if len(acted) < len(told) or any(int(one["crc"]) != crc for one in acted):
        return TableThen(None, f"these runs were not all measured with one table: {STAYS}")
    image = images_of(store)(crc)
    if image is None:
        sure = any(one.get("acting") for one in acted)  # runs of older versions do not say whether there was anything to act
        return TableThen(None, f"measured with table {crc:08X}, which this database does not know: {STAYS}" if sure else "")
    try:
        return TableThen(tables_from_image(image))
    except TableMismatch:
        return TableThen(None, f"measured with table {crc:08X}, of a kind that cannot be read: {STAYS}")


def as_left(campaign: Campaign, table: NineTables | None) -> Campaign:
    """The campaign as if every axis had followed smooth corrections by ``table``, in force while it was measured; None for none.

    Its ``removed`` says then which table that was and how well the lost motion is known that was assumed. Runs that
    were measured with another table than those that identify, or with none, stay as they are.

    Raises
    ------
    CampaignRefused
        A run cannot be what it says.
    """
    used = [r for r in campaign.runs if r["role"] == "identify"]
    if table is None or not used:
        return campaign
    refuse(check_files(campaign.site.doc, used))  # a run that cannot be what it says is one line, and no trouble of a solver
    lost = _lost(campaign.site, used, table)
    crc = (used[0].get("table") or {}).get("crc")
    removed = TableTakenOut(crc=crc, lost_motion_mm={axis: LostMotion(value=v, u=u) for axis, (v, u) in lost.items()})
    out = taken(table, np.array([v for v, _ in lost.values()]))
    runs = [_less(run, out) if _with(run, crc) else run for run in campaign.runs]
    return replace(campaign, runs=runs, removed=removed)


def _with(run: dict[str, Any], crc: int | None) -> bool:
    told = run.get("table") or {}
    return told.get("crc") == crc and told.get("acting") is not False


def table_line(removed: TableTakenOut) -> str:
    """What was taken out, for people."""
    lost = ", ".join(f"{axis} {one.value * 1e3:.1f} µm (u {one.u * 1e3:.1f})" for axis, one in removed.lost_motion_mm.items())
    which = "" if removed.crc is None else f" {removed.crc:08X}"
    return f"table{which} was in force: what it did beyond smooth corrections is taken out of the readings, with lost motion {lost}"


def taken(table: NineTables, lost_mm: F1) -> RemovedTable:
    """What is taken out of readings that were measured with ``table`` by a machine with this lost motion of X, Y, Z.

    A table that no polynomials meet, made by hand or of pitch errors, may correct what no solver here finds: only what the lost motion made
    of its moves is taken out.
    """
    return RemovedTable(AppliedTables(table.correction_at, lost_mm), AppliedTables(smooth_of(table) or table.correction_at))


def less(runs: Runs, out: RemovedTable) -> Runs:
    """Runs without what is taken out; a run without readings stays as it is."""
    return [_less(run, out) for run in runs]


def _lost(site: Site, used: Runs, table: NineTables) -> dict[str, tuple[float, float]]:
    """Lost motion from runs less all that the table did: what interpolation adds would pass for turns."""
    runs = less([r for r in used if not r["setup"].get("order")] or used, RemovedTable(AppliedTables(table.correction_at), NOTHING))
    return solve_joint(site.machine, tuple(run_data(r) for r in runs)).backlash_mm()


def _less(run: dict[str, Any], out: RemovedTable) -> dict[str, Any]:
    if run["columns"]["deviation_mm"] is None:
        return run
    axes = np.column_stack([np.asarray(run["columns"][f"{c}_mm"], dtype=np.float64) for c in "xyz"])
    reading = np.array(run["columns"]["deviation_mm"], dtype=np.float64)
    there = np.isfinite(axes).all(axis=1)
    reading[there] -= _added_mm(run, axes[there], out.force) - _added_mm(run, axes[there], out.stays)
    crc = (run.get("table") or {}).get("crc")
    return changed(run, run["columns"] | {"deviation_mm": reading.tolist()}, "table" if crc is None else f"table {crc:08X}")


def _added_mm(run: dict[str, Any], axes_mm: F2, force: AppliedTables) -> F1:
    setup = run["setup"]
    if run["test"].startswith("laser"):
        return force.laser_mm(axes_mm, beam_of(setup, run["run_id"]))
    return force.bar_mm(axes_mm, np.asarray(setup["centre_mm"], dtype=np.float64))
