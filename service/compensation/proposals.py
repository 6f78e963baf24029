"""From an identification campaign to a stored proposal: solve the runs, add the tables in force, collect the reasons against the proposal.

A machine that is measured with a table active shows the errors that this table leaves. Therefore the active table is read from the
controller, and every run must have been measured with it. The new table is the active one plus the errors that the runs still show.
Nothing is written to the controller.
"""

from __future__ import annotations

import asyncio
import secrets
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, time, timedelta
from typing import Any

import numpy as np

from abbe.drivers.api import TableController, TableFormat
from abbe.drivers.tables import FORMAT_VERSION
from abbe.models.arrays import F2
from abbe.models.compensation.nine_tables import nine_tables, predict_residual
from abbe.models.compensation.plane import partial_tables
from abbe.models.compensation.tables import NineTables, Predicted, quantise
from abbe.models.machine import AXES
from abbe.models.uncertainty.scales import SCALE_TEXTS
from abbe.service.audit.book import login
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.clock import Clock, SystemClock, utc_text
from abbe.service.compensation.proposal_doc import BaseMark, Proposed, digest_of_doc, doc_of
from abbe.service.domain.measured import CampaignRecord, RunRecord
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.run import Run
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.identification.artefact_answer import deviation_of_artefacts, touched_boxes_mm, unsensed_axis
from abbe.service.identification.removal import CampaignTable, RemovedEffects, remove_effects
from abbe.service.identification.solve import Solved, beyond_the_prior, solve_runs
from abbe.service.push.validate import Candidate, CandidateContext, Column, EvidenceSeal, TableEvidence, content_digest, reasons_against
from abbe.service.runs.columns import load_run
from abbe.service.runs.coverage import reached_mm
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, added, read_base, tables_from_image
from abbe.service.tables.push_journal import JournalView

SIGNER = "metrologist"
MONTH = timedelta(days=30)


@dataclass(frozen=True, slots=True)
class Promise:
    """Computed tables and the model's prediction for them.

    ``tables``: absolute, rounded to the controller's unit; ``change``: what they add to the tables in force, before rounding. ``drift_mm``:
    rms residual of the solution in the newest run that it did not use, None if there is no such run. ``ended_s``, ``last_s``: end of the
    oldest and of the newest identifying run, seconds UTC.
    """

    tables: NineTables
    change: NineTables
    predicted: Predicted
    drift_mm: float | None
    ended_s: float
    last_s: float


def candidate_of(site: Site, promise: Promise, base: Base, runs: list[Run], form: TableFormat) -> Candidate:
    """Make a signed candidate of computed tables; ``runs``: the solved runs."""
    columns = tuple(_column(promise, a, i) for a in range(3) for i in range(3))
    blank = Candidate(site.name, FORMAT_VERSION, form.lsb_nm, "mm", columns, base.crc, _evidence(site, promise, runs), "")
    digest = content_digest(blank)
    return replace(blank, digest=digest, seal=EvidenceSeal(SIGNER, digest))


def _column(promise: Promise, a: int, i: int) -> Column:
    values = promise.tables.correction_mm[a][:, i] + 0.0  # -0.0 has other bytes than 0.0
    left = -promise.change.correction_mm[a][:, i] + 0.0
    return Column(AXES[a], AXES[i], tuple(promise.tables.position_mm[a].tolist()), tuple(values.tolist()), tuple(_plain(left)))


def _plain(values: Any) -> list[float]:
    """Numbers below 1e-15 become zero: the checks refuse denormal ones."""
    return [0.0 if abs(v) < 1e-15 else float(v) for v in values]


def _evidence(site: Site, promise: Promise, runs: list[Run]) -> TableEvidence:
    used = [r for r in runs if r.identifies]
    air = list(site.room_c or ()) if air_is_stated(site, runs) else [float(t) for r in used for t in r.columns.air_c]
    if not air or not np.isfinite(air).all():
        air = [float("nan")]
    p = promise.predicted
    drift = 0.0 if promise.drift_mm is None else promise.drift_mm
    return TableEvidence(
        len(used), promise.ended_s, (min(air), max(air)), drift, p.u_model_mm, p.before_mm, p.after_mm,
        mark_of(r.table.boot_id for r in used),
        certified_until_s(site.calibrated_until, _instruments(used) | ({"room"} if air_is_stated(site, runs) else set())),
        promise.last_s, reached_mm(used),
    )  # fmt: skip


STATED = "the air's temperature is not measured: a person stated the room's temperature (room_temperature_c)"


def air_is_stated(site: Site, runs: list[Run]) -> bool:
    """Whether the stated range of the room replaces the air temperature, because no identifying run recorded the air."""
    return site.room_c is not None and not any(r.columns.air_c.size for r in runs if r.identifies)


def _instruments(runs: list[Run]) -> set[str]:
    return {r.instrument for r in runs}


def certified_until_s(days: Mapping[str, date], instruments: set[str]) -> tuple[float, ...]:
    """Ends of the certificates of these instruments; empty if an instrument has no certificate."""
    return tuple(until_s(days[kind]) for kind in sorted(instruments)) if instruments <= days.keys() else ()


def until_s(day: date) -> float:
    """The end of the last day of a certificate, UTC."""
    return datetime.combine(day, time.max, UTC).timestamp()


def mark_of(boots: Iterable[int | None]) -> str:
    """A mark that must not change between measuring and pushing: the boot ids of the controller, each once."""
    distinct = sorted({-1 if boot is None else int(boot) for boot in boots})
    return "boot " + ", ".join("not known" if boot < 0 else f"{boot:08X}" for boot in distinct)


async def candidate_context(
    site: Site, store: Store, base: Base, form: TableFormat, grid: NineTables, clock: Clock, *, attended: bool = True
) -> CandidateContext:
    """The present state of this machine, its controller and its table in force. ``attended``: an authorised approver is at the machine."""
    journal = await asyncio.to_thread(JournalView.read, store, site.name, site.urls.control, origins=False)
    month_ago = {} if attended else _on_grid(_month_ago(journal, base, clock), grid)
    travel = {axis: (float(low), float(high)) for axis, (low, high) in zip(AXES, site.machine.stroke_mm, strict=True)}
    return CandidateContext(
        site.name, mark_of([base.status.boot_id]), FORMAT_VERSION, form.lsb_nm, form.bank_registers, travel, {}, base.crc,
        _on_grid(base.tables, grid), month_ago, clock.utc().timestamp(), attended=attended, last_push_s=journal.last_kept_s,
    )  # fmt: skip


def _month_ago(journal: JournalView, base: Base, clock: Clock) -> NineTables | None:
    """Return the tables in force `MONTH` ago. If no push was kept by then: the base of the first kept push, else ``base``."""
    kept, old = journal.kept(), journal.kept(clock.utc() - MONTH)
    if not kept:
        return base.tables
    return tables_from_image(old[-1].image if old else kept[0].base_image)


def _on_grid(tables: NineTables | None, grid: NineTables) -> dict[tuple[str, str], tuple[float, ...]]:
    """Tables interpolated onto another grid; zeros for no correction."""
    if tables is None:
        return {(a, i): (0.0,) * grid.position_mm[k].size for k, a in enumerate(AXES) for i in AXES}
    found = {}
    for k, a in enumerate(AXES):
        for n, i in enumerate(AXES):
            found[(a, i)] = tuple(np.interp(grid.position_mm[k], tables.position_mm[k], tables.correction_mm[k][:, n]).tolist())
    return found


GRID = (25, 21, 19)


@dataclass(frozen=True)
class Proposal:
    """Tables from a campaign (absolute, rounded), their addition to the tables in force (``change``, unrounded), and the prediction.

    ``left_out``: what was left out of the tables, in words.
    """

    solved: Solved
    tables: NineTables
    change: NineTables
    predicted: Predicted
    left_out: tuple[str, ...] = ()


@dataclass(frozen=True)
class GatheredCampaign:
    """A campaign's complete runs, and the table that is in force and was in force during all of them."""

    campaign: CampaignRecord
    records: list[RunRecord]
    runs: list[Run]
    base: Base
    form: TableFormat


@dataclass(frozen=True)
class StoredProposal:
    """A stored proposal, its number and its solution."""

    number: int
    proposed: Proposed
    solved: Solved


async def gather(controller: TableController, store: Store, site: Site, campaign: str | int) -> GatheredCampaign:
    """Read a campaign and the table in force.

    Raises
    ------
    TableMismatch
        A run was measured with another table.
    TableRefused
        The campaign belongs to another machine.
    """
    record = await asyncio.to_thread(store.campaigns.find, campaign)
    measured_on = (await asyncio.to_thread(store.machines.get, record.machine_id)).name
    if measured_on != site.name:
        raise TableRefused(
            f"campaign {record.name} was measured on {measured_on!r}, this is {site.name!r}", "name a campaign of this machine"
        )
    records = [r for r in await asyncio.to_thread(store.runs.all, record.id) if r.visible_status == "complete"]
    runs = await load_runs(store, [r.id for r in records])
    base = await read_base(controller)
    check_same_table(base, [r for r in runs if r.identifies])
    return GatheredCampaign(record, records, runs, base, await controller.table_format())


async def make(  # noqa: PLR0913 - every one of them is a choice of the caller, all with a default
    store: Store,
    site: Site,
    gathered: GatheredCampaign,
    *,
    clock: Clock | None = None,
    progress: ProgressSink,
    agree: Callable[[Predicted], None] = lambda _: None,
    by: str = "",
    without_scale: bool = False,
) -> StoredProposal:
    """Solve, and store the tables as a proposal together with every present reason against it.

    ``agree`` receives the prediction; if it raises, nothing is stored. ``by``: the proposer; default: the account of this process.
    ``without_scale``: as for `propose`.
    """
    from abbe.service.identification.solve_report import solution_doc  # here and below: an idle service writes no solution

    clock = clock or SystemClock()
    progress(Progress("solve", 0.0, 1.0, None, "21 error motions with all set-up errors"))
    name, base, form = gathered.campaign.name, gathered.base, gathered.form
    known = await asyncio.to_thread(_campaign_without_known_effects, store, name, base.tables)
    proposal = await asyncio.to_thread(propose, site, known.campaign.runs, base, form.lsb_nm, without_scale=without_scale)
    agree(proposal.predicted)
    doc = solution_doc(proposal.solved) | known.doc | {"machine": site.doc}
    solution_id = await store.write(store.solutions.add, gathered.campaign.id, "joint", [r.id for r in gathered.records], doc)
    promise = Promise(proposal.tables, proposal.change, proposal.predicted, None, *_ends_s(gathered.records))
    candidate = candidate_of(site, promise, base, known.campaign.runs, form)
    context = await candidate_context(site, store, base, form, proposal.tables, clock)
    status, stated = base.status, [STATED] if air_is_stated(site, known.campaign.runs) else []
    held = "; ".join(filter(None, [proposal.solved.holds_at, *stated]))
    proposed = Proposed(
        site.doc, name, solution_id, candidate, proposal.tables.u_mm,
        BaseMark(base.image, status.active_bank, status.gen, status.boot_id), secrets.randbits(31), site.limits, site.two_people,
        by or login(), utc_text(clock.utc()), tuple(reasons_against(candidate, context, site.limits)),
        (*known.lines, *proposal.left_out), held,
    )  # fmt: skip
    plain = doc_of(proposed)
    number = await store.write(store.proposals.add, site.name, solution_id, plain, digest_of_doc(plain))
    return StoredProposal(number, proposed, proposal.solved)


def _ends_s(records: list[RunRecord]) -> tuple[float, float]:
    """End of the oldest and of the newest identifying run, seconds UTC; 0 if a run does not state it."""
    used = [datetime.fromisoformat(r.ended_utc).timestamp() if r.ended_utc else 0.0 for r in records if r.role == "identify"]
    return min(used, default=0.0), max(used, default=0.0)


def propose(site: Site, runs: list[Run], base: Base, lsb_nm: int, *, without_scale: bool = False) -> Proposal:
    """Solve runs that were measured while ``base`` was active, and add their correction to it. ``lsb_nm``: the controller's unit, nm.

    ``without_scale``: do not correct the scales, the largest part of the uncertainty; those of the tables in force stay.

    Raises
    ------
    TableRefused
        The readings do not support the map, or (``without_scale``) the scales are not the least certain.
    """
    solved = solve_runs(site, runs)
    if not solved.joint.only_artefacts and (beyond := beyond_the_prior(solved.joint)):
        raise TableRefused(f"the readings do not support tables: {beyond.what}", f"{beyond.remedy}; nothing was written")
    change, predicted, left_out = change_of(solved, without_scale=without_scale)
    return Proposal(solved, quantise(added(base.tables, change), lsb_nm * 1e-6), change, predicted, left_out)


def change_of(solved: Solved, *, without_scale: bool = False) -> tuple[NineTables, Predicted, tuple[str, ...]]:
    """Return the tables that a solution adds to those in force, the prediction, and omissions as text; arguments as for `propose`."""
    if solved.joint.only_artefacts:
        return _change_where_touched(solved)
    if not without_scale:
        change = nine_tables(solved.joint, GRID)
        return change, predict_residual(solved.joint, change), ()
    from abbe.service.identification.solve_report import assess
    from abbe.service.identification.solve_tables import scale_free

    free = scale_free(assess(solved))
    sources, text = free.sources, SCALE_TEXTS[free.left_out or "common"]
    change = nine_tables(sources.solution, GRID, sources=sources)
    return change, predict_residual(sources.solution, change, sources=sources), (f"{text}, poorly determined by the runs: left out",)


def _change_where_touched(solved: Solved) -> tuple[NineTables, Predicted, tuple[str, ...]]:
    """Return tables of the planes or of the volume in which artefacts lay; beyond the touched positions they hold their end values.

    Raises
    ------
    TableRefused
        The solution corrected a fault of the set-up without review.
    """
    joint = solved.joint
    if solved.undone:
        fault = solved.undone[0]
        raise TableRefused(f"run {fault.run}: {fault.what} ({fault.done})", "look at the artefact and measure that pose again")
    frame: list[str] = []

    def known(points: F2) -> tuple[F2, F2]:
        value, expanded, words = deviation_of_artefacts(joint, points)
        frame.append(words)
        return value, 0.5 * expanded

    boxes = touched_boxes_mm(joint)
    change, predicted = partial_tables(joint.machine, boxes, known, GRID)
    where = "part of the strokes where the artefact lay, and assumed elsewhere"
    planes = f"plane{'s' if len(boxes) > 1 else ''} and " if unsensed_axis(joint) is not None else ""
    return change, predicted, (f"known only in the {planes}{where}; {frame[0]}",)


async def solve_again(store: Store, site: Site, campaign: str, table: NineTables | None) -> Solved:
    """Solve a stored proposal's campaign again, to compare it with a newer run. ``table``: the table in force during the campaign."""
    known = await asyncio.to_thread(_campaign_without_known_effects, store, campaign, table)
    return await asyncio.to_thread(solve_runs, site, known.campaign.runs)


def _campaign_without_known_effects(store: Store, name: str, table: NineTables | None) -> RemovedEffects:
    return remove_effects(store, from_store(store, name), CampaignTable(table))


def check_same_table(base: Base, runs: list[Run]) -> None:
    """Check that every run was measured with the table that is active now.

    Raises
    ------
    TableMismatch
        Names a run that was measured with another table, or does not state its table.
    """
    for run in runs:
        crc = run.table.crc
        if crc != base.crc:
            with_what = "does not say with which table it was measured" if crc is None else f"was measured with table {crc:08X}"
            raise TableMismatch(f"run {run.run_id} {with_what}; active is {base.crc:08X}", "measure again with the present table")
        if base.tables is not None and run.table.acting is False:
            why = f"run {run.run_id} was measured while table {base.crc:08X} did not act: the compensation was switched off"
            raise TableMismatch(why, "switch the compensation on at the control and measure again")


def check_temperature(site: Site, runs: list[Run]) -> None:
    """Check that every run was measured inside the allowed air temperatures: tables hold only near the temperature of their measurement.

    Raises
    ------
    TableRefused
        Names the run and its temperature.
    """
    low, high = site.temperature_c
    for run in runs:
        for t in run.columns.air_c:
            if not low <= t <= high:
                raise TableRefused(
                    f"run {run.run_id} was measured at {t:.1f} °C air, the limits are {low:g} to {high:g} °C",
                    "measure again when the shop has settled, or change temperature_c under [limits]; nothing was written",
                )


async def load_runs(store: Store, run_ids: list[int]) -> list[Run]:
    """Load runs in a thread, so that the event loop is not blocked."""
    return await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])


def check_before_runs(site: Site, base: Base, runs: list[Run], since_s: float, now_s: float) -> None:
    """Check that verification runs describe this machine as it is now: after identification, and since the control's last start.

    ``since_s``, ``now_s``: end of the newest identifying run, and now, seconds UTC.

    Raises
    ------
    TableRefused
        Names a run that does not describe this machine, and the reason.
    """
    low, high = site.temperature_c
    for run in runs:
        ended_s = datetime.fromisoformat(run.ended_utc).timestamp() if run.ended_utc else 0.0
        why = (
            "is of another machine" if run.machine != site.doc
            else "is from before the control's last start" if run.table.boot_id != base.status.boot_id
            else "was measured before the machine was identified" if ended_s < since_s
            else f"is older than {site.limits.age_h:g} h" if now_s - ended_s > site.limits.age_h * 3600.0
            else "ends in the future" if ended_s > now_s
            else f"was measured outside of {low:g} to {high:g} °C" if not all(low <= t <= high for t in run.columns.air_c)
            else ""
        )  # fmt: skip
        if why:
            raise TableRefused(
                f"run {run.run_id} is no basis for a comparison: it {why}", "repeat the first verification; nothing was written"
            )
