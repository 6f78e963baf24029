"""All devices of one machine behind one open/close: nothing stays open when one of them fails."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import TypeVar

from abbe.drivers import registry
from abbe.drivers.api import BallBar, Controller, DisplacementMeter, Fixture
from abbe.drivers.errors import DriverError
from abbe.service.devices.clock_notes import noted
from abbe.service.devices.urls import DeviceUrls as DeviceUrls
from abbe.service.errors import AbbeError, ConfigError, DevicesNotReady

Ask = Callable[[str], Awaitable[None]]
First = Callable[[Controller], Awaitable[None]]
D = TypeVar("D", Controller, BallBar, DisplacementMeter, Fixture)


@dataclass(frozen=True, slots=True)
class Session:
    """Open devices. A test that needs an absent one is refused by name (`need`).

    ``attended``: somebody is there to answer a question at the console.
    """

    controller: Controller
    ballbar: BallBar | None
    laser: DisplacementMeter | None
    fixture: Fixture | None
    attended: bool = True

    def need_ballbar(self) -> BallBar:
        """The ball-bar, or one clear line that it is not configured."""
        if self.ballbar is None:
            raise ConfigError("this test needs a ball-bar, but the machine file names none", "add ballbar = ... under [devices]")
        return self.ballbar

    def need_laser(self) -> DisplacementMeter:
        """The laser, or one clear line that it is not configured."""
        if self.laser is None:
            raise ConfigError("this test needs a laser, but the machine file names none", "add laser = ... under [devices]")
        return self.laser

    def need_fixture(self) -> Fixture:
        """Whoever mounts instruments, or one clear line that nobody is configured."""
        if self.fixture is None:
            raise ConfigError("nobody can mount the instrument: no fixture configured", 'add fixture = "fixture+console:" under [devices]')
        return self.fixture


async def no_console(text: str) -> None:
    """Used where nobody is at the console: asking a person is an error that names the request."""
    raise ConfigError(f"nobody is at the console to: {text}", "run this test attended, or configure a remote fixture")


@asynccontextmanager
async def open_session(urls: DeviceUrls, ask: Ask = no_console, *, first: First | None = None) -> AsyncIterator[Session]:
    """Open every configured device and identify it; close all of them at the end, whatever happens.

    Parameters
    ----------
    urls : DeviceUrls
        Where they are.
    ask : callable
        Asks the person at the console.
    first : callable, optional
        Gets the open controller before any other device is opened (`abbe.service.compensation.recovered_session`). What it raises ends it.

    Raises
    ------
    ConfigError
        No controller configured.
    DriverError
        A device cannot be opened or is not what its protocol demands.
    DevicesNotReady
        The same of several: all are tried, and told in one line.
    """
    if urls.cnc is None:
        raise ConfigError("no controller configured", "add cnc = ... under [devices] of the machine file")
    async with AsyncExitStack() as stack:
        troubles: list[DriverError] = []

        async def opened(device: Awaitable[D]) -> D | None:
            try:
                found = await device
            except DriverError as error:
                troubles.append(error)
                return None
            stack.push_async_callback(found.close)
            return found

        found = await opened(registry.open_controller(urls.cnc))
        controller = None if found is None else noted(found)
        if controller is not None and first is not None:
            await first(controller)
        ballbar = None if urls.ballbar is None else await opened(registry.open_ballbar(urls.ballbar))
        laser = None if urls.laser is None else await opened(registry.open_laser(urls.laser))
        fixture = None if urls.fixture is None else await opened(registry.open_fixture(urls.fixture, ask))
        raise_all(troubles)
        assert controller is not None
        yield Session(controller, ballbar, laser, fixture, ask is not no_console)


def raise_all(troubles: Sequence[AbbeError | DriverError]) -> None:
    """Raise what is wrong with devices: one error as it is, several as one line.

    Raises
    ------
    AbbeError, DriverError
        As above.
    """
    if len(troubles) == 1:
        raise troubles[0]
    if troubles:
        raise DevicesNotReady("; ".join(str(error) for error in troubles), "nothing has moved")
