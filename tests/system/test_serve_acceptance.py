"""The whole service against the simulated machine: two checks by itself, a broker killed in between, the page, a stop while measuring."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from pathlib import Path

import pytest

from abbe.drivers.registry import open_controller
from abbe.service.config import load_machine
from abbe.service.storage.store import Store
from tests.system.serve_bench import Broker, Machine, abbe, free_port, payload
from tests.system.test_serve_page import browser, only_us, open_page, shot

pytestmark = [pytest.mark.scenario, pytest.mark.browser, pytest.mark.timeout(240)]

SPEED, QUICK = 150.0, "quick-check at 20 Hz"
"""The ball-bar still sends 3000 readings a second."""


@pytest.fixture
def ending() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


def sections(broker: Broker, port: int, cron: str) -> list[str]:
    timetable = ["[[schedule]]", 'name = "often"', f"cron = {json.dumps(cron)}", f'recipe = "{QUICK}"']
    return ["[mqtt]", f'url = "{broker.url}"', 'topic_prefix = "plant/abbe"', "[web]", f"port = {port}", *timetable]


@pytest.mark.skipif(
    os.environ.get("ABBE_TEST_LONG") != "1",
    reason="its parts: test_serve_mqtt, test_serve_page, test_serve_processes; ABBE_TEST_LONG=1 plays the whole",
)
def test_two_scheduled_checks_and_a_broker_that_dies(tmp_path: Path, ending: ExitStack) -> None:
    port, started_s = free_port(), time.monotonic()
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    machine = Machine(tmp_path, SPEED, *sections(broker, port, "*/10 * * * * *"))
    ending.callback(machine.process.close)
    running = ending.enter_context(closing(abbe("serve", "-m", machine.file)))

    receiver.expect("mill-7/verification", 120)
    broker.process.kill()
    running.expect('"check done"', 120)
    running.expect('"check done"', 120)
    broker.start()
    receiver.expect("mill-7/verification", 60)
    took_s = time.monotonic() - started_s

    with browser() as seen:
        open_page(seen, port)
        assert seen.page.locator("tr[data-id]").count() >= 2
        assert seen.page.locator("svg.trend").count() == 2
        assert "mqtt://127.0.0.1" in seen.page.locator("main").inner_text()
        shot(seen.page, "serve-acceptance.png")
        assert seen.errors == []
        assert only_us(seen)

    code, stop_s = running.terminate()
    assert (code, stop_s < 5.0) == (0, True)
    assert took_s < 180.0
    receiver.expect('"state":"offline"')
    got = [payload(line) for line in receiver.lines if "/verification " in line]
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        kept = store.verifications.of_machine("mill-7")
        waiting = [json.loads(row.payload)["verification"] for row in store.outbox.pending()]
    assert all(check.campaign_id is not None for check in kept)
    assert sorted({message["verification"] for message in got} | set(waiting)) == sorted(check.id for check in kept)
    assert {"body_diagonal_um", "helix_rms_um"} <= got[0]["values"].keys()


def test_sigterm_while_the_machine_moves(tmp_path: Path, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    machine = Machine(tmp_path, 5.0, *sections(broker, free_port(), "* * * * * *"))
    ending.callback(machine.process.close)
    running = ending.enter_context(closing(abbe("serve", "-m", machine.file)))
    receiver.expect('"state":"measuring"')
    running.expect("skipped")
    code, stop_s = running.terminate()
    assert (code, stop_s < 5.0) == (0, True)
    assert not any("Traceback" in line for line in running.lines)
    receiver.expect('"state":"offline"')
    asyncio.run(stands_still(load_machine(machine.file).machine.devices.cnc or ""))


async def stands_still(url: str) -> None:
    """Ask the controller over a connection of our own, for a second of its time, whether its axes move."""
    controller = await open_controller(url)
    try:
        first = await controller.status()
        now = first
        while now.ctrl_us - first.ctrl_us < 1_000_000:
            assert not now.moving
            assert not now.path_running
            assert now.position_mm == first.position_mm
            now = await controller.status()
    finally:
        await controller.close()


def test_the_machine_goes_away_and_the_service_says_so(tmp_path: Path, ending: ExitStack) -> None:
    broker = Broker(tmp_path)
    ending.callback(lambda: broker.process.close())
    receiver = ending.enter_context(closing(broker.subscriber()))
    machine = Machine(tmp_path, 5.0, *sections(broker, free_port(), "*/2 * * * * *"))
    ending.callback(machine.process.close)
    running = ending.enter_context(closing(abbe("serve", "-m", machine.file)))
    receiver.expect('"state":"measuring"')
    machine.process.kill()
    result = payload(receiver.expect("mill-7/verification", 60))
    code = result["cause"]["code"]
    assert result["verdict"] == "cannot tell"
    assert code.startswith("DRV") or code == "SEQ-011"  # one device by its own code; several that do not answer are told together
    alarm = payload(receiver.expect(f'"code":"{code}'))
    assert alarm["machine"] == "mill-7"
    running.expect('"slot done"')
    running.expect('"check done"', 60)  # the loop goes on
    assert running.terminate()[0] == 0


GOOD = """
name = "mill-7"
chain = "w-X-Y-b-Z-t"
stroke_mm = {X = [0, 600], Y = [0, 500], Z = [0, 450]}
[devices]
cnc = "modbus+tcp://127.0.0.1:1502"
ballbar = "socket://127.0.0.1:4001"
laser = "modbus+rtu:///dev/ttyS0?baud=115200"
fixture = "fixture+tcp://127.0.0.1:4002"
[web]
port = 0
[[schedule]]
name = "often"
cron = "0 6 * * 1"
recipe = "quick-check"
"""
BAD = {
    "no-such": GOOD.replace('recipe = "quick-check"', 'recipe = "no-such"'),
    "0.0.0.0": GOOD.replace("[web]", '[web]\nhost = "0.0.0.0"'),
    "cron": GOOD.replace("0 6 * * 1", "0 25 * * 1"),
}


@pytest.mark.parametrize("told", BAD)
def test_a_bad_machine_file_is_one_line_and_exit_code_2(tmp_path: Path, refused: Callable[..., list[str]], told: str) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(BAD[told])
    (line,) = refused(file)
    assert line.startswith("error CFG-001: ")
    assert told in line


def test_a_port_that_is_taken_is_one_line_and_exit_code_2(tmp_path: Path, refused: Callable[..., list[str]]) -> None:
    file = tmp_path / "machine.toml"
    file.write_text(GOOD)
    with socket.create_server(("127.0.0.1", 0)) as other:
        (line,) = refused(file, "--port", str(other.getsockname()[1]))
    assert line.startswith("error ")
