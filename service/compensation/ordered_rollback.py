"""A rollback that a person orders of the service: `rollback`, with the machine alone, and only of the table that he has seen in force."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.compensation.deferred_rollback import LIMIT_S, finish_when_safe
from abbe.service.compensation.rollback import Ordered, rollback
from abbe.service.devices.machine_lock import lock_machine
from abbe.service.devices.session import DeviceUrls, open_session
from abbe.service.domain.job_state import JobOutcome
from abbe.service.errors import AbbeError, MachineInUse, StillActive, TableMismatch, TableRefused
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import STOPPED, JournalView


@dataclass(frozen=True, slots=True)
class BackOrder:
    """What is ordered: the table of push ``push``, in force with ``crc``, goes; the one before comes."""

    push: int
    crc: int
    ordered: Ordered


async def ordered_rollback(site: Site, store: Store, order: BackOrder, *, clock: Clock) -> JobOutcome:
    """Take the table back. What is returned is what was heard; which table is in force says the journal (`JournalView.of_order`).

    A refusal is an outcome, not an error: another process has the machine, the controller holds what the journal does not know, or the
    journal moved on since the order was given.
    """
    try:
        with lock_machine(site.urls.cnc):
            async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
                return await _heard(session.controller, store, site, order, clock)
    except MachineInUse as busy:
        return JobOutcome("refused", f"{busy}; nothing was written")
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome("failed", _told(error))


async def _heard(controller: TableController, store: Store, site: Site, order: BackOrder, clock: Clock) -> JobOutcome:
    control = order.ordered.control
    try:
        await asyncio.to_thread(check_unchanged, store, site.name, order, site.control)
        back = await rollback(controller, store, site, ordered=order.ordered)
    except (TableRefused, TableMismatch) as no:
        return JobOutcome("refused", _told(no))
    except StillActive as open_:
        return await _finished(controller, store, site, order, open_, clock)
    except MachineInUse:
        raise
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome(STOPPED if control.stopping or control.aborting else "failed", _told(error))
    if back is None:
        return JobOutcome("refused", "the table from before is in force already; nothing was written")
    text = f"push {back.pushed.push_id}: in force again (CRC {back.pushed.crc:08X}): {back.how}"
    return JobOutcome("kept", f"{text}; the machine is unverified now: run a quick check")


def check_unchanged(store: Store, machine: str, order: BackOrder, control: str = "") -> None:
    """Refuse an order that was given in view of another table than the one in force by the journal now.

    Raises
    ------
    TableRefused
        It was, or nothing can be taken back any more.
    """
    now = JournalView.read(store, machine, control).offer()
    if (now.push, now.crc) != (order.push, order.crc):
        raise TableRefused(
            f"the table in force is {now.crc:08X} of push {now.push}, ordered back was {order.crc:08X} of push {order.push}",
            "look at the table in force again; nothing was written",
        )


async def _finished(
    controller: TableController, store: Store, site: Site, order: BackOrder, error: StillActive, clock: Clock
) -> JobOutcome:
    """The rollback broke off, and the way back from it is not open now: go it as soon as it is."""
    finish = finish_when_safe(controller, store, site, limit_s=LIMIT_S, clock=clock, say=lambda _: None)
    try:
        done = await order.ordered.control.unless_stopped(finish)
    except (AbbeError, DriverError, OSError) as again:
        return JobOutcome("failed", f"{_told(error)}; {_told(again)}; it is taken back before the next check")
    return JobOutcome("rolled back", f"{_told(error)}; {done or 'nothing was left to take back'}")


def _told(error: BaseException) -> str:
    return "; ".join([str(error), *getattr(error, "__notes__", [])])
