"""The service's own work for an alarm: measure the full campaign, solve, search for the effect, propose. It never approves or writes.

Each step becomes a line of the alarm before the next begins, so that an interrupted investigation resumes after its last line. Reasons
against tables - an effect that no table corrects, an unknown cause, too small a gain - end it with a text, not with an error.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace

from abbe.models.compensation.tables import Predicted
from abbe.service.campaign_data.campaign_folder import from_store
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.capture.live import LiveFeed
from abbe.service.clock import Clock
from abbe.service.compensation.gate import check_promise
from abbe.service.compensation.proposal_diff import compare, largest
from abbe.service.compensation.proposals import StoredProposal, check_temperature, gather, make
from abbe.service.compensation.recover import recovered_session
from abbe.service.devices.session import DeviceUrls, lock_machine
from abbe.service.discovery.changed_since import reference_solution
from abbe.service.discovery.changed_text import changed_text, drift_text
from abbe.service.discovery.discover import discover, prepare, search
from abbe.service.discovery.discovery_states import entering
from abbe.service.discovery.discovery_store import journal_of
from abbe.service.discovery.discovery_text import size_text, verdict_of
from abbe.service.domain.finding import Finding
from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.effects.effect_catalogue import catalogue
from abbe.service.effects.model_book import REMEDIES, current
from abbe.service.errors import AbbeError, CampaignRefused, NotObservable, Stopped, TableMismatch, TableRefused
from abbe.service.identification.removal import campaign_table
from abbe.service.sequences.check import paced
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.verification.alarm_states import TRIES, Alarm, Note, next_step

BESIDE = 0.5
"""Largest ratio of the unexplained readings to the gain that tables promise; above it, a remedy other than tables comes first."""
REFUSALS = (TableRefused, TableMismatch, CampaignRefused, NotObservable)
"""Errors that end an investigation with an answer: they become the alarm's text, because another try would end in the same way."""


@dataclass(frozen=True)
class InvestigationContext:
    """Context of an investigation. ``plan``: the full campaign, renamed for each try; ``live``: gets the samples of its paths."""

    site: Site
    store: Store
    plan: CampaignPlan
    clock: Clock
    progress: ProgressSink
    control: Control = field(default_factory=Control)
    """Pauses and stops the investigation."""
    live: LiveFeed | None = None


Step = Callable[[InvestigationContext, Alarm, Note], Awaitable[Alarm]]
"""``await step(context, alarm, note)``: does one step; returns the alarm with its lines."""


async def investigate(context: InvestigationContext, alarm: Alarm, note: Note, measured: Step | None = None) -> None:
    """Take an alarm as far as possible: to a proposal that waits for approval, or to the reason why there is none.

    ``measured``: measures the campaign in place of the unattended measurement.

    Raises
    ------
    MachineInUse
        Another process has the machine: no line was written, and the try does not count.
    Stopped, Aborted
        A person asked for it.
    AbbeError, DriverError, OSError, ArithmeticError, ValueError
        A device or the measurement failed. Written lines stay; the next call resumes after them.
    """
    context.control.now(State.RUNNING)
    try:
        while (step := next_step(alarm)) is not None:
            await context.control.gate()
            do = measured if measured is not None and step is AlarmKind.MEASURED else _STEPS[step]
            alarm = await do(context, alarm, note)
    except REFUSALS as no:
        await note(AlarmKind.ENDED, AlarmFacts(text=f"no proposal: {no}", code=no.code))


async def _measured(context: InvestigationContext, alarm: Alarm, note: Note) -> Alarm:
    tries = sum(s.kind is AlarmKind.BEGUN for s in alarm.work) + 1
    if tries > TRIES:
        return await note(AlarmKind.ENDED, AlarmFacts(text=f"no proposal: {TRIES} tries to measure the full campaign were not completed"))
    again = "" if tries == 1 else " again: the last try was not completed"
    plan = plan_for(context, alarm)
    site, options = context.site, MeasureOptions(control=context.control, part=True, live=context.live)
    with lock_machine(site.urls.cnc):
        async with recovered_session(context.store, site) as session:
            # Only now: while another process has the machine, this try has not begun.
            await note(AlarmKind.BEGUN, AlarmFacts(text=f"measuring campaign {plan.name!r}{again}", campaign=plan.name))
            plan = paced(plan, site.max_feed_mm_min)
            ids = await measure(session, context.store, site, plan, progress=context.progress, clock=context.clock, options=options)
    return await note(AlarmKind.MEASURED, AlarmFacts(text=f"campaign {plan.name!r} is measured: {len(ids)} runs", campaign=plan.name))


def plan_for(context: InvestigationContext, alarm: Alarm) -> CampaignPlan:
    """Return the full campaign of an alarm, with a new name."""
    return replace(context.plan, name=f"alarm {alarm.number} {context.clock.utc():%Y-%m-%d %H:%M:%S}")


async def _discovered(context: InvestigationContext, alarm: Alarm, note: Note) -> Alarm:
    stopped = threading.Event()

    def report(progress: Progress) -> None:
        if stopped.is_set() or context.control.stopping:
            raise Stopped("the search was stopped", "Abbe will start the search again")
        context.progress(progress)

    try:
        number, finding = await asyncio.to_thread(_search, replace(context, progress=report), _campaign(alarm))
    except asyncio.CancelledError:
        stopped.set()  # the thread ends at its next report: a service that stops does not wait for the rest of the search
        raise
    _, word, text = verdict_of(finding)
    names = ", ".join(f"{e.full_title} {size_text(e)}" for e in finding.effects)
    changes = changed_text(finding.changed)
    said = "; ".join(t for t in (f"{word}: {names}" if names else f"{word}: {text}", changes) if t)
    objections = _objections(finding, context.store, context.site.name)
    return await note(AlarmKind.DISCOVERED, replace(objections, text=said, discovery=number))


def _search(context: InvestigationContext, campaign: str) -> tuple[int | None, Finding]:
    store = context.store
    measured = from_store(store, campaign)
    book, since = current(store, context.site.name), reference_solution(store, measured)
    job = prepare(measured, catalogue(), book, table=campaign_table(store, measured), since=since)
    journal = journal_of(store, job)
    return journal.id, discover(job, journal, search, context.progress)


def _objections(finding: Finding, store: Store, machine: str) -> AlarmFacts:
    """Return the objections to tables.

    ``against``: the objections as text, empty if there are none. ``rms_um``: rms of what the model leaves of the readings beyond noise.
    ``unnamed``: whether something is missing and no effect was found for it. An effect that no table corrects is an objection unless the
    machine's model contains it: effects of the model are subtracted from the readings before tables are made.
    """
    gap = finding.gaps.get("identify")
    rms_um = 0.0 if gap is None else math.sqrt(max(gap.before_um**2 - gap.floor_um**2, 0.0))
    model = current(store, machine)
    known = {e.label for e in model.book.effects} if model is not None else set()
    wrong = [e for e in entering(finding) if e.remedy != "table" and e.label not in known]
    why = [f"{e.full_title} is a matter for {REMEDIES[e.remedy]}: {e.remedy_text}" for e in wrong]
    if finding.verdict == "unknown":
        why.append("the model lacks an effect that is not in the catalogue, and a table would hide it")
    unnamed = finding.verdict == "unknown" and not finding.effects
    return AlarmFacts(against="; ".join(why), rms_um=rms_um, unnamed=unnamed)


async def _proposed(context: InvestigationContext, alarm: Alarm, note: Note) -> Alarm:
    known = alarm.last(AlarmKind.DISCOVERED)
    assert known is not None
    facts = known.facts
    if facts.unnamed:
        return await note(AlarmKind.ENDED, AlarmFacts(text=f"no proposal: {facts.against} ({facts.text})"))

    def agree(promised: Predicted) -> None:
        check_promise(promised, context.site.limits)
        check_cause(promised, facts.against, facts.rms_um)

    ordered = alarm.last(AlarmKind.ORDERED)
    made = await make_proposal(context, _campaign(alarm), agree, "" if ordered is None else ordered.facts.name)
    if made.proposed.reasons:
        text = f"proposal {made.number} cannot be approved: {'; '.join(made.proposed.reasons)}"
        return await note(AlarmKind.ENDED, AlarmFacts(proposal=made.number, text=text))
    text = await asyncio.to_thread(promise_text, context.store, made)
    return await note(AlarmKind.PROPOSED, AlarmFacts(proposal=made.number, text=text, against=facts.against))


async def make_proposal(context: InvestigationContext, campaign: str, agree: Callable[[Predicted], None], by: str = "") -> StoredProposal:
    """Solve a measured campaign and store the result as a proposal, based on the controller's table in force.

    ``agree``, ``by`` and the errors: as in `proposals.make`; a device can also fail.
    """
    site, store = context.site, context.store
    with lock_machine(site.urls.cnc):
        async with recovered_session(store, site, DeviceUrls(site.urls.cnc)) as session:
            gathered = await gather(session.controller, store, site, campaign)
            check_temperature(site, gathered.runs)
            return await make(store, site, gathered, clock=context.clock, progress=context.progress, agree=agree, by=by)


def check_cause(promised: Predicted, against: str, rms_um: float) -> None:
    """Refuse tables if there is an objection ``against`` them and the unexplained ``rms_um`` is not small beside the gain that they
    promise.

    Raises
    ------
    TableRefused
        ``rms_um`` exceeds `BESIDE` times the promised gain.
    """
    gain_um = (promised.before_mm - promised.after_mm) * 1e3
    if against and rms_um > BESIDE * gain_um:
        raise TableRefused(f"tables may not reach {rms_um:.1f} µm rms of the readings; the promised gain is only {gain_um:.1f} µm", against)


def promise_text(store: Store, made: StoredProposal) -> str:
    """Return a proposal as a sentence: its promise with U (k = 2), its largest change, and errors that are not in the tables."""
    p = made.proposed.predicted
    gain, expanded = (p.before_mm - p.after_mm) * 1e3, 2e3 * p.u_model_mm
    left_out = "".join(f"; not in the tables: {line}" for line in made.proposed.not_for_tables)
    return (
        f"proposal {made.number} waits for approval: {p.before_mm * 1e3:.1f} → {p.after_mm * 1e3:.1f} µm rms, better by "
        f"{gain:.1f} ± {expanded:.1f} µm (U, k = 2); {largest(compare(store, made.number, 'ACTIVE'))}{drift_text(store, made)}{left_out}"
    )


def _campaign(alarm: Alarm) -> str:
    measured = alarm.last(AlarmKind.MEASURED)
    if measured is None:
        raise AbbeError(f"alarm {alarm.number} has no measured campaign")
    return measured.facts.campaign


_STEPS: dict[AlarmKind, Step] = {
    AlarmKind.MEASURED: _measured,
    AlarmKind.DISCOVERED: _discovered,
    AlarmKind.PROPOSED: _proposed,
}
