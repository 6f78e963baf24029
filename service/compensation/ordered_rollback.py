"""A rollback that a person orders from the service. It locks the machine and touches only the table that the person saw in force."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass

from abbe.drivers.api import TableController
from abbe.drivers.errors import DriverError
from abbe.service.clock import Clock
from abbe.service.compensation.deferred_rollback import LIMIT_S, finish_when_safe
from abbe.service.compensation.rollback import RollbackRequest, rollback
from abbe.service.devices.machine_lock import lock_machine
from abbe.service.devices.session import DeviceUrls, open_session
from abbe.service.domain.job_state import JobOutcome
from abbe.service.errors import AbbeError, MachineInUse, StillActive, TableMismatch, TableRefused
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.push_journal import STOPPED, JournalView


@dataclass(frozen=True, slots=True)
class RollbackOrder:
    """The order: replace the table of push ``push``, in force with ``crc``, by the table before it."""

    push: int
    crc: int
    request: RollbackRequest


async def ordered_rollback(site: Site, store: Store, order: RollbackOrder, *, clock: Clock) -> JobOutcome:
    """Roll back. The outcome reports this attempt; the journal decides which table is in force (`JournalView.of_order`).

    A refusal is an outcome, not an error: another process has the machine, the controller holds a table unknown to the journal, or the
    journal moved on after the order was given.
    """
    try:
        with lock_machine(site.urls.cnc):
            async with open_session(DeviceUrls(cnc=site.urls.cnc)) as session:
                return await _attempt(session.controller, store, site, order, clock)
    except MachineInUse as busy:
        return JobOutcome("refused", f"{busy}; nothing was written")
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome("failed", _with_notes(error))


async def _attempt(controller: TableController, store: Store, site: Site, order: RollbackOrder, clock: Clock) -> JobOutcome:
    control = order.request.control
    try:
        await asyncio.to_thread(check_unchanged, store, site.name, order, site.control)
        back = await rollback(controller, store, site, request=order.request)
    except (TableRefused, TableMismatch) as no:
        return JobOutcome("refused", _with_notes(no))
    except StillActive as open_:
        return await _finish_when_safe(controller, store, site, order, open_, clock)
    except MachineInUse:
        raise
    except (AbbeError, DriverError, OSError) as error:
        return JobOutcome(STOPPED if control.stopping or control.aborting else "failed", _with_notes(error))
    if back is None:
        return JobOutcome("refused", "the table from before is in force already; nothing was written")
    text = f"push {back.pushed.push_id}: in force again (CRC {back.pushed.crc:08X}): {back.how}"
    return JobOutcome("kept", f"{text}; the machine is unverified now: run a quick check")


def check_unchanged(store: Store, machine: str, order: RollbackOrder, control: str = "") -> None:
    """Refuse an order that was given for another table than the one that the journal has in force now.

    Raises
    ------
    TableRefused
        The tables differ, or there is nothing left to roll back.
    """
    now = JournalView.read(store, machine, control).offer()
    if (now.push, now.crc) != (order.push, order.crc):
        raise TableRefused(
            f"the table in force is {now.crc:08X} of push {now.push}, ordered back was {order.crc:08X} of push {order.push}",
            "look at the table in force again; nothing was written",
        )


async def _finish_when_safe(
    controller: TableController, store: Store, site: Site, order: RollbackOrder, error: StillActive, clock: Clock
) -> JobOutcome:
    """The rollback broke off and the machine is not safe: finish it as soon as it is."""
    finish = finish_when_safe(controller, store, site, limit_s=LIMIT_S, clock=clock, notify=lambda _: None)
    try:
        done = await order.request.control.unless_stopped(finish)
    except (AbbeError, DriverError, OSError) as again:
        return JobOutcome("failed", f"{_with_notes(error)}; {_with_notes(again)}; the rollback runs before the next check")
    return JobOutcome("rolled back", f"{_with_notes(error)}; {done or 'nothing was left to roll back'}")


def _with_notes(error: BaseException) -> str:
    return "; ".join([str(error), *getattr(error, "__notes__", [])])
