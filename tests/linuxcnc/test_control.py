"""Our driver at a real control: identity, moves, paths, holds, interlocks, and a table that acts at once."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import pairwise

import numpy as np
import pytest

from abbe.drivers.api import BankState, Condition
from abbe.drivers.cnc.driver import ModbusController
from abbe.drivers.errors import DeviceFault, Refused
from abbe.drivers.links.modbus_link import Canary, ModbusLink
from abbe.drivers.links.urls import parse_url
from abbe.drivers.second_decoder import read_axis_tables
from abbe.drivers.tables import TableImage, crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.devices.session import DeviceUrls
from abbe.service.domain.machine import machine_doc
from abbe.service.push.operations import VerificationResult
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.linuxcnc.instance import Instance
from tests.mbpoll import poll_table
from tests.models.solvers.truth import MACHINE
from tests.patience import within

OWNER = 0xABBE0001
FEED = 20_000.0
READY = Condition.REMOTE | Condition.REFERENCED | Condition.DRIVES_ON | Condition.IN_POSITION


@asynccontextmanager
async def controller(machine: Instance) -> AsyncIterator[ModbusController]:
    """A link that waits longer for a reply than the product: the real-time tasks of LinuxCNC share the cores with other tests."""
    url = parse_url(f"modbus+tcp://127.0.0.1:{machine.port}")
    opened = ModbusController(await ModbusLink.connect(url, timeout_s=within(5.0), canary=Canary()))  # type: ignore[arg-type]
    try:
        await opened.identify()
        yield opened
    finally:
        await opened.close()


async def until(cnc: ModbusController, true) -> None:
    async with asyncio.timeout(within(20)):
        while not true(await cnc.status()):  # noqa: ASYNC110 - another process is asked
            await asyncio.sleep(0.01)


async def push(cnc: ModbusController, image: bytes) -> int:
    """Write, seal, activate; gives the bank."""
    await cnc.lease(OWNER, 60_000)
    bank = 1 - (await cnc.comp_status()).active_bank
    await cnc.write_bank(bank, image)
    assert await cnc.read_bank(bank) == image
    await cnc.seal(bank, OWNER)
    now = await cnc.comp_status()
    assert now.bank_crc[bank] == crc32(image)
    await cnc.activate(bank, expect_crc=crc32(image), expect_gen=now.gen, owner=OWNER)
    return bank


def nine(scale: int, table_id: int = 77) -> TableImage:
    """Nine different one-axis tables with 7, 6 and 10 points, up to 25.6 um times ``scale``."""
    values = tuple(scale * ((37 * n) % 257 - 128) for n in range(3 * 23))
    return TableImage(1, table_id, 100, (0.0, 0.0, 0.0), (100.0, 100.0, 50.0), (7, 6, 10), values)


def wanted(image: bytes, at: tuple[float, float, float]) -> list[float]:
    """Correction of X, Y, Z (mm) by the decoder that shares no code with the encoder: linear between the points."""
    total = [0.0, 0.0, 0.0]
    for (a, i), points in read_axis_tables(image).items():
        q = at["XYZ".index(a)]
        low, high = next((p, r) for p, r in pairwise(points) if p[0] <= q <= r[0])
        total["XYZ".index(i)] += low[1] + (high[1] - low[1]) * (q - low[0]) / (high[0] - low[0])
    return total


def site_of(machine: Instance) -> Site:
    return Site("control", MACHINE, machine_doc("control", MACHINE), DeviceUrls(cnc=f"modbus+tcp://127.0.0.1:{machine.port}"))


def tables_of_nine(image: TableImage) -> NineTables:
    """The same tables in mm, as a solver would give them."""
    values = np.array(image.values) * image.lsb_nm * 1e-6
    parts = np.split(values, np.cumsum([3 * n for n in image.counts])[:-1])
    at = [s + d * np.arange(n) for s, d, n in zip(image.start_mm, image.step_mm, image.counts, strict=True)]
    by = [part.reshape(3, -1).T for part in parts]
    none = [np.zeros_like(b) for b in by]
    return NineTables((at[0], at[1], at[2]), (by[0], by[1], by[2]), (none[0], none[1], none[2]))


async def bring(cnc: ModbusController, store: Store, site: Site, tables: NineTables, *, attended: bool = True) -> PushResult:
    """Push as a job does, with stand-ins for what would be measured."""

    async def yes() -> VerificationResult:
        return VerificationResult(True, "a stand-in")

    wanted = WantedTable(tables, await read_base(cnc), 100, None, {})
    return await Pushing(cnc, store, site, attended=attended).bring(wanted, Questions(list, "a test", yes, yes))


async def test_it_is_one_of_ours_moves_and_runs_a_path(machine):
    async with controller(machine) as cnc:
        assert (await cnc.identify()).firmware.startswith("map 1, 3 axes, table unit 100 nm")
        status = await cnc.status()
        assert status.conditions & READY == READY
        assert (await cnc.block()).alarm_code == 0
        target = (300.0, 100.12345, 50.0)
        assert (await cnc.move(target, feed_mm_min=FEED, timeout_s=20)).position_mm == target
        assert await machine.drives() == pytest.approx(target, abs=1e-9)
        with pytest.raises(Refused, match="strokes"):
            await cnc.move((700.0, 0.0, 0.0), feed_mm_min=FEED, timeout_s=20)
        path = [(300.0 + n, 100.0 + n / 2, 50.0) for n in range(1, 101)]
        await cnc.load_path(path)
        assert await machine.path_rows() == []
        await cnc.start_path(feed_mm_min=3000)
        assert Condition.PATH_RUNNING in (await cnc.status()).conditions
        await until(cnc, lambda s: 0 < s.path_points_done < 100)
        await until(cnc, lambda s: Condition.PATH_RUNNING not in s.conditions)
        end = await cnc.status()
        rows = await machine.path_rows()
        assert end.path_points_done == 100
        assert end.position_mm == path[-1]
        length = sum((b - a) ** 2 for a, b in zip((300.0, 100.12345, 50.0), path[-1], strict=True)) ** 0.5
        assert (end.path_end_us - end.path_start_us) / 1e6 > length / 50.0  # never faster than the feed
        assert len(rows) > 100  # the path output was on all the time
        assert max(abs(row[1] - 100 - (row[0] - 300) / 2) for row in rows if row[0] > 302) < 1e-3  # corners within 1 um


async def test_hold_abort_door_and_emergency_stop(machine):
    async with controller(machine) as cnc:
        move = asyncio.create_task(cnc.move((500.0, 0.0, 0.0), feed_mm_min=1500, timeout_s=60))
        await until(cnc, lambda s: s.position_mm[0] > 2)
        await cnc.hold()
        with pytest.raises(DeviceFault, match="feed hold"):
            await move
        await until(cnc, lambda s: Condition.FEED_HOLD in s.conditions and Condition.MOVING in s.conditions)
        before = None
        async with asyncio.timeout(within(10)):  # it brakes, far from its target
            while before != (before := await machine.drives()):  # noqa: ASYNC110 - another process is asked
                await asyncio.sleep(0.02)
        assert before[0] < 400
        await cnc.abort()
        await until(cnc, lambda s: s.conditions & READY == READY)
        machine.halcmd("sets", "abbe-door-open", "1")
        with pytest.raises(Refused, match="door"):
            await cnc.move((0.0, 0.0, 0.0), feed_mm_min=FEED, timeout_s=20)
        machine.halcmd("sets", "abbe-door-open", "0")
        move = asyncio.create_task(cnc.move((500.0, 0.0, 0.0), feed_mm_min=1500, timeout_s=60))
        await until(cnc, lambda s: Condition.MOVING in s.conditions)
        machine.halcmd("sets", "abbe-estop-ok", "0")
        with pytest.raises(DeviceFault, match="e-stop"):
            await move
        with pytest.raises(Refused):
            await cnc.reset_alarm()
        machine.halcmd("sets", "abbe-estop-ok", "1")
        where = await machine.drives()
        await cnc.reset_alarm()
        await cnc.resume()
        await until(cnc, lambda s: s.conditions & READY == READY)
        assert await machine.drives() == where  # it does not go on by itself
        assert (await cnc.move((10.0, 0.0, 0.0), feed_mm_min=FEED, timeout_s=20)).position_mm == (10.0, 0.0, 0.0)


async def test_a_table_acts_at_once(machine):
    image = encode(nine(1))
    async with controller(machine) as cnc:
        await cnc.move((250.0, 130.0, 170.0), feed_mm_min=FEED, timeout_s=20)
        assert await machine.drives() == (250.0, 130.0, 170.0)
        bank = await push(cnc, image)
        now = await cnc.comp_status()
        assert (now.active_bank, now.bank_state[bank]) == (bank, BankState.SEALED)
        for target in ((250.0, 130.0, 170.0), (17.0, 499.0, 3.0), (599.0, 1.0, 449.0)):
            await cnc.move(target, feed_mm_min=FEED, timeout_s=20)
            added = [d - t for d, t in zip(await machine.drives(), target, strict=True)]
            assert added == pytest.approx(wanted(image, target), abs=1e-9)
        with pytest.raises(Refused, match="generation"):
            await cnc.activate(1 - bank, expect_crc=now.bank_crc[1 - bank], expect_gen=now.gen - 1, owner=OWNER)


async def test_anybodys_modbus_reads_the_numbers_that_were_pushed(machine, tmp_path):
    """The whole way of a table: the push machine writes it through our driver, mbpoll reads it."""
    tables = tables_of_nine(nine(1))
    site = site_of(machine)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with controller(machine) as cnc:
            pushed = await bring(cnc, store, site, tables)
            assert pushed.kept
            now = await cnc.comp_status()
            read = await cnc.read_bank(now.active_bank)
    found = await poll_table(machine.port)
    assert found.bank == now.active_bank
    assert found.table_id == int.from_bytes(read[8:12], "big")
    for a in range(3):
        assert found.position_mm[a] == pytest.approx(list(tables.position_mm[a]), abs=1e-9)
        for i in range(3):
            assert found.correction_mm[a][i] == pytest.approx(list(tables.correction_mm[a][:, i]), abs=1e-9)
    assert len({v for one in found.correction_mm for each in one for v in each}) > 50  # not all the same by chance


async def test_the_bridge_keeps_every_promise_of_a_safe_push(machine, tmp_path):
    site = site_of(machine)
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        async with controller(machine) as cnc:
            assert (await bring(cnc, store, site, tables_of_nine(nine(1)))).kept
            before = await cnc.comp_status()
            async with asyncio.timeout(within(5)):  # the pins follow in the control's next periods
                while not any(added := await machine.hal("abbe-corr-x", "abbe-corr-y", "abbe-corr-z")):
                    pass
            found = await commission_levels(cnc, store, site)
            after = await cnc.comp_status()
            assert found.capabilities.level == 3, found.rows()
            assert (after.active_bank, after.lease_owner) == (before.active_bank, 0)
            assert after.bank_crc[after.active_bank] == before.bank_crc[before.active_bank]
            assert await machine.hal("abbe-corr-x", "abbe-corr-y", "abbe-corr-z") == added
            assert (await bring(cnc, store, site, tables_of_nine(nine(-1)), attended=False)).kept


async def test_two_controls_at_the_same_time_know_nothing_of_each_other(instances):
    begin = time.monotonic()
    pair = [instances(), instances()]
    await asyncio.gather(*(one.start() for one in pair))

    async def play(machine: Instance, scale: int) -> tuple[float, ...]:
        async with controller(machine) as cnc:
            image = encode(nine(scale))
            await push(cnc, image)
            await cnc.move((250.0, 130.0, 170.0), feed_mm_min=FEED, timeout_s=20)
            added = tuple(d - t for d, t in zip(await machine.drives(), (250.0, 130.0, 170.0), strict=True))
            assert added == pytest.approx(wanted(image, (250.0, 130.0, 170.0)), abs=1e-9)
            return added

    one, two = await asyncio.gather(play(pair[0], 1), play(pair[1], -2))
    assert two == pytest.approx(tuple(-2 * v for v in one), abs=1e-9)
    await asyncio.gather(*(each.stop() for each in pair))
    assert time.monotonic() - begin < 90
