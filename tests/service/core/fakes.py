"""Stand-ins with state: a clock one can turn, a ledger, a shelf."""

from __future__ import annotations

import asyncio
import heapq
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import Any, Protocol

from abbe.service.domain.progress import Progress, ProgressSink
from abbe.service.domain.schedule import Schedule
from abbe.service.scheduler.job import Job
from abbe.service.scheduler.ports import OpenSlot, SlotState
from abbe.service.scheduler.slots import time_rule
from abbe.service.sequences.control import Control


class FakeClock:
    """Time passes only in ``pass_time``; a wall clock jump is ``utc_now += ...``."""

    def __init__(self, start: datetime) -> None:
        self.utc_now = start
        self.now_s = 0.0
        self._sleepers: list[tuple[float, int, asyncio.Future[None]]] = []
        self._order = count()
        self.wakes = 0

    def monotonic_s(self) -> float:
        return self.now_s

    def utc(self) -> datetime:
        return self.utc_now

    async def sleep(self, s: float) -> None:
        woken: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        heapq.heappush(self._sleepers, (self.now_s + s, next(self._order), woken))
        await woken

    def _to(self, now_s: float) -> None:
        self.utc_now += timedelta(seconds=now_s - self.now_s)
        self.now_s = now_s

    async def pass_time(self, seconds: float) -> None:
        """Let time pass, waking sleepers in order, and let everything they start come to rest before going on."""
        end = self.now_s + seconds
        await settle()
        while self._sleepers and self._sleepers[0][0] <= end:
            at, _, woken = heapq.heappop(self._sleepers)
            self._to(max(at, self.now_s))
            if not woken.done():
                woken.set_result(None)
                self.wakes += 1
                await settle()
        self._to(end)


async def settle() -> None:
    """Run everything that is ready, and what that makes ready. In-memory fakes need no more than a few turns of the loop."""
    ready = getattr(asyncio.get_running_loop(), "_ready", None)
    for _ in range(8):
        await asyncio.sleep(0)
        if ready is not None and not ready:  # nobody else has anything to do
            return


class FakeLedger:
    def __init__(self) -> None:
        self.states: dict[tuple[str, datetime], str] = {}
        self.reasons: dict[tuple[str, datetime], str] = {}
        self.nobodys: set[tuple[str, datetime]] = set()
        self.rules: dict[str, tuple[str, datetime]] = {}

    async def claim(self, schedule: str, slot_utc: datetime) -> bool:
        if (schedule, slot_utc) in self.states:
            return False
        self.states[schedule, slot_utc] = "CLAIMED"
        return True

    async def begin(self, schedule: str, slot_utc: datetime) -> None:
        assert self.states[schedule, slot_utc] == "CLAIMED", "begun twice"
        self.states[schedule, slot_utc] = "RUNNING"

    async def release(self, schedule: str, slot_utc: datetime) -> None:
        if self.dead:
            return
        assert self.states[schedule, slot_utc] == "CLAIMED", "given back after it began"
        self.states[schedule, slot_utc] = "RELEASED"
        self.nobodys.add((schedule, slot_utc))

    async def adopt(self, schedule: str) -> list[OpenSlot]:
        """What was given back, and what a service left that `lose_owner` has ended."""
        found = sorted((slot, self.states[name, slot]) for name, slot in self.nobodys if name == schedule)
        self.nobodys -= {(schedule, slot) for slot, _ in found}
        for slot, state in found:
            self.states[schedule, slot] = "CLAIMED" if state != "LOST RUNNING" else "RUNNING"
        return [OpenSlot(slot, state == "LOST RUNNING") for slot, state in found]

    dead = False
    """Nothing is written any more: the power is off."""

    def lose_owner(self) -> None:
        """The power goes: nothing more is written, and what is open is nobody's."""
        lost = {key: f"LOST {state}" for key, state in self.states.items() if state in ("CLAIMED", "RUNNING")}
        self.states |= lost
        self.nobodys |= set(lost)

    async def finish(self, schedule: str, slot_utc: datetime, state: str, reason: str = "") -> None:
        if self.dead:
            return
        assert self.states[schedule, slot_utc] in ("CLAIMED", "RUNNING"), "finished twice"
        assert len(state) <= 30
        self.states[schedule, slot_utc] = state
        self.reasons[schedule, slot_utc] = reason

    async def in_force_since(self, rules: Mapping[str, str], now: datetime) -> dict[str, datetime]:
        known = self.rules
        self.rules = {name: known[name] if known.get(name, ("",))[0] == rule else (rule, now) for name, rule in rules.items()}
        return {name: at for name, (_, at) in self.rules.items()}

    def of_earlier(self, schedule: Schedule, slot: datetime) -> None:
        """An earlier service had this schedule and ran this slot."""
        self.rules[schedule.name] = (time_rule(schedule), slot)
        self.states[schedule.name, slot] = "done: pass"

    async def last_claimed(self, schedule: str) -> datetime | None:
        return max((slot for name, slot in self.states if name == schedule), default=None)

    def of(self, start: str) -> list[datetime]:
        return sorted(slot for (_, slot), state in self.states.items() if state.startswith(start))


class FakeShelf:
    def __init__(self) -> None:
        self.docs: list[dict[str, Any]] = []
        self.alarms: list[dict[str, Any]] = []

    async def keep(self, doc: dict[str, Any]) -> int:
        self.docs.append(doc)
        return len(self.docs)

    async def alarm(self, doc: dict[str, Any]) -> None:
        self.alarms.append(doc)


def utc(*parts: int) -> datetime:
    return datetime(*parts, tzinfo=UTC)  # type: ignore[arg-type,misc]


@dataclass(frozen=True)
class Result:
    """A CheckResult."""

    verdict: str = "pass"
    values: dict[str, float] = field(default_factory=lambda: {"body_diagonal_um": 11.8, "helix_rms_um": 1.4})
    uncertainties: dict[str, float] = field(default_factory=lambda: {"body_diagonal_um": 1.1, "helix_rms_um": 0.2})
    limits: dict[str, float] = field(default_factory=lambda: {"body_diagonal_um": 20.0, "helix_rms_um": 3.0})
    run_labels: list[str] = field(default_factory=lambda: ["helix-1", "diagonal-1"])
    campaign: str = "check-1"
    started_utc: datetime = datetime(2026, 6, 1, 4, tzinfo=UTC)
    duration_s: float = 61.0
    text: str = "Every figure lies inside its limit."
    comparable: bool = True


STEP = Progress("helix", 3, 10, 42.0, "revolution 3 of 10")


class FakeWatcher:
    def __init__(self) -> None:
        self.heard: list[str] = []

    def job_started(self, schedule: Schedule, at_utc: datetime) -> None:
        self.heard.append(f"started {schedule.name}")

    def job_progress(self, progress: Progress) -> None:
        self.heard.append(f"progress {progress.done}/{progress.total}")

    def job_ended(self, doc: dict[str, Any] | None) -> None:
        self.heard.append(f"ended {doc['verdict'] if doc else None}")


class RunCheck(Protocol):
    async def __call__(self, schedule: Schedule, slot: datetime, control: Control, /) -> SlotState: ...


class FakeCheckJob(Job[SlotState]):
    """A check that does what a test says, and ends as that says."""

    handles_abort = True

    def __init__(self, run: RunCheck, schedule: Schedule, slot: datetime) -> None:
        self._run, self.terms, self._slot = run, schedule, slot

    async def do(self, progress: ProgressSink, control: Control) -> SlotState:
        return await self._run(self.terms, self._slot, control)

    async def failed(self, error: Exception) -> SlotState:
        raise error

    async def end(self, outcome: SlotState) -> SlotState:
        return outcome


def fake_checks(run: RunCheck) -> Callable[[Schedule, datetime], FakeCheckJob]:
    return lambda schedule, slot: FakeCheckJob(run, schedule, slot)
