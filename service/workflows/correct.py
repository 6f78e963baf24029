"""From an identification campaign to a verified table: solve, push, measure again, keep or go back.

A machine that is measured while a table is active shows what that table has left. So the table that was active is read from the controller,
must be the one all runs were measured with, and the new table is the old one plus what the runs still show.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

from drivers.links.shielded import run_to_end
from models.compensation.tables import NineTables, Predicted, nine_tables, predict_residual, quantise
from service.devices.session import Session
from service.errors import TableMismatch, TableRefused
from service.events import Progress, ProgressSink
from service.runs.columns import load_run
from service.sequences.campaigns import verification
from service.site import Site
from service.storage.store import Store
from service.workflows.compensate import Base, Pushed, Pusher, read_base
from service.workflows.measure import measure
from service.workflows.recover import recover
from service.workflows.solve import Solved, helix_misfit, solve_runs
from service.workflows.solve_report import solution_doc
from service.workflows.tables import added
from service.workflows.taken_out import stored_without
from service.workflows.verify import Decision, Figures, decide, figure_rows, figures

GRID = (25, 21, 19)
MIN_GAIN = 0.1
"""A table is pushed only if the identified model promises at least this relative improvement (reliability.md 3.3)."""


@dataclass(frozen=True)
class Correction:
    """What was solved, pushed and found. ``bank`` and ``image`` are what the controller holds active at the end.

    ``not_for_tables``: effects that the machine's model knows and that no table takes out, each with its remedy.
    """

    solved: Solved
    tables: NineTables
    lsb_nm: int
    predicted: Predicted
    holdout_misfit_um: float | None
    before: Figures
    after: Figures
    pushed: Pushed
    decision: Decision
    bank: int
    image: bytes
    not_for_tables: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class _Bench:
    """What a correction works with."""

    session: Session
    store: Store
    site: Site
    rate_hz: int
    progress: ProgressSink


@dataclass(frozen=True)
class Proposal:
    """Tables that a campaign proposes, absolute and quantised, and what they promise."""

    solved: Solved
    tables: NineTables
    predicted: Predicted


async def correct(
    session: Session,
    store: Store,
    site: Site,
    campaign: str | int,
    before: list[dict[str, Any]],
    *,
    rate_hz: int = 100,
    progress: ProgressSink,
) -> Correction:
    """Correct a machine from a measured identification campaign.

    Parameters
    ----------
    campaign : str or int
        Identification campaign in the store.
    before : list of dict
        Verification runs measured with the present table, as ``abbe-run/1``.

    Raises
    ------
    TableRefused
        A limit is broken, or the tables promise too little: nothing was written.
    TableMismatch
        Runs were measured with another table than the active one, or the controller does not hold what was sent.
    StillActive
        An unverified table could not be taken back yet.
    """
    await recover(session.controller, store, site)
    record = await asyncio.to_thread(store.campaign, campaign)
    run_ids = [r.id for r in await asyncio.to_thread(store.runs, record.id) if r.visible_status == "complete"]
    runs = await load_runs(store, run_ids)
    base = await read_base(session.controller)
    check_same_table(base, [*(r for r in runs if r["role"] == "identify"), *before])
    check_temperature(site, runs)
    old = figures(before)  # before anything is written: runs that are no verification are refused now
    lsb_nm = (await session.controller.table_format()).lsb_nm
    progress(Progress("solve", 0.0, 1.0, None, "21 error motions with all set-up errors"))
    known = await asyncio.to_thread(stored_without, store, record.name)
    proposal = await asyncio.to_thread(propose, site, known.campaign.runs, base, lsb_nm)
    doc = solution_doc(proposal.solved) | known.doc
    solution_id = await store.write(store.add_solution, record.id, "joint", run_ids, doc)
    bench = _Bench(session, store, site, rate_hz, progress)
    pushed, after, decision = await _push_and_verify(bench, proposal, base, solution_id, old)
    bank = pushed.bank if decision.keep else pushed.previous_bank
    helix = next((r for r in before if r["test"] == "ballbar_helix"), None)
    misfit = helix_misfit(proposal.solved, helix) * 1e3 if helix is not None else None
    image = await session.controller.read_bank(bank)
    return Correction(
        proposal.solved, proposal.tables, lsb_nm, proposal.predicted, misfit, old, after, pushed, decision, bank, image, known.lines
    )


def check_same_table(base: Base, runs: list[dict[str, Any]]) -> None:
    """Every run must have been measured with the table that is active now.

    Raises
    ------
    TableMismatch
        Which run was not, or does not say so.
    """
    for run in runs:
        seen = run.get("table", {}).get("crc")
        if seen != base.crc:
            with_what = "does not say with which table it was measured" if seen is None else f"was measured with table {seen:08X}"
            raise TableMismatch(f"run {run['run_id']} {with_what}; active is {base.crc:08X}", "measure again with the present table")


def check_temperature(site: Site, runs: list[dict[str, Any]]) -> None:
    """Tables hold at the temperature they were measured at: outside of the allowed window none is pushed.

    Raises
    ------
    TableRefused
        Which run, which temperature.
    """
    low, high = site.temperature_c
    for run in runs:
        for t in run["columns"].get("temp_air_C", []):
            if not low <= t <= high:
                raise TableRefused(
                    f"run {run['run_id']} was measured at {t:.1f} °C air, allowed are {low:g} to {high:g} °C",
                    "measure again when the shop has settled, or change temperature_c under [limits]; nothing was written",
                )


def propose(site: Site, runs: list[dict[str, Any]], base: Base, lsb_nm: int) -> Proposal:
    """Absolute tables from runs that were measured while ``base`` was active.

    Raises
    ------
    TableRefused
        The model promises less than `MIN_GAIN`, or less than twice its own uncertainty.
    """
    solved = solve_runs(site, runs)
    change = nine_tables(solved.joint, GRID)
    predicted = predict_residual(solved.joint, change)
    gain = predicted.before_mm - predicted.after_mm
    if gain < MIN_GAIN * predicted.before_mm or gain < 2.0 * predicted.u_model_mm:
        raise TableRefused(
            f"the tables promise {predicted.before_mm * 1e3:.1f} → {predicted.after_mm * 1e3:.1f} µm rms "
            f"(model uncertainty {predicted.u_model_mm * 1e3:.1f} µm): not enough to write",
            "the present table is as good as these runs can tell; nothing was written",
        )
    return Proposal(solved, quantise(added(base.tables, change), lsb_nm * 1e-6), predicted)


async def _push_and_verify(
    bench: _Bench, proposal: Proposal, base: Base, solution_id: int, before: Figures
) -> tuple[Pushed, Figures, Decision]:
    """Push, measure again, keep or go back. Whatever stops the verification takes the old table back."""
    site, store = bench.site, bench.store
    bench.progress(Progress("push", 0.0, 1.0, None, "nine tables to the inactive bank, read back twice, activate"))
    pusher = Pusher(bench.session.controller, store, site)
    p = proposal.predicted
    doc = {"kind": "nine one-axis tables", "predicted_rms_um": p.after_mm * 1e3, "u_model_um": p.u_model_mm * 1e3}
    pushed = await pusher.push(proposal.tables, base=base, solution_id=solution_id, doc=doc)
    name = f"verify-after-push-{pushed.push_id}"
    try:
        plan = verification(site.machine, rate_hz=bench.rate_hz, name=name)
        ids = await measure(bench.session, store, site, plan, progress=bench.progress)
        after = figures(await load_runs(store, ids))
        decision = decide(before, after)
        if decision.keep:
            await run_to_end(pusher.keep())
    except BaseException as error:
        await pusher.back_out(error)  # not verified is not kept
        raise
    if not decision.keep:
        await pusher.go_back(decision.text)
    await _store_verification(store, site, name, pushed, after, decision)
    return pushed, after, decision


async def _store_verification(store: Store, site: Site, name: str, pushed: Pushed, after: Figures, decision: Decision) -> None:
    rows = {k: {"value": v, "u": u} for k, (v, u) in figure_rows(after).items()}
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    doc = {"text": decision.text, "push": pushed.push_id, "figures": rows}
    campaign = await asyncio.to_thread(store.campaign, name)
    await store.write(store.add_verification, machine_id, campaign.id, "pass" if decision.keep else "fail", doc)


async def load_runs(store: Store, run_ids: list[int]) -> list[dict[str, Any]]:
    """Runs of the store as ``abbe-run/1`` objects, read off the event loop."""
    return await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])
