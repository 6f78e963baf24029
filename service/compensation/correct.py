"""From an identification campaign, or a stored proposal, to a verified table: push, prove the sign, measure again, keep or go back.

`correct` is `proposals.make` and `push` in one go; both take the same way through the push machine, with the same questions.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.models.compensation.sign_probe import expected_changes, probe
from abbe.models.compensation.tables import NineTables, Predicted
from abbe.service.campaigns.bar_places import BarPlaces, PlaceReadings
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.compensation.gate import Admission, PushContext, admit, check_promise, ready
from abbe.service.compensation.proposal_checks import HoldReason
from abbe.service.compensation.proposals import (
    Made,
    check_before_runs,
    check_same_table,
    check_temperature,
    gather,
    load_runs,
    make,
    solved_again,
)
from abbe.service.compensation.proved_levels import LevelStatus
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.domain.progress import Progress
from abbe.service.errors import AbbeError, TableRefused, TakenBack
from abbe.service.identification.solve import Solved, helix_misfit
from abbe.service.identification.table_removal import less, taken
from abbe.service.push.operations import Verdict
from abbe.service.push.validate import drift_reason
from abbe.service.sequences.check import paced
from abbe.service.sequences.interlocks import Suspending
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.verification.verify import VerificationDecision, VerificationFigures, check_before, decide, figure_rows, figures

UNSEEN = "DRIFT: no ball-bar run that the solution has not seen shows whether the machine still is what was measured"
VERIFY, SIGN = "verify-after-push-", "sign-check"
PLACES = 12
"""Of the ball-bar, before and after a new table comes into force."""


@dataclass(frozen=True)
class Correction:
    """What was solved, pushed and found. ``bank`` and ``image`` are what the controller holds active at the end.

    ``not_for_tables``: effects that the machine's model knows and that no table takes out, each with its remedy. ``proposal``: its number
    in the store.
    """

    solved: Solved
    tables: NineTables
    lsb_nm: int
    predicted: Predicted
    holdout_misfit_um: float | None
    before: VerificationFigures
    after: VerificationFigures
    pushed: PushResult
    decision: VerificationDecision
    bank: int
    image: bytes
    not_for_tables: tuple[str, ...] = ()
    proposal: int = 0


async def correct(
    context: PushContext, campaign: str | int, before: list[dict[str, Any]], control: LevelStatus | None = None
) -> Correction:
    """Correct a machine from a measured identification campaign.

    Parameters
    ----------
    context : PushContext
        Devices, store and machine.
    campaign : str or int
        Identification campaign in the store.
    before : list of dict
        Verification runs measured with the present table, as ``abbe-run/1``.
    control : LevelStatus, optional
        From `abbe.service.compensation.gate.ready`, where that was asked before; default: it is asked now.

    Raises
    ------
    TableRefused
        A limit is broken, or the tables promise too little: nothing was written.
    TableMismatch
        Runs were measured with another table than the active one, or the controller does not hold what was sent.
    StillActive
        An unverified table could not be taken back yet.
    """
    store, site = context.store, context.site
    control = control or await ready(context)
    gathered = await gather(context.session.controller, store, site, campaign)
    check_same_table(gathered.base, before)
    check_temperature(site, gathered.runs)
    figures(before)  # before anything is written: runs that are no verification are refused now
    made = await make(store, site, gathered, progress=context.progress, agree=lambda promised: check_promise(promised, site.limits))
    return await _push(context, await admit(context, made.number, control), made, before)


async def push(context: PushContext, admission: Admission, before: list[dict[str, Any]]) -> Correction:
    """Push a stored proposal that the gate let pass (`abbe.service.compensation.gate.admit`), then as `correct`.

    Parameters
    ----------
    context : PushContext
        Devices, store and machine; who stops it, and whether a person attends.
    admission : Admission
        Of the proposal.
    before : list of dict
        Verification runs measured with the present table, as ``abbe-run/1``.

    Raises
    ------
    TableRefused, TableMismatch, StillActive
        As of `correct`.
    Stopped, Aborted
        Asked for; the old table is in force.
    """
    proposed = admission.held.proposed
    context.progress(Progress("solve", 0.0, 1.0, None, "once more, for what the newest run says of it"))
    made = Made(admission.held.number, proposed, await solved_again(context.store, context.site, proposed.campaign, proposed.base_tables))
    await context.control.gate()
    return await _push(context, admission, made, before)


async def _push(context: PushContext, admission: Admission, made: Made, before: list[dict[str, Any]]) -> Correction:
    """Push an admitted proposal and verify it. Any interlock ends it: nothing waits while an unverified table is in force."""
    session, store, proposed, held = context.session, context.store, made.proposed, admission.held
    site = replace(context.site, watching=replace(context.site.watching, suspending=Suspending()))
    context = replace(context, site=site)
    check_same_table(held.base, before)
    evidence = proposed.candidate.evidence
    newest_s = evidence.ended_s if evidence.last_s is None else evidence.last_s
    check_before_runs(site, held.base, before, newest_s, context.clock.utc().timestamp())
    old = figures(before)
    check_before(old)
    helix = next((r for r in before if r["test"] == "ballbar_helix"), None)
    misfit_mm = None if helix is None else helix_misfit(made.solved, _as_solved(helix, made.solved, held.base.tables))
    bar = None
    if session.ballbar is not None and session.fixture is not None:
        number = sum(c.name.startswith(SIGN) for c in await asyncio.to_thread(store.campaigns.all)) + 1
        bar = BarPlaces(session, store, site, context.progress, f"{SIGN} {number}", PLACES, context.control)
    p, lsb_nm = proposed.predicted, proposed.candidate.lsb_nm
    doc = {"kind": "nine one-axis tables", "predicted_rms_um": p.after_mm * 1e3, "u_model_um": p.u_model_mm * 1e3, "proposal": made.number}
    work = _Correcting(context, admission, misfit_mm, bar, old)
    wanted = WantedTable(proposed.tables, held.base, lsb_nm, proposed.solution_id, doc, proposed.image_id)
    pushed, after, decision = await _push_and_verify(work, wanted)
    bank = pushed.bank if decision.keep else pushed.previous_bank
    image = await session.controller.read_bank(bank)
    misfit_um = None if misfit_mm is None else misfit_mm * 1e3
    return Correction(
        made.solved, proposed.tables, lsb_nm, p, misfit_um, old, after, pushed, decision, bank, image, proposed.not_for_tables, made.number
    )


def _as_solved(run: dict[str, Any], solved: Solved, table: NineTables | None) -> dict[str, Any]:
    """A run as those that were solved were: less what the table in force did beyond its smooth corrections."""
    if table is None:
        return run
    lost = np.array([v for v, _ in solved.joint.backlash_mm().values()])
    return less([run], taken(table, lost))[0]


@dataclass
class _Correcting:
    """Answers the push machine's questions about one proposal: are there reasons against it, goes the tool where it says, is it better?"""

    context: PushContext
    admission: Admission
    drift_mm: float | None
    """What the solution leaves of the newest run, which it has not seen."""
    bar: BarPlaces | None
    before: VerificationFigures
    read_before: PlaceReadings | None = None
    after: VerificationFigures | None = None
    decision: VerificationDecision | None = None
    verified_as: str = ""
    pushing: Pushing | None = None

    @property
    def held(self) -> HoldReason:
        """The proposal as it was admitted."""
        return self.admission.held

    def drifted(self) -> list[str]:
        """Why the machine is not what was measured any more, by a run that was not known when the proposal was admitted."""
        if self.drift_mm is None:
            return [UNSEEN]
        return [reason] if (reason := drift_reason(self.drift_mm, self.context.site.limits)) else []

    def reasons(self) -> list[str]:
        """Everything against it, asked by the push machine: decisions and time as they are by then."""
        now = self.held.renewed(self.context.store, self.context.clock.utc().timestamp())
        return [*now.reasons(self.drift_mm), *([UNSEEN] if self.drift_mm is None else [])]

    async def probe(self) -> Verdict:
        """Sign, axis and unit of this table, physically; the bar is taken out afterwards, for the verification mounts its own."""
        if self.bar is None or self.read_before is None:
            return Verdict(True, "no ball-bar is configured: the sign rests on the commissioning")
        after = await self.bar.read("after")
        await self.bar.clear_away()
        each = expected_changes(after.places_mm, np.array(self.bar.centre_mm), self.held.base.tables, self.held.proposed.tables)
        found = probe(each, self.read_before.deviation_mm, after.deviation_mm)
        return Verdict(found.agrees, found.text + ("" if all(found.seen) else "; that rests on the commissioning"))

    async def verify(self) -> Verdict:
        context = self.context
        number = sum(c.name.startswith(VERIFY) for c in await asyncio.to_thread(context.store.campaigns.all)) + 1
        name = f"{VERIFY}{number}"
        plan = paced(verification(context.site.machine, rate_hz=context.rate_hz, name=name), context.site.max_feed_mm_min)
        options = MeasureOptions(control=context.control, part=True)
        ids = await measure(context.session, context.store, context.site, plan, progress=context.progress, options=options)
        self.after = figures(await load_runs(context.store, ids))
        self.decision = decide(self.before, self.after, self.pushing.crc if self.pushing is not None else None)
        self.verified_as = name
        return Verdict(self.decision.keep, self.decision.text)


async def _push_and_verify(work: _Correcting, wanted: WantedTable) -> tuple[PushResult, VerificationFigures, VerificationDecision]:
    """Push, prove the sign, measure again, keep or go back. Whatever stops it takes the old table back."""
    context = work.context
    if drifted := work.drifted():  # before the ball-bar is read
        raise TableRefused.because(drifted)
    questions = Questions(work.reasons, work.held.by, work.probe, work.verify, work.held.approval(context.clock))
    work.pushing = pushing = Pushing(
        context.session.controller, context.store, context.site,
        level=work.admission.level, attended=context.attended, control=context.control,
    )  # fmt: skip
    if work.bar is None:
        await context.control.gate()
        pushed = await pushing.bring(wanted, questions)
    else:
        async with work.bar.cleared_away():
            work.read_before = await work.bar.read("before")
            await context.control.gate()
            context.progress(Progress("push", 0.0, 1.0, None, "nine tables to the inactive bank, read back twice, activate"))
            pushed = await pushing.bring(wanted, questions)
    if work.after is None or work.decision is None:
        raise TakenBack(f"the table was taken back: {pushed.why}", "look at the control's convention: abbe comp commission")
    decision = work.decision if pushed.kept == work.decision.keep else VerificationDecision(pushed.kept, pushed.why)
    try:
        await _store_verification(context, work.verified_as, pushed, work.after, decision)
    except AbbeError as error:  # what the control does is decided and done; only the note of it is missing
        error.add_note(f"the table is {'kept and in force' if decision.keep else 'taken back'}: {decision.text}")
        raise
    return pushed, work.after, decision


async def _store_verification(
    context: PushContext, name: str, pushed: PushResult, after: VerificationFigures, decision: VerificationDecision
) -> None:
    store, site = context.store, context.site
    rows = {k: {"value": v, "u": u} for k, (v, u) in figure_rows(after).items()}
    machine_id = await store.write(store.machines.add, site.name, site.doc)
    doc = {"text": decision.text, "push": pushed.push_id, "figures": rows}
    campaign = await asyncio.to_thread(store.campaigns.find, name)
    await store.write(store.verifications.add, machine_id, campaign.id, "pass" if decision.keep else "fail", doc)
