"""The service with a real Mosquitto, which is killed and started again in between."""

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


def test_broker_killed_and_restarted_nothing_lost_nothing_out_of_order(tmp_path: Path, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    running = ending.enter_context(closing(service(tmp_path, schedules=[EVERY_SECOND], mqtt=broker.url, port=free_port())))

    assert payload(receiver.expect("mill-7/state"))["state"] == "online"
    for _ in range(2):
        receiver.expect("mill-7/verification")

    broker.process.kill()
    running.expect("broker not reachable")
    for _ in range(3):
        running.expect('"check done"')
    broker.start()
    running.expect("broker reachable again")
    for _ in range(3):
        running.expect('"check done"')

    code, took_s = running.terminate()
    assert (code, took_s < 5.0) == (0, True)
    assert payload(receiver.expect('"state":"offline"'))["machine"] == "mill-7"
    receiver.terminate()

    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        kept = sorted(check.id for check in store.verifications.of_machine("mill-7"))
        waiting = [row.id for row in store.outbox.pending()]
    assert len(kept) >= 8
    numbers = received(receiver)
    assert numbers == sorted(numbers)
    assert len(numbers) + len(waiting) == len(kept), "a message is neither delivered nor waiting"
    assert sum("broker not reachable" in line for line in running.lines) == 1, "one warning, not one for every attempt"
    assert not any("Traceback" in line for line in running.lines)


def test_messages_wait_for_the_next_start_and_the_broker_says_offline_when_the_service_is_killed(tmp_path: Path, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    broker.process.kill()
    first = ending.enter_context(closing(service(tmp_path, schedules=[EVERY_SECOND], mqtt=broker.url, port=free_port())))
    for _ in range(2):
        first.expect('"check done"')
    first.terminate()
    first.wait()
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        kept = sorted(check.id for check in store.verifications.of_machine("mill-7"))

    broker.start()
    endless = ["x", "* * * * * *", "endless"]
    second = ending.enter_context(closing(service(tmp_path, schedules=[endless], mqtt=broker.url, port=free_port())))
    assert payload(receiver.expect('"state":"measuring"'))["schedule"] == "x"
    while len(received(receiver)) < len(kept):
        receiver.expect("mill-7/verification")
    second.kill()
    assert payload(receiver.expect('"state":"offline"'))["machine"] == "mill-7"
    assert received(receiver) == kept
    assert kept[:2] == [1, 2]


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
