"""Topics, broker addresses and payloads; and that no broker means silence, not trouble."""

from __future__ import annotations

import asyncio
import json
import socket
from dataclasses import dataclass

import pytest
from structlog.testing import capture_logs

from abbe.service.errors import ConfigError
from abbe.service.mqtt.broker import Topics, client_id, level, parse
from abbe.service.mqtt.publisher import Publisher, with_id
from tests.patience import within
from tests.service.core.fakes import FakeClock, utc


@dataclass(frozen=True)
class Message:
    id: int
    topic: str
    payload: bytes


class FakeOutbox:
    async def pending(self) -> list[Message]:
        return []

    async def done(self, number: int) -> None:
        raise AssertionError(number)

    async def tidy(self) -> int:
        return 0


def test_topics() -> None:
    topics = Topics("plant/abbe", "Mill 7/East+#")
    assert topics.state == "plant/abbe/Mill_7_East__/state"
    assert topics.verification == "plant/abbe/Mill_7_East__/verification"
    assert topics.alarm == "plant/abbe/Mill_7_East__/alarm"
    assert client_id("Mill 7") == "abbe-Mill_7"
    assert level("") == "_"


@pytest.mark.parametrize("prefix", ["", "/abbe", "abbe/", "abbe/#", "a/+/b", "$SYS"])
def test_prefixes_that_are_no_topic(prefix: str) -> None:
    with pytest.raises(ConfigError, match="topic_prefix"):
        Topics(prefix, "m")


def test_broker_addresses() -> None:
    assert (parse("mqtt://plant").host, parse("mqtt://plant").port) == ("plant", 1883)
    assert parse("mqtts://plant").port == 8883
    assert parse("mqtt://[::1]:2883").host == "::1"
    secret = parse("mqtt://ann:p%40ss@plant:99")
    assert (secret.username, secret.password) == ("ann", "p@ss")
    assert "p@ss" not in repr(secret) + str(secret)


@pytest.mark.parametrize("url", ["http://plant", "mqtt://", "plant:1883", "mqtt://plant:port", "mqtt://u:secretword@plant/a/b"])
def test_addresses_that_are_none(url: str) -> None:
    with pytest.raises(ConfigError) as wrong:
        parse(url)
    assert "secretword" not in str(wrong.value)


def test_the_number_goes_into_the_payload() -> None:
    assert json.loads(with_id(Message(17, "t", '{"schema":1,"machine":"Fräse"}'.encode()))) == {"id": 17, "schema": 1, "machine": "Fräse"}


async def test_no_broker_is_one_warning_and_a_growing_pause() -> None:
    """Eight attempts in the first minute at most, one line in the log, and a stop that does not wait for the pause."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # bound, not listening: connections are refused, and nobody else gets the port
        clock = PacedClock()
        publisher = Publisher(parse(f"mqtt://127.0.0.1:{taken.getsockname()[1]}"), Topics("abbe", "m"), FakeOutbox(), clock)
        with capture_logs() as logs:
            run = asyncio.create_task(publisher.run())
            await clock.at_least(9)
            publisher.stop()
            async with asyncio.timeout(within(2)):
                await run
    assert clock.pauses[:9] == [0.5, 1, 2, 4, 8, 16, 30, 30, 30]
    assert [entry["log_level"] for entry in logs] == ["warning"]


class PacedClock(FakeClock):
    """Sleeps take no time, but are counted."""

    def __init__(self) -> None:
        super().__init__(utc(2026, 6, 1))
        self.pauses: list[float] = []
        self._enough = asyncio.Event()
        self._wanted = 0

    async def sleep(self, s: float) -> None:
        self.pauses.append(s)
        if len(self.pauses) >= self._wanted:
            self._enough.set()
            await asyncio.Event().wait()

    async def at_least(self, pauses: int) -> None:
        self._wanted = pauses
        await self._enough.wait()
