"""From an identification campaign, or a stored proposal, to a verified table: push, probe the sign, measure again, keep or roll back.

`correct` makes a proposal and pushes it; `push` pushes a stored one. Both run the same push machine with the same checks.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.compensation.sign_probe import expected_changes, probe
from abbe.models.compensation.tables import NineTables, Predicted
from abbe.models.verification import pose_figure
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.bar_places import BarPlaces, PlaceReadings
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.compensation.gate import Admission, PushContext, PushPrecheck, admit, check_preconditions, check_promise
from abbe.service.compensation.proposals import (
    StoredProposal,
    check_before_runs,
    check_same_table,
    check_temperature,
    gather,
    make,
    solve_again,
)
from abbe.service.compensation.proved_levels import LevelStatus
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.domain.progress import Progress
from abbe.service.domain.run import Run
from abbe.service.errors import AbbeError, TableRefused, TakenBack
from abbe.service.identification.removal import removed_table, subtract_table
from abbe.service.identification.solve import Solved, helix_misfit
from abbe.service.push.operations import VerificationResult
from abbe.service.push.validate import drift_reason
from abbe.service.runs.observations import run_data
from abbe.service.sequences.check import paced
from abbe.service.sequences.control import Suspending
from abbe.service.verification.verify import (
    VerificationDecision,
    VerificationFigures,
    check_before,
    decide,
    figure_rows,
    figures,
    pose_figures,
)

NO_NEWER_RUN = "DRIFT: no newer ball-bar run, outside the solution, shows whether the machine has changed since"
VERIFY, SIGN = "verify-after-push-", "sign-check"
PLACES = 12
"""Places that the ball-bar reads before and after a new table comes into force."""


@dataclass(frozen=True)
class Correction:
    """Everything that was solved, pushed and measured. ``bank`` and ``image``: active in the controller at the end.

    ``not_for_tables``: known effects that no table corrects, each with its remedy. ``proposal``: its number in the store.
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


async def correct(context: PushContext, campaign: str | int, before: list[Run], control: LevelStatus | None = None) -> Correction:
    """Correct a machine from a measured identification campaign.

    Parameters
    ----------
    campaign : str or int
        Identification campaign in the store.
    before : list of Run
        Verification runs measured with the present table.
    control : LevelStatus, optional
        Result of an earlier `abbe.service.compensation.gate.check_preconditions`. Default: it is called now.

    Raises
    ------
    TableRefused
        A limit is exceeded, or the tables promise too little: nothing was written.
    TableMismatch
        Runs were measured with another table than the active one, or the controller does not hold the table that was sent.
    StillActive
        An unverified table could not be rolled back yet.
    """
    store, site = context.store, context.site
    control = control or await check_preconditions(context)
    gathered = await gather(context.session.controller, store, site, campaign)
    check_same_table(gathered.base, before)
    check_temperature(site, gathered.runs)
    if context.poses is None:
        figures(before)  # before anything is written: runs that are not a verification are refused now
    made = await make(store, site, gathered, progress=context.progress, agree=lambda promised: check_promise(promised, site.limits))
    return await _push(context, await admit(context, made.number, control), made, before)


async def push(context: PushContext, admission: Admission, before: list[Run]) -> Correction:
    """Push an admitted proposal (`abbe.service.compensation.gate.admit`), then verify as `correct` does.

    ``before``: verification runs measured with the present table.

    Raises
    ------
    TableRefused, TableMismatch, StillActive
        As for `correct`.
    Stopped, Aborted
        A person asked for it; the old table is in force.
    """
    proposed = admission.precheck.proposed
    context.progress(Progress("solve", 0.0, 1.0, None, "again, with the newest run"))
    made = StoredProposal(
        admission.precheck.number, proposed, await solve_again(context.store, context.site, proposed.campaign, proposed.base_tables)
    )
    await context.control.gate()
    return await _push(context, admission, made, before)


async def _push(context: PushContext, admission: Admission, made: StoredProposal, before: list[Run]) -> Correction:
    """Push an admitted proposal and verify it. Any interlock ends the push: an unverified table must not stay in force meanwhile."""
    session, store, proposed, precheck = context.session, context.store, made.proposed, admission.precheck
    site = replace(context.site, watching=replace(context.site.watching, suspending=Suspending()))
    context = replace(context, site=site)
    check_same_table(precheck.base, before)
    evidence = proposed.candidate.evidence
    newest_s = evidence.ended_s if evidence.last_s is None else evidence.last_s
    check_before_runs(site, precheck.base, before, newest_s, context.clock.utc().timestamp())
    old = _figures(context, made.solved, before)
    check_before(old)
    misfit_mm = _misfit_mm(made.solved, before, precheck.base.tables)
    bar = None
    if context.poses is None and session.ballbar is not None and session.fixture is not None:
        number = sum(c.name.startswith(SIGN) for c in await asyncio.to_thread(store.campaigns.all)) + 1
        bar = BarPlaces(session, store, site, context.progress, f"{SIGN} {number}", PLACES, context.control)
    p, lsb_nm = proposed.predicted, proposed.candidate.lsb_nm
    doc = {"kind": "nine one-axis tables", "predicted_rms_um": p.after_mm * 1e3, "u_model_um": p.u_model_mm * 1e3, "proposal": made.number}
    work = _PushQuestions(context, admission, misfit_mm, bar, old, made.solved)
    wanted = WantedTable(proposed.tables, precheck.base, lsb_nm, proposed.solution_id, doc, proposed.image_id)
    pushed, after, decision = await _push_and_verify(work, wanted)
    bank = pushed.bank if decision.keep else pushed.previous_bank
    image = await session.controller.read_bank(bank)
    misfit_um = None if misfit_mm is None else misfit_mm * 1e3
    return Correction(
        made.solved, proposed.tables, lsb_nm, p, misfit_um, old, after, pushed, decision, bank, image, proposed.not_for_tables, made.number
    )


def _figures(context: PushContext, solved: Solved, runs: list[Run]) -> VerificationFigures:
    room_c = context.site.room_c
    return figures(runs, room_c) if context.poses is None else pose_figures(runs, solved.joint, room_c)


def _misfit_mm(solved: Solved, before: list[Run], table: NineTables | None) -> float | None:
    """Return the rms residual of the solution in a newer helix or pose, mm; None if neither was measured."""
    helix = next((r for r in before if r.test == "ballbar_helix"), None)
    if helix is not None:
        return helix_misfit(solved, _as_other_runs(helix, solved, table))
    poses = [pose_figure(run_data(r), solved.joint, with_machine=True).value_mm for r in before if r.is_artefact]
    return max(poses, default=None)


def _as_other_runs(run: Run, solved: Solved, table: NineTables | None) -> Run:
    """Prepare a run like the solved runs: subtract what the table in force does beyond its smooth corrections."""
    if table is None:
        return run
    lost = np.array([v for v, _ in solved.joint.backlash_mm().values()])
    return subtract_table([run], removed_table(table, lost))[0]


@dataclass
class _PushQuestions:
    """Answers the push machine's questions on one proposal: the reasons against it, and the results of sign probe and verification."""

    context: PushContext
    admission: Admission
    drift_mm: float | None
    """Rms residual of the solution in a newer run, which the solution did not use, mm; None without such a run."""
    bar: BarPlaces | None
    before: VerificationFigures
    solved: Solved
    read_before: PlaceReadings | None = None
    after: VerificationFigures | None = None
    decision: VerificationDecision | None = None
    verified_as: str = ""
    pushing: Pushing | None = None

    @property
    def precheck(self) -> PushPrecheck:
        """The proposal as it was admitted."""
        return self.admission.precheck

    def drift_reasons(self) -> list[str]:
        """Return one reason if a newer run shows drift, or if there is no newer run; otherwise an empty list."""
        if self.drift_mm is None:
            return [NO_NEWER_RUN]
        return [reason] if (reason := drift_reason(self.drift_mm, self.context.site.limits)) else []

    def reasons(self) -> list[str]:
        """All reasons against the proposal with the present decisions and time."""
        now = self.precheck.renewed(self.context.store, self.context.clock.utc().timestamp())
        return [*now.reasons(self.drift_mm), *([NO_NEWER_RUN] if self.drift_mm is None else [])]

    async def probe(self) -> VerificationResult:
        """Probe sign, axis and unit of this table physically; then clear the bar away: the verification mounts its own."""
        if self.bar is None or self.read_before is None:
            return VerificationResult(True, "no ball-bar run measured this table: the sign rests on the commissioning")
        after = await self.bar.read("after")
        await self.bar.clear_away()
        each = expected_changes(after.places_mm, np.array(self.bar.centre_mm), self.precheck.base.tables, self.precheck.proposed.tables)
        found = probe(each, self.read_before.deviation_mm, after.deviation_mm)
        return VerificationResult(found.agrees, found.text + ("" if all(found.observed) else "; that sign rests on the commissioning"))

    async def verify(self) -> VerificationResult:
        context = self.context
        number = sum(c.name.startswith(VERIFY) for c in await asyncio.to_thread(context.store.campaigns.all)) + 1
        name = f"{VERIFY}{number}"
        plan = paced(context.verification(name), context.site.max_feed_mm_min)
        options = MeasureOptions(control=context.control, part=True)
        await measure(context.session, context.store, context.site, plan, progress=context.progress, options=options)
        self.after = _figures(context, self.solved, (await asyncio.to_thread(from_store, context.store, name)).runs)
        self.decision = decide(self.before, self.after, self.pushing.crc if self.pushing is not None else None)
        self.verified_as = name
        return VerificationResult(self.decision.keep, self.decision.text)


async def _push_and_verify(work: _PushQuestions, wanted: WantedTable) -> tuple[PushResult, VerificationFigures, VerificationDecision]:
    """Push, probe, measure again, keep or roll back. Any interruption rolls the table back."""
    context = work.context
    if drift_reasons := work.drift_reasons():  # before the ball-bar is read
        raise TableRefused.because(drift_reasons)
    questions = Questions(work.reasons, work.precheck.by, work.probe, work.verify, work.precheck.approval(context.clock))
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
        raise TakenBack(f"the table was rolled back: {pushed.why}", "prove sign, axis and unit of the control again: abbe comp commission")
    decision = work.decision if pushed.kept == work.decision.keep else VerificationDecision(pushed.kept, pushed.why)
    try:
        await _store_verification(context, work.verified_as, pushed, work.after, decision)
    except AbbeError as error:  # the decision stands; only its record is missing
        error.add_note(f"the table is {'kept and in force' if decision.keep else 'rolled back'}: {decision.text}")
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
