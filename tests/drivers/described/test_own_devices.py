"""Abbe's own laser and control, described by shipped files: they read what their drivers read, and what a file cannot do is refused."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

import numpy as np
import pytest

from abbe.drivers.described.opening import open_control, open_meter
from abbe.drivers.errors import DeviceFault, NotProved
from abbe.drivers.links.urls import parse_url
from abbe.drivers.registry import open_controller, open_laser
from abbe.service.devices.session import open_session
from abbe.service.domain.machine import DeviceUrls
from abbe.simulators.laser.wire import LaserRegisters
from abbe.simulators.modbus_wire import ModbusTcp
from abbe.simulators.scenario import Scenario
from abbe.simulators.world import World
from tests.system.test_interop_modbus import cnc_map


@pytest.fixture
async def laser_url() -> AsyncIterator[str]:
    world = World(Scenario())
    world.laser.mount(np.array([1.0, 0.0, 0.0]), world.tool_position())
    server = ModbusTcp(LaserRegisters(world.laser, 0xBEEF0001, lambda: None, world.tool_position))
    url = f"modbus+tcp://127.0.0.1:{await server.start(0)}"

    async def goes_on() -> None:
        clock = asyncio.get_running_loop().time
        begun_s = clock()
        while True:
            world.advance(clock() - begun_s)
            await asyncio.sleep(0.01)

    going = asyncio.create_task(goes_on())
    yield url
    going.cancel()
    await server.stop()


async def test_the_described_laser_reads_what_its_driver_reads(laser_url: str) -> None:
    driver = await open_laser(laser_url)
    described = await open_meter(parse_url(f"{laser_url}?device=abbe-laser"))
    try:
        with pytest.raises(DeviceFault, match="fault"):  # the file's flag: it does not correct for the air yet
            await described.zero()
        await described.set_environment_compensation(True)
        await described.clear_beam()
        await described.zero()
        one, two = await driver.peek(), await described.peek()
        while two.device_us != one.device_us:  # the same sample for both
            one, two = await driver.peek(), await described.peek()
        assert two.displacement_tenth_nm == one.displacement_tenth_nm != 0
        assert (two.air_temp_c, two.air_pressure_pa) == pytest.approx((one.air_temp_c, one.air_pressure_pa), rel=1e-3)
        assert (await described.identify()).serial_no == (await driver.identify()).serial_no
    finally:
        await described.close()
        await driver.close()


async def test_the_described_control_shows_positions_and_does_nothing() -> None:
    _, registers = cnc_map()
    server = ModbusTcp(registers)
    url = f"modbus+tcp://127.0.0.1:{await server.start(0)}"
    driver, described = await open_controller(url), await open_control(parse_url(f"{url}?device=abbe-control"))
    try:
        one, two = await driver.status(), await described.status()
        assert (two.position_mm, two.conditions) == (one.position_mm, one.conditions & ~(one.conditions ^ two.conditions))
        acts = [described.hold(), described.abort(), described.load_path([]), described.start_path(feed_mm_min=1.0), described.lease(1, 1)]
        acts += [described.release(1), described.seal(0, 1), described.comp_status(), described.table_format(), described.read_bank(0)]
        refused = await asyncio.gather(*acts, return_exceptions=True)
        assert [type(error) for error in refused] == [NotProved] * len(acts)
        assert (await driver.status()).conditions == one.conditions
    finally:
        await described.close()
        await driver.close()
        await server.stop()


async def test_a_session_of_a_job_opens_no_described_device_without_its_report(laser_url: str) -> None:
    with pytest.raises(NotProved, match="abbe device test"):
        async with open_session(DeviceUrls(laser=f"{laser_url}?device=abbe-laser"), listening=True):
            raise AssertionError("opened")
