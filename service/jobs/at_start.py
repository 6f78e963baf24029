"""Recovery before the first check, and whenever a push was left open: close interrupted runs, finish an open push."""

from __future__ import annotations

import asyncio

from abbe.service.capture.recovery import recover_segments
from abbe.service.compensation.recover import recovered_session
from abbe.service.devices.machine_lock import lock_machine
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.site import Site
from abbe.service.storage.store import Store


async def recover_at_start(store: Store, site: Site) -> str | None:
    """Close interrupted runs; finish an open push, the only case that opens the controller. Return what was done; None: nothing was open.

    Raises
    ------
    AbbeError, DriverError
        As `abbe.service.compensation.recover.recover`: the controller cannot be reached, or a person has to look.
    """
    runs = await asyncio.to_thread(recover_segments, store, site.capture)
    done = [run.text for run in runs]
    if await push_is_open(store, site.name, site.control):
        with lock_machine(site.urls.cnc):
            async with recovered_session(store, site, DeviceUrls(cnc=site.urls.cnc), report=done.append):
                pass
    return "; ".join(done) or None


async def push_is_open(store: Store, machine: str, control: str = "") -> bool:
    """Return whether the last push into a control is under way, waits for its rollback, or needs a person: by its journal alone.

    Raises
    ------
    StoreError
        The database does not answer.
    """
    journal = await asyncio.to_thread(store.pushes.last, machine, control)
    if not journal:
        return False
    state = PushState(journal[-1].state)
    return state is PushState.OPERATOR or state not in TERMINAL
