"""A PLC with three positions, by a library that no other part knows: a copy of the shipped file describes it; it is never commanded."""

from __future__ import annotations

import struct
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest
from pyModbusTCP.server import DataBank, ModbusServer

from abbe.drivers.api import Condition, only_listens
from abbe.drivers.conformance.checks import Move
from abbe.drivers.conformance.device_test import Options, device_test
from abbe.drivers.described.opening import open_control
from abbe.drivers.described.tested import Ability
from abbe.drivers.device_file import BUILTIN
from abbe.drivers.errors import NotProved, WrongDevice
from abbe.drivers.links.urls import parse_url
from abbe.drivers.registry import open_controller
from abbe.service.compensation.gate import PushContext, check_preconditions
from abbe.service.compensation.recover import accept, recovered_session
from abbe.service.config import load_machine
from abbe.service.domain.progress import ignore_progress
from abbe.service.errors import ConfigError
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.drivers.described.foreign import free_port
from tests.drivers.described.test_device_test import UTC, kept, verdict

MACHINE = """
name = "mill"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 100]
Y = [0, 100]
Z = [0, 100]
[devices]
cnc = "{url}"
"""


class Plc(DataBank):
    """Positions in um and flags, little-endian to the last byte (DCBA); it asks nobody and is asked."""

    def __init__(self) -> None:
        super().__init__()
        self.at_um = [1000, 2000, 3000]
        self.flags = 0
        self.cycles = 0
        self.stuck = False
        self.written = 0

    def get_holding_registers(self, address: int, number: int = 1, srv_info: object = None) -> list[int]:
        self.cycles += not self.stuck
        data = struct.pack("<I6x", 0x41424245) + bytes(10) + struct.pack("<3iHH", *self.at_um, self.cycles & 0xFFFF, self.flags)
        registers = [*struct.unpack(f">{len(data) // 2}H", data), *[0] * 30]
        return registers[address : address + number]

    get_input_registers = get_holding_registers

    def set_holding_registers(self, address: int, word_list: list[int], srv_info: object = None) -> bool:
        self.written += 1
        return True

    set_coils = set_holding_registers

    async def person(self, text: str) -> None:
        self.at_um = [at + 5000 * (f"axis {axis}" in text) for at, axis in zip((1000, 2000, 3000), "XYZ", strict=True)]


@pytest.fixture
def plc(tmp_path: Path) -> Iterator[tuple[Plc, str]]:
    made, port = Plc(), free_port()
    server = ModbusServer("127.0.0.1", port, no_block=True, data_bank=made)
    server.start()
    file = tmp_path / "plc.toml"
    text = (BUILTIN / "plc-positions.toml").read_text()
    file.write_text(text.replace('order = "CDAB" ', 'order = "DCBA" '))
    yield made, f"modbus+tcp://127.0.0.1:{port}?device={file}"
    server.stop()


async def test_its_positions_and_flags_are_those_of_a_control(plc: tuple[Plc, str], tmp_path: Path) -> None:
    made, url = plc
    report = await device_test(url, Options(move=Move(5.0, 0.01), ask=made.person, faults=False), UTC)
    assert report.failed == ()
    assert report.abilities == (Ability.WATCH, Ability.DWELL)
    assert verdict(report, "byte order") == ("passed", "DCBA, by the identity registers")
    control = await open_controller(f"{url}&tested={kept(report, tmp_path)}")
    made.flags = 0b0011
    status = await control.status()
    assert (status.position_mm, status.conditions) == ((1.0, 2.0, 3.0), Condition.IN_POSITION | Condition.NC_PROGRAM)
    assert only_listens(control)
    await control.close()


async def test_positions_that_are_not_renewed_are_refused(plc: tuple[Plc, str]) -> None:
    made, url = plc
    made.stuck = True
    report = await device_test(url, Options(move=Move(5.0, 0.01), ask=made.person, faults=False), UTC)
    assert "its counter is stuck at" in verdict(report, "readings")[1]
    assert report.abilities == ()


async def test_the_shipped_order_is_not_that_of_this_plc(plc: tuple[Plc, str]) -> None:
    _, url = plc
    with pytest.raises(WrongDevice, match="its byte order is DCBA"):
        await open_control(parse_url(url.partition("?")[0] + "?device=plc-positions"))


async def test_an_axis_the_wrong_way_round_is_named(plc: tuple[Plc, str]) -> None:
    made, url = plc

    async def crossed(text: str) -> None:
        await made.person(text)
        made.at_um[1] = 4000 - made.at_um[1]

    report = await device_test(url, Options(move=Move(5.0, 0.01), ask=crossed, faults=False), UTC)
    assert [one.check for one in report.failed] == ["motion y"]
    assert "sign: the reading grows the wrong way" in report.failed[0].text
    assert report.abilities == ()


async def test_every_way_to_a_table_ends_before_anything_is_written(plc: tuple[Plc, str], tmp_path: Path) -> None:
    made, url = plc
    report = kept(await device_test(url, Options(move=Move(5.0, 0.01), ask=made.person, faults=False), UTC), tmp_path)
    (tmp_path / "mill.toml").write_text(MACHINE.format(url=f"{url}&tested={report.name}"))
    site = site_of(load_machine(tmp_path / "mill.toml").machine)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with recovered_session(store, site) as session:
            ways: list[Callable[[], Awaitable[object]]] = [
                lambda: read_base(session.controller),
                lambda: accept(session.controller, store, site),
                lambda: check_preconditions(PushContext(session, store, site, ignore_progress)),
            ]
            for way in ways:
                with pytest.raises((NotProved, ConfigError)):
                    await way()
            with pytest.raises(NotProved, match="it shows no compensation tables"):
                await read_base(session.controller)
    assert made.written == 0
