"""The laser driver against a meter on a real socket or pty that can misbehave."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import pytest

from abbe.drivers.errors import DeviceFault, LinkDown, Rebooted, Refused, ReplyTimeout, WrongDevice
from abbe.drivers.laser.driver import ModbusLaser
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.urls import parse_url
from abbe.drivers.registry import open_laser
from tests.patience import within

ZEROED = 1 << 2


class ProgressMeter:
    """A laser displacement meter behind a Modbus peer."""

    def __init__(self, peer) -> None:
        self.peer = peer
        self.commands: list[tuple[int, int]] = []
        self.result = 0
        self.boot(7)
        peer.on_write = self.written
        self.advance_per_read = 1
        peer.on_read = self.read

    def boot(self, boot_id: int) -> None:
        self.peer.put(0, "ifH", 0x01020304, 1234.5, 1)
        self.peer.put(5, "II", boot_id, 4242)
        self.peer.put(43, "HH", 0, 0)
        self.count = 0
        self.status = ZEROED

    def read(self, address: int, count: int) -> None:
        if (address, count) == (10, 18):
            self.count += self.advance_per_read
            self.peer.put(10, "IQqHHhIHI", self.count, 50_000 * self.count, -123_456, 900, self.status, 2013, 101_325, 455, 2_700_000)

    def written(self, address: int, values: tuple[int, ...]) -> int | None:
        if address != 40 or len(values) != 3:
            return 2
        number, command, argument = values
        if number == (self.peer.words[43] + 1) & 0xFFFF:
            self.commands.append((command, argument))
            self.peer.put(43, "HH", number, self.result)
        return None


@pytest.fixture
def meter(peer) -> ProgressMeter:
    return ProgressMeter(peer)


@pytest.fixture
async def laser(peer, meter) -> AsyncIterator[ModbusLaser]:
    opened = ModbusLaser(await ModbusLink.connect(parse_url(peer.url), timeout_s=0.15), read_timeout_s=0.3)
    yield opened
    await opened.close()


async def test_identify(laser):
    info = await laser.identify()
    assert (info.kind, info.serial_no, info.boot_id, info.firmware) == ("laser", "4242", 7, "map 1")


async def test_read(laser):
    reading = await laser.read()
    assert (reading.sample_count, reading.device_us, reading.displacement_tenth_nm) == (1, 50_000, -123_456)
    assert (reading.air_temp_c, reading.air_pressure_pa, reading.humidity_percent) == (20.13, 101_325.0, 45.5)
    assert reading.refractivity == pytest.approx(2.7e-4)


async def test_read_waits_for_a_newer_sample(laser):
    reading = await laser.read(after_count=4)
    assert reading.sample_count == 5


async def test_read_waits_across_the_wrap_of_the_count(laser, meter):
    meter.count = 2**32 - 3

    def wrap(address: int, count: int) -> None:
        meter.read(address, count)
        if meter.count == 2**32 - 1:
            meter.count = -1

    meter.peer.on_read = wrap
    assert (await laser.read(after_count=2**32 - 2)).sample_count == 2**32 - 1


async def test_no_new_sample_is_a_timeout(laser, meter):
    meter.advance_per_read = 0
    with pytest.raises(ReplyTimeout, match="no sample after number 5"):
        await laser.read(after_count=5)


@pytest.mark.parametrize(
    ("status", "why"), [(1 | ZEROED, "counts are lost"), (1 << 4 | ZEROED, "no reflector"), (1 << 4 | 1, "no reflector"), (0, "not zeroed")]
)
async def test_a_lost_beam_is_a_fault_with_a_remedy(laser, meter, status, why):
    meter.status = status
    with pytest.raises(DeviceFault, match=why) as caught:
        await laser.read()
    assert "zero" in caught.value.remedy


async def test_a_low_signal_is_still_a_reading(laser, meter):
    meter.status = ZEROED | 2
    assert (await laser.read()).status & 2


async def test_commands(laser, meter):
    await laser.zero()
    await laser.clear_beam()
    await laser.set_environment_compensation(True)
    assert meter.commands == [(1, 0), (2, 0), (3, 1)]


async def test_after_a_command_the_sample_still_shown_is_not_taken(laser, meter):
    """A command acts on the samples after it; the one being shown is the old state and would read as a wrong displacement."""
    await laser.read()
    await laser.zero()
    shown = meter.count
    assert (await laser.read()).sample_count > shown
    meter.advance_per_read = 0
    assert (await laser.read()).sample_count == shown + 1  # the wait is for the first reading only
    await laser.zero()
    with pytest.raises(ReplyTimeout, match="no sample after"):
        await laser.read()


async def test_a_refused_command(laser, meter):
    meter.result = 2
    with pytest.raises(Refused, match="beam blocked"):
        await laser.zero()


async def test_a_command_number_wraps(laser, meter):
    meter.peer.put(43, "H", 0xFFFF)
    await laser.zero()
    assert meter.peer.words[43] == 0


@pytest.mark.parametrize("executed", [True, False])
async def test_a_lost_answer_to_a_command_is_decided_by_the_acknowledge_never_by_repeating(laser, meter, executed):
    await laser.identify()
    before = meter.peer.words[43]

    async def lose(exchange) -> None:
        if not executed:
            meter.commands.clear()
            meter.peer.put(43, "H", before)

    async def honest(exchange) -> None:
        exchange.reply()

    meter.peer.tricks = [honest, honest, lose]  # identity, acknowledge, then the command itself
    if executed:
        await laser.zero()
        assert meter.commands == [(1, 0)]
    else:
        with pytest.raises(ReplyTimeout) as caught:
            await laser.zero()
        assert "not executed" in caught.value.__notes__[0]
    assert [request[0] for request in meter.peer.requests].count(16) == 1


@pytest.mark.parametrize(
    ("put", "why"),
    [
        ((0, "I", 0x03040102), "swapped"),
        ((0, "I", 0x02010403), "swapped"),
        ((2, "f", -1234.5), "canary"),
        ((4, "H", 2), "map version 2"),
    ],
)
async def test_wrong_devices(peer, meter, put, why):
    peer.put(*put)
    with pytest.raises(WrongDevice, match=why):
        await open_laser(peer.url)


async def test_a_reboot_is_noticed_by_the_clock(laser, meter):
    await laser.identify()
    await laser.read(after_count=9)
    meter.boot(8)
    with pytest.raises(Rebooted):
        await laser.read()
    with pytest.raises(Rebooted):
        await laser.zero()
    assert meter.commands == []
    await laser.identify()
    assert (await laser.read()).sample_count >= 1


async def test_a_reboot_behind_a_reconnect_is_noticed_although_the_clock_went_on(tcp_peer):
    meter = ProgressMeter(tcp_peer)
    laser = await open_laser(tcp_peer.url)
    await laser.read()
    meter.boot(8)
    meter.count = 1000

    async def hang_up(exchange) -> None:
        exchange.hang_up()

    tcp_peer.tricks = [hang_up]
    with pytest.raises(Rebooted):
        await laser.read()
    await laser.close()


async def test_cancel_during_a_command(laser, meter):
    release = asyncio.Event()

    async def late(exchange) -> None:
        await release.wait()
        exchange.reply()

    async def honest(exchange) -> None:
        exchange.reply()

    meter.peer.tricks = [honest, honest, late]
    task = asyncio.create_task(laser.zero())
    async with asyncio.timeout(within(2)):
        while len(meter.peer.requests) < 3:
            meter.peer.asked.clear()
            await meter.peer.asked.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    release.set()
    await laser.zero()
    assert meter.commands == [(1, 0), (1, 0)]
    assert meter.peer.words[43] == 2


async def test_unplugged(tcp_peer):
    meter = ProgressMeter(tcp_peer)
    laser = await open_laser(tcp_peer.url)
    await tcp_peer.stop()
    with pytest.raises(LinkDown):
        await laser.read()
    assert meter.commands == []
    await laser.close()
