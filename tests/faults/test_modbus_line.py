"""What an RTU line that has to prove itself catches, one stale reply at a time."""

from __future__ import annotations

import asyncio
from contextlib import asynccontextmanager

import pytest

from abbe.drivers.errors import BadFrame, LinkDown
from abbe.drivers.links.incidents import Backoff
from abbe.drivers.links.modbus_link import Canary, ModbusLink, ModbusOperation
from abbe.drivers.links.urls import ModbusRtuUrl, parse_url
from abbe.simulators.faults.modbus_toxics import RTU, Frame, parts
from abbe.simulators.faults.rtu_toxic import ToxicRtuLine
from abbe.simulators.faults.scenario import Fault, FaultScenario, scenario
from tests.experiments.campaigns.late_replies import AddressMap
from tests.faults.patient import patience

TIMEOUT_S = 0.4


@pytest.fixture(scope="module", autouse=True)
def _patient():
    with patience():
        yield


class Forger(ToxicRtuLine):
    """A line on which an old reply of exactly the right form comes before the true one."""

    forge = 0

    def _received(self, data: bytes) -> None:
        asked = parts(data, RTU)
        count = int.from_bytes(asked.pdu[3:5], "big")
        if self.forge and asked.pdu[0] in (3, 4) and asked.pdu[1:3] != b"\x00\x00":
            self.forge -= 1
            self.inject(Frame(1, bytes([asked.pdu[0], 2 * count]) + count * b"\x07\x07").bytes(RTU))
        super()._received(data)


@asynccontextmanager
async def forged(canary: Canary | None):
    device = AddressMap()
    line = Forger(device)
    url = parse_url(line.start())
    assert isinstance(url, ModbusRtuUrl)
    link = await ModbusLink.connect(url, timeout_s=TIMEOUT_S, canary=canary, backoff=Backoff(first_s=0.01))
    try:
        yield line, link, device
    finally:
        await link.close()
        line.stop()


async def test_a_stale_reply_of_the_right_form_is_caught_by_the_canary_behind_it():
    async with forged(Canary()) as (line, link, _):
        assert await link.read(3000, 4) == (3000, 3001, 3002, 3003)
        line.play(scenario(Fault("delay_reply", seconds=TIMEOUT_S / 4)))
        line.forge = 1
        assert await link.read(3000, 4) == (3000, 3001, 3002, 3003)
        entries = link.incidents.entries
        assert [entry.kind for entry in entries] == ["detected", "outcome"]
        assert "may belong to an earlier request" in entries[0].text or "does not fit" in entries[0].text


async def test_without_a_canary_nothing_could_tell():
    """The test of the test: this is what the reply above would have done."""
    async with forged(None) as (line, link, _):
        line.play(scenario(Fault("delay_reply", seconds=TIMEOUT_S / 4)))
        line.forge = 1
        assert await link.read(3000, 4) == (0x0707,) * 4


async def test_a_write_whose_echo_cannot_be_trusted_is_in_doubt():
    async with forged(Canary()) as (line, link, device):
        await link.read(3000, 1)
        line.play(scenario(Fault("drop_reply", at=1, times=2)))  # the canary behind the write
        with pytest.raises(BadFrame, match="check registers read after it were wrong"):
            await link.write(500, [1, 2], ModbusOperation.NUMBERED)
        assert device.writes == [(500, (1, 2))]  # sent once: whoever wrote it looks what became of it
        line.play(FaultScenario())
        assert await link.read(500, 2) == (1, 2)
        assert device.writes == [(500, (1, 2))]


async def test_foreign_traffic_is_heard_and_the_line_is_proven_again():
    async with forged(Canary()) as (line, link, _):
        await link.read(3000, 1)
        before = line.requests
        line.inject(b"\x02\x03\x00\x64\x00\x01\xc5\xe6")
        while not link._wire.strays:  # noqa: ASYNC110 - what the link hears sets no event
            await asyncio.sleep(0.001)
        assert await link.read(3000, 1) == (3000,)
        assert link.foreign_bytes == 8
        assert line.requests - before == 3  # canary, read, canary


async def test_a_device_that_shows_another_canary_later_is_not_trusted():
    async with forged(Canary()) as (_, link, device):
        await link.read(3000, 1)
        device.words[0] = 0x0201
        with pytest.raises(LinkDown, match="canary"):
            await link.read(3000, 1)
