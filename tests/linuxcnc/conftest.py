"""A real LinuxCNC with the bridge of deploy/linuxcnc in front of it."""

from __future__ import annotations

import shutil
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack

import pytest

from tests.linuxcnc.instance import Instance, missing

Start = Callable[[], Awaitable[Instance]]


@pytest.fixture(scope="session")
def linuxcnc(require) -> None:
    reason = missing()
    require("linuxcnc", not reason, f"no LinuxCNC: {reason}")
    require("mbpoll", shutil.which("mbpoll") is not None, "mbpoll is not installed")


@pytest.fixture
async def instances(linuxcnc) -> AsyncIterator[Callable[[], Instance]]:
    """Make instances; all of them are ended afterwards."""
    async with AsyncExitStack() as stack:

        def make() -> Instance:
            made = Instance()
            stack.push_async_callback(made.close)
            return made

        yield make


@pytest.fixture
async def machine(instances) -> Instance:
    """One that runs."""
    made = instances()
    await made.start()
    return made
