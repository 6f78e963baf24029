"""Keep one connection to the broker and empty the outbox through it. Without a broker messages wait, and nothing else is affected.

A message leaves the outbox only after the broker's acknowledgement (QoS 1). aiomqtt does not reconnect: every connection here is a new
client, and the back-off is implemented here.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import suppress
from datetime import datetime
from typing import Any

import aiomqtt
import structlog

from abbe.service.clock import Clock
from abbe.service.errors import ConfigError, StoreError
from abbe.service.mqtt.broker import Broker
from abbe.service.mqtt.outbox import Outbox, encode, with_id
from abbe.service.mqtt.topics import Topics, client_id

log = structlog.get_logger("abbe.mqtt")

KEEPALIVE_S = 15
REPLY_S = 10.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.5, 30.0
STEADY_S = 5.0
"""A connection that lived this long resets the pause, s. A broker that accepts and closes does not."""
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
        outbox: Outbox,
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
        """Change the state message's part about the table in force; it goes with every state except offline."""
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
                log.warning("broker not reachable; messages wait in the store", broker=str(self._broker), reason=reason)
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
        """Fail early and cancellably if nothing listens, or something that is not our broker.

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
        """Keep the outbox bounded, with a broker and without."""
        try:
            dropped = await self._outbox.tidy()
        except StoreError as trouble:
            log.warning("outbox not tidied up; trying again later", reason=trouble.detail)
            return
        self._untidy = 0
        if dropped:
            log.warning("broker away for too long; oldest alarms dropped, results wait", broker=str(self._broker), dropped=dropped)
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
