"""The guided full campaign: it leads a person through its set-ups, measures, solves, proposes.

It never approves, and writes a table only to roll back an interrupted push.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace

import structlog

from abbe.models.compensation.tables import Predicted
from abbe.service.campaigns.device_checks import check_devices, needed_by
from abbe.service.campaigns.measure import MeasureOptions, artefacts_of, measure, start_campaign
from abbe.service.campaigns.resume import resume as resume_campaign
from abbe.service.compensation.gate import check_promise
from abbe.service.compensation.recover import recovered_session
from abbe.service.devices.session import Session, lock_machine
from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.service_records import AlarmFacts, AlarmKind
from abbe.service.errors import PreconditionsChanged, TableMismatch, TableRefused
from abbe.service.jobs.interrupted import interrupted_campaign
from abbe.service.jobs.investigate import REFUSALS, InvestigationContext, investigate, make_proposal, plan_for, promise_text
from abbe.service.sequences.check import paced
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.recipes.campaigns import RecipeSource
from abbe.service.site import certificates, check_certificates
from abbe.service.tables.nine_tables import read_base
from abbe.service.verification.alarm_states import Alarm, Note

log = structlog.get_logger("abbe.campaign")
SOLVING = "the measurement is complete, and nothing moves while it is solved"


async def run_guided_campaign(context: InvestigationContext, source: RecipeSource, by: str, *, resumes: bool = False) -> JobOutcome:
    """Measure the plan as a campaign with the plan's name, solve it and propose tables.

    A person mounts the instruments, as ``context.control.prompts`` asks.

    Parameters
    ----------
    source : RecipeSource
        Source of the plan, stored for a resumption.
    by : str
        The proposer: where two people are required, another person has to approve.
    resumes : bool
        The campaign was interrupted: its complete runs are kept, and every set-up that is left is mounted anew.

    Raises
    ------
    Stopped, Aborted
        A person asked for it. Completed runs are kept; a note says how to resume.
    PreconditionsChanged
        The campaign cannot be resumed: plan, machine file, table or control is another than at its beginning; nothing was measured.
    TableMismatch
        The table in force is switched off or unreadable; nothing was measured.
    AbbeError, DriverError, OSError, ArithmeticError, ValueError
        A device or the measurement failed; completed runs are kept.
    """
    name = context.plan.name
    context.control.now(State.RUNNING)
    await context.control.gate()
    if resumes:
        await _check_interrupted(context, source, name, alarm=0)
    try:
        check_certificates(context.site)
        _check_not_ended(context)
    except REFUSALS as no:
        return JobOutcome("ended", f"no proposal: {no}")
    await _measured(context, source, resumes=resumes)
    try:
        return await _proposed(context, by)
    except REFUSALS as no:
        return JobOutcome("ended", f"no proposal: {no}; campaign {name!r} is kept; `abbe solve` shows its result")
    except BaseException as error:
        error.add_note(f"campaign {name!r} is measured: `abbe comp propose -m MACHINE.toml {name!r}` solves it and proposes")
        raise


async def investigate_guided(context: InvestigationContext, source: RecipeSource, alarm: Alarm, note: Note, *, resume: str = "") -> None:
    """Look for the cause of an alarm as `investigate` does, with a person who mounts the instruments.

    ``resume``: the alarm's interrupted campaign, if its complete runs are kept. Raises what `investigate` and `run_guided_campaign` raise.
    """

    async def measured(context: InvestigationContext, alarm: Alarm, note: Note) -> Alarm:
        check_certificates(context.site)
        _check_not_ended(context)
        led = replace(context, plan=replace(context.plan, name=resume) if resume else plan_for(context, alarm))
        name = led.plan.name

        async def begun() -> None:
            await note(AlarmKind.BEGUN, AlarmFacts(text=f"{'resuming' if resume else 'measuring'} campaign {name!r}", campaign=name))

        ids = await _measured(led, source, begun, resumes=bool(resume))
        return await note(AlarmKind.MEASURED, AlarmFacts(text=f"campaign {name!r} is measured: {len(ids)} runs", campaign=name))

    if resume:
        await _check_interrupted(context, source, resume, alarm.number)
    await investigate(context, alarm, note, measured)


async def _measured(
    context: InvestigationContext, source: RecipeSource, begins: Callable[[], Awaitable[None]] | None = None, *, resumes: bool = False
) -> list[int]:
    """Measure the plan, or what is left of it; return the numbers of its runs.

    ``begins`` is called before anything moves, once the devices are checked.
    """
    site, store, name = context.site, context.store, context.plan.name
    plan = paced(context.plan, site.max_feed_mm_min)
    prompted = _PromptedPerson(context.control)
    options = MeasureOptions(control=context.control, source=source, part=True, live=context.live)
    with lock_machine(site.urls.cnc):
        async with recovered_session(store, site, ask=prompted.ask) as session:
            prompted.session = session
            await check_devices(session, plan, air=site.watching.air_c is not None)
            await context.control.gate()
            await _check_table_acts(session)
            found = await resume_campaign(session, store, site, plan, name, None) if resumes else None
            if found is not None:
                log.info("campaign resumed", campaign=name, found=found.messages)
            if begins is not None:
                await begins()
            begun = await start_campaign(session, store, site, name, artefacts_of(plan)) if found is None else found.campaign
            options = replace(options, resumed=found)
            try:
                return await measure(
                    session, store, site, plan, progress=context.progress, clock=context.clock, campaign=begun, options=options
                )
            except BaseException as error:
                # The screen does not offer recipe files.
                on_page = "; the screen of a new measurement resumes it" if source.text is None else ""
                kept = f"completed runs of campaign {name!r} are kept{on_page}"
                typed = f"`abbe measure -m MACHINE.toml --resume {name!r}` resumes, then `abbe comp propose -m MACHINE.toml {name!r}`"
                error.add_note(f"{kept}; {typed}")
                raise


async def _check_interrupted(context: InvestigationContext, source: RecipeSource, name: str, alarm: int) -> None:
    """Refuse to resume a campaign that is complete, is not the last one of its recipe, or belongs to another alarm."""
    found = await asyncio.to_thread(interrupted_campaign, context.store, context.site.name, source.recipe)
    if found is None or found.name != name:
        raise PreconditionsChanged(f"campaign {name!r} is complete, or is not the last one of its recipe", "start a new campaign")
    if found.alarm != alarm:
        whose = f"looks for the cause of alarm {found.alarm}" if found.alarm else f"does not look for the cause of alarm {alarm} any more"
        raise PreconditionsChanged(f"campaign {name!r} {whose}", "start again on the screen of a new measurement")


async def _proposed(context: InvestigationContext, by: str) -> JobOutcome:
    await context.control.gate()
    context.control.no_pause_reason = SOLVING

    def agree(promised: Predicted) -> None:
        context.control.check()
        check_promise(promised, context.site.limits)

    made = await make_proposal(context, context.plan.name, agree, by)
    solution, against = made.proposed.solution_id, made.proposed.reasons
    if against:
        return JobOutcome("ended", f"proposal {made.number} cannot be approved: {'; '.join(against)}", solution, made.number)
    return JobOutcome("proposed", await asyncio.to_thread(promise_text, context.store, made), solution, made.number)


def _check_not_ended(context: InvestigationContext) -> None:
    """Refuse the campaign if a certificate has ended: no table could follow from it."""
    ended = certificates(context.site, context.clock.utc().date(), needed_by(context.plan).first)
    if ended:
        raise TableRefused("; ".join(ended), "have the instrument calibrated, then start again; nothing was measured")


async def _check_table_acts(session: Session) -> None:
    """Refuse to measure if the table in force is switched off: no proposal could follow from the runs."""
    base = await read_base(session.controller)
    status = await session.controller.status()
    if base.tables is not None and not status.compensation_on:
        why = f"table {base.crc:08X} has no effect: the compensation is switched off"
        raise TableMismatch(why, "switch the compensation on at the control and start again; nothing was measured")


class _PromptedPerson:
    """Shows the fixture's prompts on the page, with the spindle's position, and waits for a person; a stop ends the wait."""

    def __init__(self, control: Control) -> None:
        self._control = control
        self.session: Session | None = None

    async def ask(self, text: str) -> None:
        if self.session is not None:
            x, y, z = (await self.session.controller.status()).position_mm
            text = f"Spindle at X {x:.1f} mm Y {y:.1f} mm Z {z:.1f} mm. {text}"
        await self._control.unless_stopped(self._control.prompts.ask(text))


def named_for(context: InvestigationContext, recipe: str, resume: str = "") -> InvestigationContext:
    """Return the context with its plan renamed to ``resume``; if that is empty, to recipe, machine and present time."""
    name = resume or f"{recipe} {context.site.name} {context.clock.utc():%Y-%m-%d %H:%M:%S}"
    return replace(context, plan=replace(context.plan, name=name))
