"""All devices of one machine behind one open/close: nothing stays open when one of them fails.

Every status of the controller is noted with its arrival (`notes_since`): two clocks are compared by many such pairs, never by one.
"""

from __future__ import annotations

from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any, TypeVar, cast

from abbe.drivers import registry
from abbe.drivers.api import BallBar, Controller, ControllerStatus, DisplacementMeter, Fixture
from abbe.drivers.errors import DriverError
from abbe.service.devices.urls import DeviceUrls as DeviceUrls
from abbe.service.errors import AbbeError, ConfigError, DevicesNotReady

MOST = 50_000
KEPT = 500


class _Noted:
    """A controller that does what it always did; the stamp and the arrival of every status are noted."""

    def __init__(self, controller: Controller) -> None:
        self.noted_controller = controller
        self.clock_notes: deque[tuple[int, float]] = deque(maxlen=MOST)
        self.latest_status: ControllerStatus | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.noted_controller, name)

    async def status(self) -> ControllerStatus:
        """Ask for the status, and note its stamp."""
        status = await self.noted_controller.status()
        self.clock_notes.append((status.ctrl_us, status.host_s))
        self.latest_status = status
        return status


def noted(controller: Controller) -> Controller:
    """The same controller, noting stamp and arrival of every status."""
    return cast(Controller, _Noted(controller))


def latest_status(controller: Controller) -> ControllerStatus | None:
    """The last status that was read from a noted controller; None before the first, or where nothing is noted."""
    return controller.latest_status if isinstance(controller, _Noted) else None


def notes_since(controller: Controller, ctrl_us: int) -> list[list[float]]:
    """Pairs [controller time in us, host time in s] noted from an instant of the controller on, the promptest of each of 500 stretches."""
    if not isinstance(controller, _Noted):
        return []
    pairs = [(float(c), h) for c, h in controller.clock_notes if c >= ctrl_us]
    if len(pairs) <= KEPT:
        return [[c, h] for c, h in pairs]
    (c0, h0), (c1, h1) = pairs[0], pairs[-1]
    rate = (h1 - h0) / (c1 - c0) if c1 > c0 else 0.0
    edges = [k * len(pairs) // KEPT for k in range(KEPT + 1)]
    prompt = [min(pairs[a:b], key=lambda p: p[1] - rate * p[0]) for a, b in zip(edges[:-1], edges[1:], strict=True)]  # noqa: RUF007
    return [[c, h] for c, h in prompt]


Ask = Callable[[str], Awaitable[None]]
First = Callable[[Controller], Awaitable[None]]
D = TypeVar("D", Controller, BallBar, DisplacementMeter, Fixture)


@dataclass(frozen=True, slots=True)
class Session:
    """Open devices. A test that needs an absent one is refused by name (`need`).

    ``attended``: a person can answer a question at the console. ``recovered``: what an interrupted push left in the controller was finished
    when it was opened.
    """

    controller: Controller
    ballbar: BallBar | None
    laser: DisplacementMeter | None
    fixture: Fixture | None
    attended: bool = True
    recovered: bool = False

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
        """The fixture, or one clear line that none is configured."""
        if self.fixture is None:
            raise ConfigError("nobody can mount the instrument: no fixture configured", 'add fixture = "fixture+console:" under [devices]')
        return self.fixture


async def no_console(text: str) -> None:
    """For unattended sessions: asking a person is an error that names the request."""
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
        The same of several: all are tried, and named in one line.
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
