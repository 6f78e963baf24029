"""All devices of one machine behind one open/close: nothing stays open when one of them fails."""

from __future__ import annotations

from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass

from drivers import registry
from drivers.api import BallBar, Controller, DisplacementMeter, Fixture
from service.devices.clock_notes import noted
from service.devices.urls import DeviceUrls as DeviceUrls
from service.errors import ConfigError

Ask = Callable[[str], Awaitable[None]]


@dataclass(frozen=True, slots=True)
class Session:
    """Open devices. A test that needs an absent one is refused by name (`need`)."""

    controller: Controller
    ballbar: BallBar | None
    laser: DisplacementMeter | None
    fixture: Fixture | None

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
async def open_session(urls: DeviceUrls, ask: Ask = no_console) -> AsyncIterator[Session]:
    """Open every configured device and identify it; close all of them at the end, whatever happens.

    Raises
    ------
    ConfigError
        No controller configured.
    DriverError
        A device cannot be opened or is not what its protocol demands.
    """
    if urls.cnc is None:
        raise ConfigError("no controller configured", "add cnc = ... under [devices] of the machine file")
    async with AsyncExitStack() as stack:
        controller = noted(await registry.open_controller(urls.cnc))
        stack.push_async_callback(controller.close)
        ballbar = laser = fixture = None
        if urls.ballbar is not None:
            ballbar = await registry.open_ballbar(urls.ballbar)
            stack.push_async_callback(ballbar.close)
        if urls.laser is not None:
            laser = await registry.open_laser(urls.laser)
            stack.push_async_callback(laser.close)
        if urls.fixture is not None:
            fixture = await registry.open_fixture(urls.fixture, ask)
            stack.push_async_callback(fixture.close)
        yield Session(controller, ballbar, laser, fixture)
