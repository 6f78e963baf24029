"""The service pushes an approved proposal unattended, where the machine file allows it, through the same gate as any push.

An unattended push needs a control proved to level 3, a valid approval (even where two people are not demanded), enough time since the
last push, and tables close enough to those of 30 days ago. Each push first measures its own verification.
"""

from __future__ import annotations

from abbe.drivers.errors import DriverError
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.clock import Clock
from abbe.service.compensation.approved import PushOrder
from abbe.service.compensation.correct import push
from abbe.service.compensation.gate import PushContext, admit
from abbe.service.compensation.proposals import load_runs
from abbe.service.compensation.recover import finish_when_safe, recovered_session, with_notes
from abbe.service.devices.session import lock_machine
from abbe.service.domain.progress import JobOutcome
from abbe.service.domain.run import Run
from abbe.service.errors import AbbeError, MachineInUse, StillActive, TableRefused, TakenBack
from abbe.service.sequences.check import paced
from abbe.service.sequences.control import State
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import STOPPED

WAIT_S = 600.0
"""How long to wait for a machine on which the rollback is blocked; then the service reports it and retries."""


async def push_approved(site: Site, store: Store, order: PushOrder, *, clock: Clock, rate_hz: int = 100) -> JobOutcome:
    """Verify with the table in force, push, probe, verify again; keep or roll back. A refusal is an outcome, not an error.

    The outcome reports this attempt; the journal decides which table is in force (`JournalView.of_proposal`).

    Raises
    ------
    MachineInUse
        Another process has the machine: nothing was begun, so this is no attempt.
    """
    with lock_machine(site.urls.cnc):
        try:
            async with recovered_session(store, site) as session:
                await order.begun()
                context = PushContext(session, store, site, order.progress, clock, rate_hz, attended=False, control=order.control)
                return await _attempt(context, order)
        except MachineInUse:
            raise
        except (AbbeError, DriverError, OSError) as error:  # the devices failed before the push began
            await order.begun()
            return JobOutcome("failed", with_notes(error))


async def _attempt(context: PushContext, order: PushOrder) -> JobOutcome:
    try:
        return await _pushed(context, order)
    except TakenBack as back:
        return JobOutcome("rolled back", with_notes(back))
    except TableRefused as no:
        return JobOutcome("refused", with_notes(no))
    except StillActive as open_:
        return await _finish_when_safe(context, order, open_)
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome(STOPPED if order.control.stopping or order.control.aborting else "failed", with_notes(error))


async def _pushed(context: PushContext, order: PushOrder) -> JobOutcome:
    context.control.now(State.RUNNING)
    admission = await admit(context, order.proposal)  # before anything is measured for it
    done = await push(context, admission, await _verify_before(context, order))
    return JobOutcome("kept" if done.decision.keep else "rolled back", f"push {done.pushed.push_id}: {done.decision.text}")


async def _verify_before(context: PushContext, order: PushOrder) -> list[Run]:
    site = context.site
    name = f"verify-before proposal {order.proposal} {context.clock.utc():%Y-%m-%d %H:%M:%S}"
    plan = paced(verification(site.machine, rate_hz=context.rate_hz, name=name), site.max_feed_mm_min)
    options = MeasureOptions(control=order.control, part=True)
    ids = await measure(context.session, context.store, site, plan, progress=order.progress, clock=context.clock, options=options)
    return await load_runs(context.store, ids)


async def _finish_when_safe(context: PushContext, order: PushOrder, error: StillActive) -> JobOutcome:
    """Wait until the old table is in force again. A stop does not end the wait; after an abort the service resumes it later."""
    messages: list[str] = []
    finish = finish_when_safe(
        context.session.controller, context.store, context.site, limit_s=WAIT_S, clock=context.clock, notify=messages.append
    )
    try:
        done = await order.control.unless_aborted(finish)
    except (AbbeError, DriverError, OSError) as again:
        return JobOutcome("failed", f"{with_notes(error)}; {with_notes(again)}; the table will be rolled back as soon as possible")
    return JobOutcome("rolled back", f"{with_notes(error)}; {done or 'nothing was left to roll back'}")
