"""The service with a real Mosquitto, which is killed and started again in between; test_serve_acceptance.py has a machine beside it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from abbe.service.storage.store import Store
from tests.system.serve_bench import Broker, Process, free_port, payload, service

EVERY_SECOND = ["fast", "* * * * * *", "quick"]


@pytest.fixture
def ending() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def received(receiver: Process) -> list[int]:
    """Return the numbers of the verification messages, as the real client wrote them down, without repeats."""
    lines = [payload(line) for line in receiver.lines if line.startswith("MSG plant/abbe/mill-7/verification ")]
    return list(dict.fromkeys(message["id"] for message in lines))


def test_a_broker_that_dies_twice_and_a_service_that_ends_between_lose_nothing_and_keep_the_order(
    tmp_path: Path, ending: ExitStack
) -> None:
    """What waits goes out when the broker is back, and what waited at the end with the next start; a killed one is said to be offline."""
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    first = ending.enter_context(closing(service(tmp_path, schedules=[EVERY_SECOND], mqtt=broker.url, port=free_port())))
    assert payload(receiver.expect("mill-7/state"))["state"] == "online"
    receiver.expect("mill-7/verification")

    broker.process.kill()
    first.expect("broker not reachable")
    for _ in range(2):
        first.expect('"check done"')
    broker.start()
    first.expect("broker reachable again")
    for _ in range(3):
        receiver.expect("mill-7/verification")
    assert sum("broker not reachable" in line for line in first.lines) == 1, "one warning, not one for every attempt"

    broker.process.kill()
    first.expect("broker not reachable")
    first.expect('"check done"')
    code, took_s = first.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in first.lines)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        kept = sorted(check.id for check in store.verifications.of_machine("mill-7"))
        assert store.outbox.count() > 0
    assert kept[:5] == [1, 2, 3, 4, 5]

    broker.start()
    endless = ["x", "* * * * * *", "endless"]
    second = ending.enter_context(closing(service(tmp_path, schedules=[endless], mqtt=broker.url, port=free_port())))
    assert payload(receiver.expect('"state":"measuring"'))["schedule"] == "x"
    while len(received(receiver)) < len(kept):
        receiver.expect("mill-7/verification")
    second.kill()
    assert payload(receiver.expect('"state":"offline"'))["machine"] == "mill-7"
    assert received(receiver) == kept


def test_a_service_that_starts_without_its_broker_works_and_its_messages_wait_until_the_broker_is_there(
    tmp_path: Path, ending: ExitStack
) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    broker.process.kill()
    running = ending.enter_context(closing(service(tmp_path, schedules=[EVERY_SECOND], mqtt=broker.url, port=free_port())))
    running.expect("broker not reachable")
    for _ in range(2):
        running.expect('"check done"')
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        assert store.outbox.count() >= 2

    broker.start()
    assert payload(receiver.expect('"state":"online"'))["machine"] == "mill-7"
    while len(received(receiver)) < 2:
        receiver.expect("mill-7/verification")
    assert received(receiver)[:2] == [1, 2]
    code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in running.lines)


@pytest.mark.parametrize("lost", [False, True] if os.environ.get("ABBE_TEST_LONG") else [True])
def test_a_defect_ends_the_service_with_a_traceback_and_a_farewell(tmp_path: Path, ending: ExitStack, lost: bool) -> None:
    """systemd starts it again; the slot is claimed, so that the defect is not met a second time at once.

    ``lost``: the broker's acknowledgement swallows the cancellation, as it rarely does.
    """
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    running = ending.enter_context(
        closing(service(tmp_path, schedules=[["x", "*/5 * * * * *", "defect"]], mqtt=broker.url, port=free_port(), lose_cancellations=lost))
    )
    receiver.expect('"state":"online"')
    running.expect("KeyError: 'a defect'")
    assert running.wait() == 1
    receiver.expect('"state":"offline"')
