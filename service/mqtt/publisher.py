"""The outbox of MQTT messages, and the one connection that sends them to the broker.

Messages wait in the database, and leave it only after the broker's acknowledgement (QoS 1). Without a broker they wait; nothing else is
affected. aiomqtt does not reconnect: every connection here is a new client, and the back-off is implemented here.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from contextlib import suppress
from datetime import datetime
from typing import Any, Protocol

import aiomqtt
import structlog

from abbe.service.clock import Clock
from abbe.service.errors import ConfigError, StoreError
from abbe.service.mqtt.broker import Broker, Topics, client_id

KEPT_DELIVERED = 1000
"""Number of delivered messages that stay in the database, for inspection."""
MOST_ALARMS, DOWN_TO_ALARMS = 10_000, 9_000
"""If more alarms than the first number wait, the oldest are dropped until the second number is left. Results are never dropped: there is
only one for each check, and the database keeps the checks anyway."""
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


class MessageSource(Protocol):
    """Source of the publisher's messages."""

    async def pending(self) -> Sequence[OutboxRow]:
        """Return the oldest unacknowledged messages, oldest first."""
        ...

    async def done(self, number: int) -> None:
        """Note that the broker has acknowledged a message."""
        ...

    async def tidy(self) -> int:
        """Delete old delivered messages; return how many waiting messages were dropped because too many waited."""
        ...


class OutboxStore(Protocol):
    """The part of the store that the publisher needs."""

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
    """The outbox in the database. Its calls run in threads, off the event loop.

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


log = structlog.get_logger("abbe.mqtt")

KEEPALIVE_S = 15
REPLY_S = 10.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
STEADY_S = 5.0
"""A connection that lived this long, s, resets the pause before the next attempt; one that the broker closes at once does not."""
LOOK_S = 30.0
"""Time between two looks into the outbox without a wake-up, s: other processes write into it too."""
FAREWELL_S = 1.0
TIDY_EVERY = 500
"""Number of messages between two deletions of old delivered ones."""

_TROUBLE = (aiomqtt.MqttError, StoreError, ConfigError, OSError)


class Publisher:
    """Publishes the state of one machine, and the outbox.

    Parameters
    ----------
    topics : Topics
        Names the machine and its topics.
    outbox : Outbox
        Messages to send.
    clock : Clock
        Pauses, and the time in the state message.
    on_change : callable, optional
        Called with True when connected and with False when not.
    on_drop : callable, optional
        Called with the number of waiting messages that were dropped because the broker was away for too long.
    """

    def __init__(
        self,
        broker: Broker,
        topics: Topics,
        outbox: MessageSource,
        clock: Clock,
        on_change: Callable[[bool], None] = lambda connected: None,
        on_drop: Callable[[int], None] = lambda dropped: None,
    ) -> None:
        self._broker = broker
        self._topics = topics
        self._outbox = outbox
        self._clock = clock
        self._on_change = on_change
        self._on_drop = on_drop
        self._untidy = TIDY_EVERY  # tidy at the start: older versions kept everything
        self._state: dict[str, Any] = {"state": "online"}
        self._verified: dict[str, Any] = {}
        self._wake = asyncio.Event()
        self._stopping = asyncio.Event()
        self._pause_s = FIRST_PAUSE_S
        self._warned = False

    def wake(self) -> None:
        """Report a new message in the outbox."""
        self._wake.set()

    def set_state(self, state: str, since_utc: datetime, **more: str) -> None:
        """Change the retained state message. Only the latest state matters: it is not queued, but sent again at every connection."""
        self._state = {"state": state, "since_utc": since_utc.isoformat(), **more}
        self._wake.set()

    def set_verified(self, verified: dict[str, Any]) -> None:
        """Change what the state message says about the table in force. Every state message except offline says it."""
        if verified != self._verified:
            self._verified = verified
            self._wake.set()

    def stop(self) -> None:
        """Publish offline, if a broker is connected, and let `run` return."""
        self._stopping.set()
        self._wake.set()

    async def run(self) -> None:
        """Work until `stop`."""
        while not self._stopping.is_set():
            started_s = self._clock.monotonic_s()
            reason = await self._connection()
            self._on_change(False)
            if self._stopping.is_set():
                return
            if self._clock.monotonic_s() - started_s >= STEADY_S:
                self._pause_s = FIRST_PAUSE_S
            if not self._warned:
                log.warning("broker not reachable; messages wait in the database", broker=str(self._broker), reason=reason)
                self._warned = True
            await self._tidy()
            await self._pause()

    async def _connection(self) -> str:
        """Connect and publish until the connection is lost or `stop` is called; return what ended it."""
        ended = "stopped"
        try:
            await self._probe()
            async with self._client() as client, asyncio.TaskGroup() as tasks:
                watch = tasks.create_task(_until_lost(client), name="mqtt watch")
                await self._publish(client)
                watch.cancel()
        except* _TROUBLE as trouble:
            ended = _first(trouble)
        return ended

    async def _probe(self) -> None:
        """Fail early if nothing listens, or if the listener is not our broker; unlike a connection by aiomqtt, this can be cancelled.

        aiomqtt connects in a thread that cannot be interrupted, and leaves a socket open if it refuses the broker's certificate.
        """
        tls = self._broker.tls_context()
        async with asyncio.timeout(REPLY_S / 2):
            _, writer = await asyncio.open_connection(self._broker.host, self._broker.port, ssl=tls)
        writer.close()
        with suppress(OSError):
            await writer.wait_closed()

    def _client(self) -> aiomqtt.Client:
        will = aiomqtt.Will(self._topics.state, self._state_payload({"state": "offline"}), qos=1, retain=True)
        return aiomqtt.Client(
            self._broker.host,
            self._broker.port,
            username=self._broker.username,
            password=self._broker.password,
            tls_context=self._broker.tls_context(),
            identifier=client_id(self._topics.machine),
            will=will,
            keepalive=KEEPALIVE_S,
            timeout=REPLY_S,
        )

    async def _publish(self, client: aiomqtt.Client) -> None:
        try:
            await self._publish_changes(client)
        finally:
            # Also when cancelled: aiomqtt then disconnects properly, so the broker would not publish the last will.
            farewell = {"state": "offline", "since_utc": self._clock.utc().isoformat()}
            with suppress(aiomqtt.MqttError):
                await client.publish(self._topics.state, self._state_payload(farewell), qos=1, retain=True, timeout=FAREWELL_S)

    async def _publish_changes(self, client: aiomqtt.Client) -> None:
        published: tuple[dict[str, Any], dict[str, Any]] | None = None
        while not self._stopping.is_set():
            self._wake.clear()  # before looking: a message added meanwhile wakes this loop again
            now = (self._state, self._verified)
            if published is None or any(a is not b for a, b in zip(now, published, strict=True)):
                published = now
                verified = {"verified": now[1]} if now[1] else {}
                await client.publish(self._topics.state, self._state_payload(now[0] | verified), qos=1, retain=True)
                self._connected()
            rows = await self._outbox.pending()
            for row in rows:
                await client.publish(row.topic, with_id(row), qos=1)
                await self._outbox.done(row.id)
                self._untidy += 1
                if self._stopping.is_set():
                    break
            if self._untidy >= TIDY_EVERY:
                await self._tidy()
            if not rows:
                with suppress(TimeoutError):
                    async with asyncio.timeout(LOOK_S):
                        await self._wake.wait()

    async def _tidy(self) -> None:
        """Keep the outbox bounded, whether or not a broker is connected."""
        try:
            dropped = await self._outbox.tidy()
        except StoreError as trouble:
            log.warning("outbox not tidied up; trying again later", reason=trouble.detail)
            return
        self._untidy = 0
        if dropped:
            log.warning("broker away for too long; oldest alarms dropped, all results kept", broker=str(self._broker), dropped=dropped)
            self._on_drop(dropped)

    def _connected(self) -> None:
        self._on_change(True)
        if self._warned:
            log.info("broker reachable again", broker=str(self._broker))
            self._warned = False

    def _state_payload(self, state: dict[str, Any]) -> bytes:
        return encode({"schema": 1, "machine": self._topics.machine, **state})

    async def _pause(self) -> None:
        """Wait before the next attempt; `stop` cuts it short."""
        pause_s, self._pause_s = self._pause_s, min(self._pause_s * 2, LONGEST_PAUSE_S)
        async with asyncio.TaskGroup() as tasks:
            nap = tasks.create_task(self._clock.sleep(pause_s), name="mqtt pause")
            stop = tasks.create_task(self._stopping.wait(), name="mqtt stop")
            nap.add_done_callback(lambda _: stop.cancel())
            stop.add_done_callback(lambda _: nap.cancel())


async def _until_lost(client: aiomqtt.Client) -> None:
    """Raise MqttError when the connection is lost. Nothing is subscribed, so no message ever arrives."""
    async for _ in client.messages:
        pass


def _first(trouble: BaseException) -> str:
    while isinstance(trouble, BaseExceptionGroup):
        trouble = trouble.exceptions[0]
    return f"{type(trouble).__name__}: {trouble}"
