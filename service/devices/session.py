"""Opens and closes all devices of one machine together: nothing stays open when one of them fails.

Every controller status is noted with its arrival time (`notes_since`): the comparison of two clocks uses many such pairs.
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
    """A controller that also notes the stamp and the arrival of every status."""

    def __init__(self, controller: Controller) -> None:
        self.noted_controller = controller
        self.clock_notes: deque[tuple[int, float]] = deque(maxlen=MOST)
        self.latest_status: ControllerStatus | None = None

    def __getattr__(self, name: str) -> Any:
        return getattr(self.noted_controller, name)

    async def status(self) -> ControllerStatus:
        """Read the status and note its stamp."""
        status = await self.noted_controller.status()
        self.clock_notes.append((status.ctrl_us, status.host_s))
        self.latest_status = status
        return status


def noted(controller: Controller) -> Controller:
    """Wrap a controller to note stamp and arrival of every status."""
    return cast(Controller, _Noted(controller))


def latest_status(controller: Controller) -> ControllerStatus | None:
    """Last status read from a noted controller; None before the first, or for other controllers."""
    return controller.latest_status if isinstance(controller, _Noted) else None


def notes_since(controller: Controller, ctrl_us: int) -> list[list[float]]:
    """Pairs [controller time in us, host time in s] since a controller time: the promptest pair of each of 500 intervals."""
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
    """Open devices; the `need` methods refuse a test whose device is missing.

    ``attended``: a person can answer questions at the console. ``recovered``: opening finished an interrupted push.
    """

    controller: Controller
    ballbar: BallBar | None
    laser: DisplacementMeter | None
    fixture: Fixture | None
    attended: bool = True
    recovered: bool = False

    def need_ballbar(self) -> BallBar:
        """Return the ball-bar, or raise ConfigError if the machine file names none."""
        if self.ballbar is None:
            raise ConfigError("this test needs a ball-bar, but the machine file names none", "add ballbar = ... under [devices]")
        return self.ballbar

    def need_laser(self) -> DisplacementMeter:
        """Return the laser, or raise ConfigError if the machine file names none."""
        if self.laser is None:
            raise ConfigError("this test needs a laser, but the machine file names none", "add laser = ... under [devices]")
        return self.laser

    def need_fixture(self) -> Fixture:
        """Return the fixture, or raise ConfigError if the machine file names none."""
        if self.fixture is None:
            raise ConfigError("no fixture is configured to mount the instrument", 'add fixture = "fixture+console:" under [devices]')
        return self.fixture


async def no_console(text: str) -> None:
    """Refuse a question to a person, for unattended sessions. Raises ConfigError with the question."""
    raise ConfigError(f"the console is unattended, but a person has to: {text}", "run this test attended, or configure a remote fixture")


@asynccontextmanager
async def open_session(urls: DeviceUrls, ask: Ask = no_console, *, first: First | None = None) -> AsyncIterator[Session]:
    """Open and identify every configured device; always close all of them at the end.

    ``ask`` asks the person at the console. ``first`` runs on the open controller before any other device is opened
    (`abbe.service.compensation.recover`); its errors end the session.

    Raises
    ------
    ConfigError
        No controller configured.
    DriverError
        A device cannot be opened or does not follow its protocol.
    DevicesNotReady
        Several devices failed; all are tried, and named in one line.
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
    """Raise a single device error as it is, several as one DevicesNotReady."""
    if len(troubles) == 1:
        raise troubles[0]
    if troubles:
        raise DevicesNotReady("; ".join(str(error) for error in troubles), "nothing has moved")
