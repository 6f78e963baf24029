"""Messages on their way out: in the database until the broker has said that it has them."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Sequence
from typing import Any, Protocol


class Row(Protocol):
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

    async def pending(self) -> Sequence[Row]:
        """Return the oldest messages that no broker has acknowledged, oldest first."""
        ...

    async def done(self, number: int) -> None:
        """Note that the broker has this one."""
        ...


class OutboxStore(Protocol):
    """The part of the store that is used here."""

    def outbox_pending(self, limit: int = ...) -> Sequence[Row]:
        """Return the oldest unacknowledged messages."""
        ...

    def outbox_done(self, outbox_id: int, /) -> None:
        """Note that the broker has this one."""
        ...


class StoreOutbox:
    """The outbox table, off the event loop."""

    def __init__(self, store: OutboxStore) -> None:
        self._store = store

    async def pending(self) -> Sequence[Row]:
        """Return up to 100 messages, oldest first."""
        return await asyncio.to_thread(self._store.outbox_pending, 100)

    async def done(self, number: int) -> None:
        """Note that the broker has this one."""
        await asyncio.to_thread(self._store.outbox_done, number)


def encode(doc: dict[str, Any]) -> bytes:
    """Return a document as the payload of a message."""
    return json.dumps(doc, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()


def with_id(row: Row) -> bytes:
    """Return the payload with the row's number in it: at least once is what MQTT promises, and a receiver drops what it has seen."""
    return encode({"id": row.id, **json.loads(row.payload)})
