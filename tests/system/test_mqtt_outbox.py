"""The way out by MQTT with a real Mosquitto: killed for a while, by TLS, away for weeks; and nothing ever comes in by it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, asynccontextmanager, closing
from dataclasses import replace
from pathlib import Path

import aiomqtt
import pytest
from structlog.testing import capture_logs

from abbe.service.clock import SystemClock
from abbe.service.mqtt.broker import TlsFiles, Topics, parse
from abbe.service.mqtt.publisher import Publisher, StoreOutbox
from abbe.service.storage.store import Store
from tests.certificates import authority, issued
from tests.patience import within
from tests.system.serve_bench import Broker, Process, free_port, payload, service

OUTAGE_S = 60.0 if os.environ.get("ABBE_TEST_LONG") == "1" else 3.0
TOPICS = Topics("plant/abbe", "mill-7")
KEPT = 20


@pytest.fixture
def ending() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


class Sender:
    """A publisher with what it said: how often it was connected, lost, and dropped something."""

    def __init__(self, url: str, store: Store, most: int = 10_000, down_to: int = 9_000, **files: str) -> None:
        clock = SystemClock()
        self.changes: asyncio.Queue[bool] = asyncio.Queue()
        self.dropped: asyncio.Queue[int] = asyncio.Queue()
        outbox = StoreOutbox(store.outbox, TOPICS, clock, KEPT, most, down_to)
        self.publisher = Publisher(
            replace(parse(url), files=TlsFiles(**files)), TOPICS, outbox, clock, self.changes.put_nowait, self.dropped.put_nowait
        )

    async def until(self, connected: bool) -> None:
        async with asyncio.timeout(within(40)):
            while await self.changes.get() is not connected:
                pass


@asynccontextmanager
async def running(sender: Sender) -> AsyncIterator[None]:
    task = asyncio.create_task(sender.publisher.run())
    try:
        yield
    finally:
        sender.publisher.stop()
        await task


def put(store: Store, count: int, start: int = 0) -> int:
    """Queue results, each third one an alarm; return the number after the last."""
    for n in range(start, start + count):
        topic = TOPICS.alarm if n % 3 == 2 else TOPICS.verification
        store.outbox.add_document(topic, {"schema": 1, "machine": "mill-7", "n": n})
    return start + count


def numbers(receiver: Process) -> list[int]:
    """What the real client wrote down, in order, without the state."""
    found = [payload(line) for line in receiver.lines if line.startswith("MSG ") and "/state " not in line]
    return [message["n"] for message in found if "n" in message]


async def test_mosquitto_killed_and_everything_comes_afterwards_in_order(tmp_path: Path, store: Store, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    sender = Sender(broker.url, store)
    total = put(store, 30)
    loop = asyncio.get_running_loop()
    async with running(sender):
        await sender.until(True)
        await asyncio.to_thread(receiver.expect, '"n":29')
        async with asyncio.timeout(within(40)):
            while store.outbox.count():  # noqa: ASYNC110 - until the last acknowledgement has come, too
                await asyncio.sleep(0.02)
        # Nothing under way in the broker's file either: what it keeps as not acknowledged it would rightly deliver a second time.
        await asyncio.to_thread(broker.wait_for_file, lambda kept: b'"n":' not in kept)

        await asyncio.to_thread(broker.process.kill)
        await sender.until(False)
        end_s = loop.time() + OUTAGE_S
        while loop.time() < end_s or total <= 60:
            total = put(store, 1, total)
            sender.publisher.wake()
            await asyncio.sleep(0.05)  # the pace of the load
        waited = store.outbox.count()
        await asyncio.to_thread(broker.start)
        await asyncio.to_thread(receiver.expect, f'"n":{total - 1}')
    # All of them were delivered, none twice, none before another: the broker was killed in a moment of quiet.
    assert numbers(receiver) == list(range(total))
    assert waited == total - 30 > 30
    assert store.outbox.count() == 0
    print(f"broker away for {OUTAGE_S:.0f} s: {waited} waited, {total} delivered in order, none twice")  # noqa: T201 - the figure of the test
    late = ending.enter_context(closing(broker.subscriber("late")))
    assert payload(late.expect("mill-7/state"))["state"] == "offline", "the state is retained, and we said goodbye"


async def test_the_table_does_not_grow_with_what_was_delivered(
    tmp_path: Path, store: Store, ending: ExitStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("abbe.service.mqtt.publisher.TIDY_EVERY", 50)
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    put(store, 200)
    sender = Sender(broker.url, store)
    async with running(sender):
        await asyncio.to_thread(receiver.expect, '"n":199')
    assert numbers(receiver) == list(range(200))
    with store.engine.connect() as connection:
        kept = connection.exec_driver_sql("SELECT count(*) FROM outbox").scalar_one()
    assert kept <= KEPT + 100, "after each batch of a hundred, what is older than the newest twenty goes"
    second = Sender(broker.url, store)
    async with running(second):  # tidies up at its start what came after the first one's last look
        put(store, 1, 200)
        second.publisher.wake()
        await asyncio.to_thread(receiver.expect, '"n":200')
    with store.engine.connect() as connection:
        kept = connection.exec_driver_sql("SELECT count(*) FROM outbox").scalar_one()
    assert kept <= KEPT + 1


async def test_a_broker_away_for_weeks_costs_old_alarms_and_no_result(tmp_path: Path, store: Store, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    await asyncio.to_thread(broker.process.kill)
    put(store, 300)  # 200 results, 100 alarms
    sender = Sender(broker.url, store, most=50, down_to=40)
    with capture_logs() as logs:
        async with running(sender):
            async with asyncio.timeout(within(20)):
                assert await sender.dropped.get() == 60
            await asyncio.to_thread(broker.start)
            told = payload(await asyncio.to_thread(receiver.expect, "MQT-001"))
    assert (told["dropped"], told["machine"]) == (60, "mill-7")
    got = numbers(receiver)
    results = [n for n in range(300) if n % 3 != 2]
    assert [n for n in got if n % 3 != 2] == results
    assert [n for n in got if n % 3 == 2] == [n for n in range(300) if n % 3 == 2][60:]
    assert got == sorted(got)
    assert [entry["dropped"] for entry in logs if entry["event"].startswith("broker away for too long")] == [60]


@pytest.mark.parametrize(
    ("case", "reason"),
    [
        ("right", ""),
        ("certificate of ours", ""),
        ("wrong authority", "CERTIFICATE_VERIFY_FAILED"),
        ("only what this computer trusts", "CERTIFICATE_VERIFY_FAILED"),
        ("another host's name", "IP address mismatch"),
        ("no certificate of ours", ""),
    ],
)
async def test_tls_checks_authority_and_host_name(tmp_path: Path, store: Store, ending: ExitStack, case: str, reason: str) -> None:
    ours, foreign = authority(tmp_path, "plant-ca"), authority(tmp_path, "foreign-ca")
    host = "another.test" if case == "another host's name" else "127.0.0.1"
    of_broker = issued(tmp_path, "broker", ours, addresses=(host,))
    of_us = issued(tmp_path, "abbe", ours, addresses=("abbe.test",))
    demands = ["require_certificate true"] if "certificate of ours" in case else []
    broker = Broker(tmp_path, f"cafile {ours.pem}", f"certfile {of_broker.pem}", f"keyfile {of_broker.key_pem}", *demands)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    files = {"ca": str({"wrong authority": foreign.pem, "only what this computer trusts": ""}.get(case, ours.pem))}
    if case == "certificate of ours":
        files |= {"certificate": str(of_us.pem), "key": str(of_us.key_pem)}
    sender = Sender(f"mqtts://127.0.0.1:{broker.tls_port}", store, **files)
    put(store, 5)
    connects = case in {"right", "certificate of ours"}
    with capture_logs() as logs:
        async with running(sender):
            await sender.until(connects)
            if connects:
                await asyncio.to_thread(receiver.expect, '"n":4')
    warned = [entry["reason"] for entry in logs if entry["log_level"] == "warning"]
    if connects:
        assert (numbers(receiver), warned) == ([0, 1, 2, 3, 4], [])
    else:
        assert len(warned) == 1
        assert reason in warned[0]
        assert store.outbox.count() == 5, "nothing was said to a broker that is not ours"


async def test_nothing_is_subscribed_to_and_nothing_ever_sent_to_us(tmp_path: Path, ending: ExitStack) -> None:
    """The broker's own account of the wire while somebody sends commands of every kind, retained ones too."""
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    first = {"schedules": [["x", "* * * * * *", "quick"]], "mqtt": broker.url}
    served = ending.enter_context(closing(service(tmp_path, **first, port=free_port())))
    await asyncio.to_thread(receiver.expect, "mill-7/verification")
    words = ("state", "verification", "alarm", "cmd", "command", "set", "start", "push", "write", "move", "x/y")
    sent = 0
    async with aiomqtt.Client("127.0.0.1", broker.port, identifier="attacker") as attacker:
        for retain in (False, True):
            for word in words:
                for text in ("start", "1", '{"command":"push"}', '{"state":"offline"}', "\x00" * 50, '{"id":1}', ""):
                    await attacker.publish(f"plant/abbe/mill-7/{word}", text, qos=1, retain=retain)
                    sent += 1
    await asyncio.to_thread(receiver.expect, "mill-7/verification")
    code, _ = await asyncio.to_thread(served.terminate)
    assert code == 0
    await asyncio.to_thread(broker.process.terminate)
    log = broker.process.lines
    assert sum("Received PUBLISH from attacker" in line for line in log) == sent == 154
    assert sum("Received PUBLISH from abbe-mill-7" in line for line in log) >= 4
    assert any("Received SUBSCRIBE from receiver" in line for line in log), "the log does show who subscribes"
    assert not [line for line in log if "SUBSCRIBE from abbe-mill-7" in line]
    assert not [line for line in log if "Sending PUBLISH to abbe-mill-7" in line]
