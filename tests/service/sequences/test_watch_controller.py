"""Whose silence it is: a stall of this computer gives the controller its time once more, and only once."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from abbe.service.errors import StatusUnknown
from abbe.service.sequences.watch import LATE_S, known_status

UNKNOWN_S = 0.5
STATUS: Any = object()


class Controller:
    """Its first ``stalls`` replies are lost in a stall of this computer, of ``stall_s`` by the loop's clock, which is made to jump."""

    def __init__(self, stalls: int, stall_s: float) -> None:
        self.asked, self._stalls, self._stall_s, self._skipped_s, loop = 0, stalls, stall_s, 0.0, asyncio.get_running_loop()
        real = loop.time
        loop.time = lambda: real() + self._skipped_s  # type: ignore[method-assign]

    async def status(self) -> Any:
        self.asked += 1
        if self.asked <= self._stalls:
            self._skipped_s += self._stall_s
            await asyncio.Event().wait()
        return STATUS


@pytest.mark.parametrize(
    "stall_s", [UNKNOWN_S - 0.01, UNKNOWN_S + 0.5 * LATE_S, UNKNOWN_S + 5.0], ids=["ends before", "just after", "long"]
)
async def test_after_a_stall_the_controller_is_asked_once_more(stall_s: float) -> None:
    controller = Controller(1, stall_s)
    assert await known_status(controller.status, UNKNOWN_S) is STATUS
    assert controller.asked == 2


async def test_after_a_second_stall_the_status_is_unknown() -> None:
    controller = Controller(2, UNKNOWN_S)
    with pytest.raises(StatusUnknown, match="unknown for 500 ms"):
        await known_status(controller.status, UNKNOWN_S)
    assert controller.asked == 2
