"""Outgoing messages: in the database until the broker has acknowledged them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from abbe.service.clock import Clock
from abbe.service.mqtt.topics import Topics

KEPT_DELIVERED = 1000
"""Number of delivered messages that stay in the database, for inspection."""
MOST_ALARMS, DOWN_TO_ALARMS = 10_000, 9_000
"""If more alarms than the first number wait, the oldest are dropped down to the second. Results are never dropped:
they are one message for each check, which the database keeps anyway."""
PRUNED_AT_ONCE = 1000
DROPPED = "MQT-001"


class OutboxRow(Protocol):
    """A waiting message."""

    @property
    def id(self) -> int:
        """Number; never reused for another message."""
        ...

    @property
    def topic(self) -> str:
        """Topic of the message."""
        ...

    @property
    def payload(self) -> bytes:
        """A JSON object."""
        ...


class Outbox(Protocol):
    """Source of the publisher's messages."""

    async def pending(self) -> Sequence[OutboxRow]:
        """Return the oldest unacknowledged messages, oldest first."""
        ...

    async def done(self, number: int) -> None:
        """Note that the broker has acknowledged a message."""
        ...

    async def tidy(self) -> int:
        """Delete old delivered messages; return how many waiting messages had to be dropped because too many wait."""
        ...


class OutboxStore(Protocol):
    """The part of the store that is used here."""

    def pending(self, limit: int = ...) -> Sequence[OutboxRow]:
        """Return the oldest unacknowledged messages."""
        ...

    def done(self, outbox_id: int, /) -> None:
        """Note that the broker has acknowledged a message."""
        ...

    def prune(self, keep: int, at_most: int = ..., /) -> int:
        """Delete delivered messages except the newest; return how many."""
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
    topics : Topics
        Topics of this machine: alarms may be dropped when too many wait, results never.
    kept : int
        Number of delivered messages that stay.
    most, down_to : int
        If more alarms than ``most`` wait, they are cut down to ``down_to``.
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
        """Note that the broker has acknowledged a message."""
        await asyncio.to_thread(self._store.done, number)

    async def tidy(self) -> int:
        """Delete old delivered messages; drop the oldest alarms when too many wait, and queue a message about that."""
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
    """Return the payload with the row's number: MQTT delivers at least once, and a receiver drops numbers that it has already seen."""
    return encode({"id": row.id, **json.loads(row.payload)})
