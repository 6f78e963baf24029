"""Open a machine's devices: the controller first, then recovery of an interrupted push, and only then the instruments.

A missing or silent instrument must not keep an unverified table in force (tests/service/devices/test_every_session.py).
"""

from __future__ import annotations

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import replace

from abbe.drivers.api import Controller
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Ask, DeviceUrls, Session, no_console, open_session
from abbe.service.site import Site
from abbe.service.storage.store import Store


@asynccontextmanager
async def recovered_session(
    store: Store,
    site: Site,
    urls: DeviceUrls | None = None,
    ask: Ask = no_console,
    *,
    accept_by: str = "",
    report: Callable[[str], object] | None = None,
) -> AsyncIterator[Session]:
    """Open a machine's devices; `recover` runs after the controller is open and before any other device.

    Parameters
    ----------
    urls : DeviceUrls, optional
        Default: all devices of the machine file.
    ask, accept_by
        Passed to `open_session` and `recover`.
    report : callable, optional
        Receives what recovery did, before the other devices are opened.

    Raises
    ------
    AbbeError, DriverError
        From `recover`: no other device was opened. From `open_session`: the interrupted push is finished already.
    """

    async def first(controller: Controller) -> None:
        done = await recover(controller, store, site, accept_by=accept_by)
        if done is not None and report is not None:
            report(done)

    async with open_session(urls or site.urls, ask, first=first) as session:
        yield replace(session, recovered=True)
