"""Messages on their way out: in the database until the broker has said that it has them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from abbe.service.clock import Clock
from abbe.service.mqtt.topics import Topics

KEPT_DELIVERED = 1000
"""Delivered messages that stay in the database, to be looked at."""
MOST_ALARMS, DOWN_TO_ALARMS = 10_000, 9_000
"""When more alarms than the first figure wait, the oldest are dropped until so many as the second are left. Results are never dropped:
they are one message for each check, which the database keeps for ever anyway."""
PRUNED_AT_ONCE = 1000
DROPPED = "MQT-001"


class OutboxRow(Protocol):
    """A message that waits."""

    @property
    def id(self) -> int:
        """Number; never used again for another message."""
        ...

    @property
    def topic(self) -> str:
        """Where it goes."""
        ...

    @property
    def payload(self) -> bytes:
        """A JSON object."""
        ...


class Outbox(Protocol):
    """What the publisher takes messages from."""

    async def pending(self) -> Sequence[OutboxRow]:
        """Return the oldest messages that no broker has acknowledged, oldest first."""
        ...

    async def done(self, number: int) -> None:
        """Note that the broker has this one."""
        ...

    async def tidy(self) -> int:
        """Forget what was delivered long ago; return how many waiting messages had to be dropped, because too many wait."""
        ...


class OutboxStore(Protocol):
    """The part of the store that is used here."""

    def pending(self, limit: int = ...) -> Sequence[OutboxRow]:
        """Return the oldest unacknowledged messages."""
        ...

    def done(self, outbox_id: int, /) -> None:
        """Note that the broker has this one."""
        ...

    def prune(self, keep: int, at_most: int = ..., /) -> int:
        """Forget delivered messages but the newest; return how many."""
        ...

    def shed(
        self, topics: Sequence[str], most: int, down_to: int, notice: Callable[[int, str, str], tuple[str, bytes]] | None = ..., /
    ) -> int:
        """Drop the oldest waiting messages of some topics when there are too many; return how many."""
        ...


class StoreOutbox:
    """The outbox table, off the event loop.

    Parameters
    ----------
    store : OutboxStore
        Where the messages are.
    topics : Topics
        Of this machine: alarms may be dropped when too many wait, results never.
    clock : Clock
        The time in the message that tells of dropped ones.
    kept : int
        Delivered messages that stay.
    most, down_to : int
        More waiting alarms than the first are cut down to the second.
    """

    def __init__(
        self,
        store: OutboxStore,
        topics: Topics,
        clock: Clock,
        kept: int = KEPT_DELIVERED,
        most: int = MOST_ALARMS,
        down_to: int = DOWN_TO_ALARMS,
    ) -> None:
        self._store, self._topics, self._clock = store, topics, clock
        self._kept, self._most, self._down_to = kept, most, down_to

    async def pending(self) -> Sequence[OutboxRow]:
        """Return up to 100 messages, oldest first."""
        return await asyncio.to_thread(self._store.pending, 100)

    async def done(self, number: int) -> None:
        """Note that the broker has this one."""
        await asyncio.to_thread(self._store.done, number)

    async def tidy(self) -> int:
        """Forget what was delivered long ago; drop the oldest alarms when too many wait, and queue a message that says so."""
        while await asyncio.to_thread(self._store.prune, self._kept, PRUNED_AT_ONCE) == PRUNED_AT_ONCE:
            pass
        return await asyncio.to_thread(self._store.shed, (self._topics.alarm,), self._most, self._down_to, self._notice)

    def _notice(self, count: int, first_utc: str, last_utc: str) -> tuple[str, bytes]:
        what = f"the broker was away too long: {count} alarms from {first_utc} to {last_utc} were dropped before they could be delivered"
        doc = {"code": DROPPED, "what": what, "dropped": count, "at_utc": self._clock.utc().isoformat()}
        return self._topics.alarm, encode({"schema": 1, "machine": self._topics.machine, **doc})


def encode(doc: dict[str, Any]) -> bytes:
    """Return a document as the payload of a message."""
    return json.dumps(doc, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def with_id(row: OutboxRow) -> bytes:
    """Return the payload with the row's number in it: at least once is what MQTT promises, and a receiver drops what it has seen."""
    return encode({"id": row.id, **json.loads(row.payload)})
