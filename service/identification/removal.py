"""Subtract from a campaign's readings what a new table must not correct: side effects of the table in force, effects with another remedy.

Everything that a table in force does beyond smooth corrections is subtracted. The table is known exactly, from the controller or the
database. Lost motion, interpolation and rounding change the moves that the table commands: these effects are subtracted. The
machine's lost motion is solved first, preferably without step diagonals, in which the table alone moves axes that are commanded to rest.
A table that is not available widens the covariance instead (`with_unknown_table`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.compensation.nine_tables import table_design
from abbe.models.compensation.tables import NineTables, grid_positions, smooth_of
from abbe.models.effects.effect import Effect
from abbe.models.geometry.bases import smooth_terms
from abbe.models.solvers.applied_tables import AppliedTables
from abbe.models.solvers.joint import JointSolution, solve_joint, widened
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors, term_prior_sd
from abbe.models.uncertainty.sources import response
from abbe.service.campaign_data.campaign_checks import check_files, refuse
from abbe.service.campaign_data.campaign_folder import Campaign
from abbe.service.campaign_data.provenance import machine_digest, with_changed_readings
from abbe.service.domain.finding import EffectSize
from abbe.service.domain.run import BarSetup, Run
from abbe.service.domain.solution_file import LostMotion, TableRemoval
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.effect_sums import readings_of
from abbe.service.effects.model_book import applies, current, no_table_lines
from abbe.service.errors import TableMismatch
from abbe.service.runs.cases import case_of
from abbe.service.runs.observations import run_data
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.measured_with import images_of
from abbe.service.tables.nine_tables import tables_from_image

NOTHING = AppliedTables(np.zeros_like)
NOT_REMOVED = "the side effects of tables (beyond smooth corrections, mostly from lost motion) are still in the readings"


@dataclass(frozen=True)
class RemovedTable:
    """A table whose effect is subtracted. ``force``: its whole effect, with lost motion; ``stays``: the part that stays in the readings."""

    force: AppliedTables
    stays: AppliedTables


@dataclass(frozen=True)
class CampaignTable:
    """The table that acted while a campaign was measured; None if no table acted, or if it cannot be removed (``why``)."""

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
    identify runs, or without a table, stay unchanged. Without a ``table`` the campaign stays unchanged.

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
    return (
        f"table{which} was in force: its side effects (beyond smooth corrections) are subtracted from the readings, for lost motion {lost}"
    )


def removed_table(table: NineTables, lost_mm: F1) -> RemovedTable:
    """Return the amounts to subtract from readings measured with ``table`` on a machine with this lost motion of X, Y, Z, mm.

    A table that polynomials do not fit, made by hand or for pitch errors, may correct errors outside the models. Then only the effect of
    lost motion on its moves is subtracted.
    """
    return RemovedTable(AppliedTables(table.correction_at, lost_mm), AppliedTables(smooth_of(table) or table.correction_at))


def subtract_table(runs: list[Run], out: RemovedTable) -> list[Run]:
    """Subtract a table's effect from runs; runs of artefacts and runs without readings stay unchanged."""
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


TABLES = 16
"""Number of tables drawn at random; their effect has about this many degrees of freedom."""
ORDER, NODES, SPACING_MM, UNIT_MM, SEED = 6, 5, 25.0, 1e-4, 16
"""Properties of the drawn tables: highest Legendre order of the errors that they correct, nodes per axis of their fit, distance of their
points, unit of their entries; and the seed."""


def with_unknown_table(solution: JointSolution) -> JointSolution:
    """Return the solution with a covariance that includes an unknown table in force."""
    r = response(solution)
    effect = r.design.T @ (r.weight[:, None] * reading_patterns_mm(solution))
    return widened(solution, "table", r.covariance @ effect / np.sqrt(TABLES))


def reading_patterns_mm(solution: JointSolution) -> F2:
    """Return what each table drawn at random does to the readings beyond smooth corrections, mm, shape (readings, TABLES)."""
    rng = np.random.default_rng(SEED)
    machine, terms = solution.machine, smooth_terms(ORDER)
    x, y, z = (max(2, round(length / SPACING_MM)) for length in machine.length_mm)
    grids = grid_positions(machine, (x, y, z))
    per_unit = table_design(solution, grids, NODES, terms)
    sd = term_prior_sd(machine, terms, Priors())
    lost, u_lost = np.array(list(solution.backlash_mm().values())).T
    patterns = []
    for _ in range(TABLES):
        drawn = sd * rng.standard_normal(sd.size)
        cx, cy, cz = (np.round(-(one @ drawn) / UNIT_MM) * UNIT_MM for one in per_unit)
        table = NineTables(grids, (cx, cy, cz), (np.zeros_like(cx), np.zeros_like(cy), np.zeros_like(cz)))
        patterns.append(effect_mm(solution.data, removed_table(table, np.abs(lost + u_lost * rng.standard_normal(3)))))
    return np.stack(patterns, axis=1)


def effect_mm(data: tuple[RunData, ...], out: RemovedTable) -> F1:
    """Return what a table does to the readings beyond smooth corrections, mm, run by run, shape (readings,)."""
    return np.concatenate([_on_run_mm(run, out.force) - _on_run_mm(run, out.stays) for run in data])


def _on_run_mm(run: RunData, tables: AppliedTables) -> F1:
    if run.centre_mm is not None:
        return tables.bar_mm(run.axes_mm, run.centre_mm)
    if run.beam is None:
        return np.zeros(run.deviation_mm.size)
    return tables.laser_mm(run.axes_mm, run.beam)


IN_U = "U includes what a table of usual size may have done"


@dataclass(frozen=True)
class RemovedEffects:
    """A campaign without the effects that tables cannot correct.

    ``labels``: the subtracted effects; ``lines``: every effect that a table cannot correct, with its remedy, or why the model book was not
    used; ``version``: version of the model book, None if there is no book; ``in_force``: the active table whose side effects were
    subtracted (`remove_table`), None: no side effects were; ``not_removed``: why the side effects of a table remain in the readings, empty
    if none remain.
    """

    campaign: Campaign
    labels: tuple[str, ...]
    lines: tuple[str, ...]
    version: int | None
    in_force: TableRemoval | None = None
    not_removed: str = ""

    @property
    def doc(self) -> dict[str, Any]:
        """The keys about these effects in a solution's document; empty if there is neither a model book nor an active table."""
        doc: dict[str, Any] = {} if self.in_force is None else {"table_taken_out": self.in_force.model_dump(mode="json")}
        doc |= {"table_not_taken_out": self.not_removed} if self.not_removed else {}
        if self.version is None:
            return doc
        return doc | {"machine_model": {"version": self.version, "taken_out": list(self.labels), "not_for_tables": list(self.lines)}}


def remove_effects(
    store: Store | None, campaign: Campaign, table: CampaignTable, effects: tuple[Effect, ...] | None = None
) -> RemovedEffects:
    """Subtract effects that tables cannot correct from a campaign's readings.

    These are: what ``table``, which was active during the measurement, does beyond smooth corrections; and the effects in the machine's
    model book that apply to this campaign and have another remedy than a table (none without a ``store``).

    Raises
    ------
    CampaignRefused
        A table was active, and the data of a run contradict its description.
    ModelUnknown
        The book contains an effect that is not in the catalogue.
    """
    left = remove_table(campaign, table.table)
    return replace(_without_book_effects(store, left, effects), in_force=left.removed, not_removed=table.why and f"{table.why}; {IN_U}")


def _without_book_effects(store: Store | None, campaign: Campaign, effects: tuple[Effect, ...] | None) -> RemovedEffects:
    record = None if store is None else current(store, campaign.site.name)
    if record is None:
        return RemovedEffects(campaign, (), (), None)
    if record.book.machine_digest != machine_digest(campaign.site.machine):
        line = f"model version {record.version} of {campaign.site.name} is for another geometry and was not used"
        return RemovedEffects(campaign, (), (line,), record.version)
    chosen = [e for e in record.book.effects if e.remedy != "table" and applies(e, campaign.name)]
    lines = tuple(no_table_lines(record))
    if not chosen:
        return RemovedEffects(campaign, (), lines, record.version)
    left = subtract_effects(campaign, chosen, f"model version {record.version}", effects)
    return RemovedEffects(left, tuple(e.label for e in chosen), lines, record.version)


def subtract_effects(campaign: Campaign, entries: Sequence[EffectSize], origin: str, effects: tuple[Effect, ...] | None = None) -> Campaign:
    """Subtract the contribution of named effects from a campaign's readings; ``origin``: their origin, for the record of each run.

    Raises
    ------
    ModelUnknown
        An effect is not in the catalogue.
    """
    if not entries:
        return campaign
    case = case_of(campaign.doc, campaign.site.machine, campaign.runs)
    known_mm = readings_of(entries, effects or catalogue(), case)
    removed = f"{origin}: {', '.join(e.label for e in entries)}"
    return replace(campaign, runs=[run if run.is_artefact else _without_known(run, known_mm[run.run_id], removed) for run in campaign.runs])


def _without_known(run: Run, known_mm: F1, removed: str) -> Run:
    return run if run.is_sealed else with_changed_readings(run, run.columns.readings_mm - known_mm, removed)
