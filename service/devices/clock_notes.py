"""Notes of what the controller's clock showed and when that arrived: two clocks are compared by many such pairs, never by one."""

from __future__ import annotations

from collections import deque
from typing import Any, cast

from abbe.drivers.api import Controller, ControllerStatus

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
    """The last status that anybody got from a noted controller; None: nobody did, or nothing is noted."""
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
