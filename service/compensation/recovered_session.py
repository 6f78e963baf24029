"""The one way to devices that are worked with: controller, then what an interrupted push left in it, and only then the instruments.

An instrument that is missing or silent must not keep an unverified table in force (tests/service/devices/test_every_session.py).
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
    told: Callable[[str], object] | None = None,
) -> AsyncIterator[Session]:
    """Open a machine's devices with `recover` between the controller and all others.

    Parameters
    ----------
    urls : DeviceUrls, optional
        Default: all devices of the machine file.
    ask : callable
        As of `open_session`.
    accept_by : str
        As of `recover`.
    told : callable, optional
        Gets what was done, before the other devices are opened.

    Raises
    ------
    AbbeError, DriverError
        As of `recover`: no other device was opened. As of `open_session`: what was left open is finished already.
    """

    async def first(controller: Controller) -> None:
        done = await recover(controller, store, site, accept_by=accept_by)
        if done is not None and told is not None:
            told(done)

    async with open_session(urls or site.urls, ask, first=first) as session:
        yield replace(session, recovered=True)
