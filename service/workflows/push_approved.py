"""A proposal that a person approved, pushed by the service where the machine file says so: the same one door, and nobody attends.

Nobody attends means: the control was proved to level 3, the approval of a person holds (also where no second one is demanded), the last
push is long enough ago, and the table has not walked away. The verification before is measured now.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from drivers.errors import DriverError
from service.clock import Clock
from service.devices.alone import alone
from service.devices.session import Session, open_session
from service.errors import AbbeError, StillActive, StoreError, TableRefused, TakenBack
from service.events import ProgressSink
from service.sequences.campaigns import verification
from service.sequences.check import paced
from service.site import Site
from service.storage.records import AlarmEntryRecord
from service.storage.store import Store
from service.workflows.alarm_states import NO_ALARM, Kind
from service.workflows.commission import check_commissioned
from service.workflows.correct import push
from service.workflows.measure import measure
from service.workflows.pending import finish_when_safe
from service.workflows.proposal_checks import hold
from service.workflows.proposal_doc import load
from service.workflows.proposal_states import standing
from service.workflows.proposals import load_runs
from service.workflows.proved_levels import check_level
from service.workflows.recover import recover

WAIT_S = 600.0
"""So long a machine that does not let the old table back at once is watched; after that the next check takes it back first."""


@dataclass(frozen=True, slots=True)
class Approved:
    """A proposal that waits for the service: its number, the approval that holds, and the alarm that asked for it (0: none)."""

    proposal: int
    approval: int
    alarm: int


@dataclass(frozen=True, slots=True)
class Outcome:
    """How it ended: ``kept``, ``rolled back``, ``refused`` (nothing was written) or ``failed``, and the sentence to it."""

    word: str
    text: str


def next_approved(store: Store, machine: str, entries: Sequence[AlarmEntryRecord], now_s: float) -> Approved | None:
    """The proposal that was approved last, if the service has not tried it yet with this approval; None: nothing waits.

    Older ones that are approved as well are not tried in its place: whoever approved the last one wanted that.
    """
    tried = {e.doc.get("approval") for e in entries if e.kind == Kind.PUSHING}
    asked = {e.doc.get("proposal"): e.alarm for e in entries if e.kind == Kind.PROPOSED}
    given = [(rows[-1].id, record.id) for record in store.proposals(machine) if (rows := store.approvals(record.id))]
    if not given:
        return None
    approval, number = max(given)
    try:
        word = standing(store, number, load(store, number), now_s).word
    except StoreError:  # a row that was changed: it is told where it is looked at, and never pushed
        return None
    if word == "approved" and approval not in tried:
        return Approved(number, approval, asked.get(number, NO_ALARM))
    return None


async def push_approved(site: Site, store: Store, number: int, *, clock: Clock, progress: ProgressSink, rate_hz: int = 100) -> Outcome:
    """Verify with the table in force, push, prove, verify again; keep or go back. A refusal is an outcome, not an error."""
    with alone(site.urls.cnc):
        async with open_session(site.urls) as session:
            try:
                return await _pushed(session, site, store, number, clock, progress, rate_hz)
            except TakenBack as back:
                return Outcome("rolled back", _told(back))
            except TableRefused as no:
                return Outcome("refused", _told(no))
            except StillActive as open_:
                return await _back(session, site, store, open_, clock)
            except (AbbeError, DriverError, OSError) as error:
                return Outcome("failed", _told(error))


async def _pushed(session: Session, site: Site, store: Store, number: int, clock: Clock, progress: ProgressSink, rate_hz: int) -> Outcome:
    await recover(session.controller, store, site)
    await check_commissioned(session.controller, store, site)
    await check_level(session.controller, store, site, attended=False)
    proposed = await asyncio.to_thread(load, store, number)
    against = (await hold(session.controller, store, site, number, proposed, clock, attended=False)).reasons()
    if against:
        raise TableRefused("; ".join(against), "nothing was written")
    before = await _before(session, site, store, number, clock, progress, rate_hz)
    done = await push(session, store, site, number, before, rate_hz=rate_hz, progress=progress, clock=clock, attended=False)
    return Outcome("kept" if done.decision.keep else "rolled back", f"push {done.pushed.push_id}: {done.decision.text}")


async def _before(
    session: Session, site: Site, store: Store, number: int, clock: Clock, progress: ProgressSink, rate_hz: int
) -> list[dict[str, Any]]:
    name = f"verify-before proposal {number} {clock.utc():%Y-%m-%d %H:%M:%S}"
    plan = paced(verification(site.machine, rate_hz=rate_hz, name=name), site.max_feed_mm_min)
    return await load_runs(store, await measure(session, store, site, plan, progress=progress, clock=clock))


async def _back(session: Session, site: Site, store: Store, error: StillActive, clock: Clock) -> Outcome:
    said: list[str] = []
    try:
        done = await finish_when_safe(session.controller, store, site, limit_s=WAIT_S, clock=clock, say=said.append)
    except (AbbeError, DriverError, OSError) as again:
        return Outcome("failed", f"{_told(error)}; {_told(again)}; it is taken back before the next check")
    return Outcome("rolled back", f"{_told(error)}; {done or 'nothing was left to take back'}")


def _told(error: BaseException) -> str:
    return "; ".join([str(error), *getattr(error, "__notes__", [])])
