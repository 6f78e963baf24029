"""Ledger and shelf on top of the store, off the event loop; they retry while the database is locked or restarts."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Awaitable, Callable, Mapping
from datetime import datetime
from typing import ParamSpec, TypeVar

import structlog

from abbe.service.clock import Clock
from abbe.service.domain.document import Doc
from abbe.service.domain.schedule import FIRST_UTC
from abbe.service.errors import StoreError
from abbe.service.scheduler.ports import OpenSlot
from abbe.service.storage.repositories.service_records import RUNNING
from abbe.service.storage.store import Store
from abbe.service.verification import verify

log = structlog.get_logger("abbe.store")

P = ParamSpec("P")
T = TypeVar("T")

PAUSES_S = (0.5, 1.0, 2.0, 4.0, 8.0, 16.0, 30.0)
"""Pauses between tries, s: a minute in total. A measurement of minutes must not be lost because of a backup run."""


class RetryingStore:
    """Retries writes and reads while the database does not accept them."""

    def __init__(self, store: Store, clock: Clock) -> None:
        self._store = store
        self._clock = clock

    async def _write(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._again(lambda: self._store.write(fn, *args, **kwargs))

    async def _read(self, fn: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        return await self._again(lambda: asyncio.to_thread(fn, *args, **kwargs))

    async def _again(self, once: Callable[[], Awaitable[T]]) -> T:
        for pause_s in PAUSES_S:
            try:
                return await once()
            except StoreError as trouble:
                log.warning("the database did not answer; trying again", cause=trouble.detail, pause_s=pause_s)
                await self._clock.sleep(pause_s)
        return await once()


class StoreLedger(RetryingStore):
    """Slots in the store. Each key includes the machine's name: several services may share a database."""

    def __init__(self, store: Store, clock: Clock, machine: str) -> None:
        super().__init__(store, clock)
        self._machine = machine

    async def claim(self, schedule: str, slot_utc: datetime) -> bool:
        """Return True to exactly one caller, ever, for each (schedule, slot)."""
        return await self._write(self._store.slots.claim, self._key(schedule), slot_utc)

    async def begin(self, schedule: str, slot_utc: datetime) -> None:
        """Note that the check of a claimed slot starts: it is never started again."""
        await self._write(self._store.slots.begin, self._key(schedule), slot_utc)

    async def release(self, schedule: str, slot_utc: datetime) -> None:
        """Give back a claimed slot that was not started."""
        await self._write(self._store.slots.release, self._key(schedule), slot_utc)

    async def adopt(self, schedule: str) -> list[OpenSlot]:
        """Take over the open slots of services that are gone, in order of time. Each goes to exactly one caller."""
        found = await self._write(self._store.slots.adopt, self._key(schedule))
        return [OpenSlot(datetime.fromisoformat(one.slot_utc), one.state == RUNNING) for one in found]

    async def finish(self, schedule: str, slot_utc: datetime, state: str, reason: str = "") -> None:
        """Record the outcome of a claimed slot: state (at most 30 characters) and its sentence."""
        await self._write(self._store.slots.finish, self._key(schedule), slot_utc, state[:30], reason)

    async def in_force_since(self, rules: Mapping[str, str], now: datetime) -> dict[str, datetime]:
        """Return the time from which each schedule has its present time rule, as `SlotLedger.in_force_since`."""
        key = f"/{self._machine}"  # begins as no schedule's key does; one row, changed in place
        rows = await self._read(self._store.slots.latest, key, 1)
        known = json.loads(rows[0].reason or "{}") if rows else {}
        kept = {name: known[name] if known.get(name, [""])[0] == rule else [rule, now.isoformat()] for name, rule in rules.items()}
        if kept != known:
            await self._write(self._store.slots.claim, key, FIRST_UTC)
            await self._write(self._store.slots.finish, key, FIRST_UTC, "timetable", json.dumps(kept))
        return {name: datetime.fromisoformat(at) for name, (_, at) in kept.items()}

    async def last_claimed(self, schedule: str) -> datetime | None:
        """Return the latest slot ever claimed for this schedule, or None if it is new."""
        return await asyncio.to_thread(self._store.slots.last_due, self._key(schedule))

    def _key(self, schedule: str) -> str:
        return f"{self._machine}/{schedule}"


class StoreShelf(RetryingStore):
    """Verifications and messages in the store.

    Parameters
    ----------
    machine : tuple of str and int
        Name, and number in the store.
    topics : tuple of str
        Topics of verifications and of alarms; None if the machine file has no broker.
    posted : callable
        Called when there is a new message to publish.
    """

    def __init__(
        self, store: Store, clock: Clock, machine: tuple[str, int], topics: tuple[str, str] | None, posted: Callable[[], None]
    ) -> None:
        super().__init__(store, clock)
        self._machine, self._machine_id = machine
        self._topics = topics
        self._posted = posted

    async def keep(self, doc: Doc) -> int:
        """Store a verification and queue its messages, together; return its number."""
        messages: list[tuple[str, Doc]] = []
        if self._topics is not None:
            verification_topic, alarm_topic = self._topics
            messages.append((verification_topic, doc))
            if doc["cause"] is not None:
                messages.append((alarm_topic, self._of_machine(verify.alarm(doc))))
        number = await self._write(self._store.verifications.add_with_messages, self._machine_id, doc, messages)
        self._posted()
        return number

    async def alarm(self, doc: Doc) -> None:
        """Queue an alarm."""
        if self._topics is not None:
            await self._write(self._store.outbox.add_document, self._topics[1], self._of_machine(doc))
            self._posted()

    def _of_machine(self, doc: Doc) -> Doc:
        return {"schema": verify.SCHEMA, "machine": self._machine, **doc}
