"""Tables that the control reads at its start only: staged, not active, until it has been started anew; and read back from the control."""

from __future__ import annotations

import math

import pytest

from abbe.drivers.api import BankState
from abbe.drivers.errors import Refused
from abbe.drivers.second_decoder import read_axis_tables
from abbe.drivers.tables import TableImage, crc32, encode
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.recover import accept
from abbe.service.storage.store import Store
from tests.linuxcnc.test_control import FEED, OWNER, controller, nine, push, site_of, until, wanted

POINTS = 121


def pitch(fine: bool) -> TableImage:
    """121 points of X every 5 mm that no 16-point curve follows, 2 points for what else X could correct; straight lines for the rest."""
    xx = tuple(round(120 * math.sin(n / 3) + (n % 7) * 4) if fine else n for n in range(POINTS))
    straight = tuple(range(POINTS))
    yz = tuple(3 * n for n in range(3 * 6)) + tuple(-n for n in range(3 * 10))
    return TableImage(1, 9, 100, (0.0, 0.0, 0.0), (5.0, 100.0, 50.0), (POINTS, 6, 10), xx + straight + straight + yz)


async def settled(machine, joint: int) -> float:
    """What the control adds to a joint's command, once it has stopped slewing."""
    while True:
        aim, applied = await machine.hal(f"joint.{joint}.backlash-corr", f"joint.{joint}.backlash-filt")
        if abs(aim - applied) < 1e-12:
            return applied


async def test_a_table_of_files_is_staged_until_the_control_starts_anew_and_then_read_back_from_it(machine, tmp_path):
    image = encode(pitch(fine=True))
    table = dict(read_axis_tables(image)["X", "X"])
    async with controller(machine) as cnc:
        boot = (await cnc.identify()).boot_id
        with pytest.raises(Refused, match="staged"):
            await push(cnc, image)
        now = await cnc.comp_status()
        assert (now.active_bank, now.bank_state, now.bank_crc[1]) == (0, (BankState.SEALED, BankState.LAID_ASIDE), crc32(image))
        await cnc.move((100.0, 0.0, 0.0), feed_mm_min=FEED, timeout_s=20)
        assert await settled(machine, 0) == 0.0  # staged is not active
    await machine.stop()
    await machine.start()
    async with controller(machine) as cnc:
        now = await cnc.comp_status()
        assert now.boot_id != boot
        assert (now.active_bank, now.bank_state, now.bank_crc[0]) == (0, (BankState.SEALED, BankState.EMPTY), crc32(image))
        assert await cnc.read_bank(0) == image
        for x in (100.0, 5.0, 335.0, 600.0, 0.0):
            await cnc.move((x, 0.0, 0.0), feed_mm_min=FEED, timeout_s=20)
            # The control computes it last in the cycle before it stands: a nanometre at most.
            assert await settled(machine, 0) == pytest.approx(table[x], abs=1e-6)
            (added,) = await machine.hal("abbe-corr-y")  # the same image's cross terms act in the network
            assert added == pytest.approx(wanted(image, (x, 0.0, 0.0))[1], abs=1e-9)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            await accept(cnc, store, site_of(machine), "a person")  # this database did not push it
            found = await commission_levels(cnc, store, site_of(machine))
        assert found.capabilities.level == 3, found.rows()
        now = await cnc.comp_status()
        assert (now.active_bank, now.bank_crc[0], now.lease_owner) == (0, crc32(image), 0)
        assert await settled(machine, 0) == pytest.approx(table[0.0], abs=1e-6)
        # Another table without files cannot act while those act: it waits for a start as well.
        with pytest.raises(Refused, match="staged"):
            await push(cnc, encode(nine(1)))
        assert (await cnc.comp_status()).active_bank == 0
        # Given up: what is written anew is staged no longer.
        await cnc.write_bank(1, encode(nine(2)))
        assert (await cnc.comp_status()).bank_state == (BankState.SEALED, BankState.WRITING)
    assert (machine.run / "tables").resolve().name == f"set-{crc32(image):08x}"


async def test_what_the_control_cannot_reproduce_is_not_sealed(machine):
    many = pitch(fine=True)
    swapped = TableImage(
        1,
        9,
        100,
        many.start_mm,
        many.step_mm,
        many.counts,
        many.values[POINTS : 2 * POINTS] + many.values[:POINTS] + many.values[2 * POINTS :],
    )
    async with controller(machine) as cnc:
        with pytest.raises(Refused, match="valid image"):
            await push(cnc, encode(swapped))
        status = await cnc.comp_status()
        assert (status.active_bank, status.bank_state) == (0, (BankState.SEALED, BankState.WRITING))
        await cnc.release(OWNER)
        await until(cnc, lambda s: not s.compensation_on)
