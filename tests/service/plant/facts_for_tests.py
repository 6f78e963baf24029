"""PlantFacts that tests turn."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

from abbe.service.domain.progress import DeviceStatus, RunningCheck
from abbe.service.domain.verification import Verdict, Verification
from abbe.service.errors import StoreError
from abbe.service.plant.gather import ActiveTable, PlantAlarm, PlantFacts
from tests.patience import within

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)
RUNNING = RunningCheck(
    schedule="weekly", recipe="quick-check", since_utc=NOON, stage="helix", message="revolution 3 of 10", done=30.0, total=100.0, eta_s=42.0
)


def check(number: int, verdict: Verdict = "pass", **figures: float | None) -> Verification:
    chosen = figures or {"body_diagonal_um": 11.8, "helix_rms_um": 1.4}
    at = NOON - timedelta(hours=100 - number)
    return Verification(
        id=number,
        machine="mill-7",
        schedule="weekly",
        recipe="quick-check",
        slot_utc=at,
        started_utc=at,
        duration_s=61.0,
        verdict=verdict,
        values=chosen,
        uncertainties=dict.fromkeys(chosen, 1.1),
        limits=dict.fromkeys(chosen, 20.0),
        text=f"check {number}: {verdict}",
    )


def facts(**changes: Any) -> PlantFacts:
    devices = (
        DeviceStatus(role="laser", url="", state="answered", at_utc=NOON),
        DeviceStatus(role="cnc", url="", state="fault", text="refused\x07by peer"),
    )
    known = PlantFacts(
        machine="mill-7",
        version="0.1.0",
        now_utc=NOON,
        running=None,
        next_utc=NOON + timedelta(days=1),
        checks=(check(2, "fail"), check(1)),
        alarms=(PlantAlarm("DRV-002", "open: refused", NOON - timedelta(hours=98), "cnc"),),
        devices=devices,
        table=ActiveTable(1, 0xBEEF, 4, NOON),
    )
    return replace(known, **changes)


class Source:
    """A FactsSource whose facts are set by the test; None: the database does not answer."""

    def __init__(self) -> None:
        self.now: PlantFacts | None = facts()
        self._questions: asyncio.Queue[None] = asyncio.Queue()

    async def asked_again(self, times: int = 2) -> None:
        """Wait until the facts were asked for so often from now on."""
        while not self._questions.empty():
            self._questions.get_nowait()
        async with asyncio.timeout(within(30)):
            for _ in range(times):
                await self._questions.get()

    async def facts(self) -> PlantFacts:
        self._questions.put_nowait(None)
        if self.now is None:
            raise StoreError("the database is locked")
        return self.now
