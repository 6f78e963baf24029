"""Recovery before the first check, and whenever a push was left open: interrupted runs, an unfinished push."""

from __future__ import annotations

import asyncio

from abbe.service.capture.recovery import recover_segments
from abbe.service.compensation.recovered_session import recovered_session
from abbe.service.devices.machine_lock import lock_machine
from abbe.service.devices.session import DeviceUrls
from abbe.service.push.states import TERMINAL, PushState
from abbe.service.site import Site
from abbe.service.storage.store import Store


async def recover_at_start(store: Store, site: Site) -> str | None:
    """Take over interrupted runs; finish a push that is open, for which the controller is needed, and only for that.

    Returns
    -------
    str or None
        What was done; None if nothing was open.

    Raises
    ------
    AbbeError, DriverError
        As of `abbe.service.compensation.recover.recover`: the controller cannot be reached, or a person has to look.
    """
    runs = await asyncio.to_thread(recover_segments, store, site.capture)
    told = [run.text for run in runs]
    if await push_is_open(store, site.name, site.control):
        with lock_machine(site.urls.cnc):
            async with recovered_session(store, site, DeviceUrls(cnc=site.urls.cnc), report=told.append):
                pass
    return "; ".join(told) or None


async def push_is_open(store: Store, machine: str, control: str = "") -> bool:
    """Whether the last push into a machine's control is on its way, waits for its way back, or needs a person: by its journal alone.

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
