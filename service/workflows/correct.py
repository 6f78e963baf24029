"""From an identification campaign to a verified table: solve, push, measure again, keep or go back."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from typing import Any

from drivers.links.shielded import run_to_end
from models.compensation.tables import NineTables, Predicted, nine_tables, predict_residual, quantise
from service.devices.session import Session
from service.events import Progress, ProgressSink
from service.runs.columns import load_run
from service.sequences.campaigns import verification
from service.site import Site
from service.storage.store import Store
from service.workflows.compensate import Pushed, Pusher
from service.workflows.measure import measure
from service.workflows.recover import recover
from service.workflows.solve import Solved, helix_misfit, solution_doc, solve_runs
from service.workflows.verify import Decision, Figures, decide, figure_rows, figures

GRID = (25, 21, 19)
LSB_NM = 100


@dataclass(frozen=True)
class Correction:
    """What was solved, pushed and found. ``active_bank`` and ``image`` are what the controller holds at the end."""

    solved: Solved
    tables: NineTables
    predicted: Predicted
    holdout_misfit_um: float | None
    before: Figures
    after: Figures
    pushed: Pushed
    decision: Decision
    active_bank: int
    image: bytes


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
        A limit is broken: nothing was written.
    TableMismatch
        The controller does not hold what was sent: it was not activated.
    """
    said = await recover(session.controller, store, site)
    if said is not None:
        progress(Progress("recover", 1.0, 1.0, 0.0, said))
    record = await asyncio.to_thread(store.campaign, campaign)
    run_ids = [r.id for r in await asyncio.to_thread(store.runs, record.id) if r.visible_status == "complete"]
    progress(Progress("solve", 0.0, 1.0, None, "21 error motions with all set-up errors"))
    runs = await load_runs(store, run_ids)
    solved = await asyncio.to_thread(solve_runs, site, runs)
    tables = quantise(nine_tables(solved.joint, GRID), LSB_NM * 1e-6)
    predicted = predict_residual(solved.joint, tables)
    solution_id = await store.write(store.add_solution, record.id, "joint", run_ids, solution_doc(solved))
    progress(Progress("push", 0.0, 1.0, None, "nine tables to the inactive bank, read back twice, activate"))
    pusher = Pusher(session.controller, store, site)
    doc = {"kind": "nine one-axis tables", "predicted_rms_um": predicted.after_mm * 1e3, "u_model_um": predicted.u_model_mm * 1e3}
    pushed = await pusher.push(tables, lsb_nm=LSB_NM, solution_id=solution_id, doc=doc)
    old = figures(before)
    after, decision = await _verify(session, store, site, (pusher, pushed), old, rate_hz, progress)
    bank = pushed.bank if decision.keep else pushed.previous_bank
    image = await session.controller.read_bank(bank)
    helix = next((r for r in before if r["test"] == "ballbar_helix"), None)
    misfit = helix_misfit(solved, helix) * 1e3 if helix is not None else None
    return Correction(solved, tables, predicted, misfit, old, after, pushed, decision, bank, image)


async def _verify(
    session: Session, store: Store, site: Site, push: tuple[Pusher, Pushed], before: Figures, rate_hz: int, progress: ProgressSink
) -> tuple[Figures, Decision]:
    """Measure again with the new table; keep it or go back to the old one. A verification that cannot be finished goes back too."""
    pusher, pushed = push
    name = f"verify-after-push-{pushed.push_id}"
    try:
        ids = await measure(session, store, site, verification(site.machine, rate_hz=rate_hz, name=name), progress=progress)
        after = figures(await load_runs(store, ids))
    except BaseException as error:
        # not verified is not kept: whatever stopped the measurement, the table that was there before comes back
        await run_to_end(pusher.roll_back(pushed, f"verification not finished: {error}"))
        raise
    decision = decide(before, after)
    if decision.keep:
        await pusher.keep()
    else:
        await pusher.roll_back(pushed, decision.text)
    rows = {k: {"value": v, "u": u} for k, (v, u) in figure_rows(after).items()}
    machine_id = await store.write(store.add_machine, site.name, site.doc)
    doc = {"text": decision.text, "push": pushed.push_id, "figures": rows}
    campaign = await asyncio.to_thread(store.campaign, name)
    await store.write(store.add_verification, machine_id, campaign.id, "pass" if decision.keep else "fail", doc)
    return after, decision


async def load_runs(store: Store, run_ids: list[int]) -> list[dict[str, Any]]:
    """Runs of the store as ``abbe-run/1`` objects, read off the event loop."""
    return await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])
