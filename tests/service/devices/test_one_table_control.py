"""A control with one table, opened by a plug-in.

Nothing is written until its lower level was commissioned by name; then tables are pushed and taken back, attended.
"""

from __future__ import annotations

import asyncio
import importlib
import threading
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.api import BankState
from abbe.drivers.errors import DriverError
from abbe.drivers.tables import crc32
from abbe.models.compensation.tables import NineTables
from abbe.service.cli import run
from abbe.service.compensation.commission_levels import commission_levels
from abbe.service.compensation.commission_one_bank import commission_one_bank
from abbe.service.compensation.proved_levels import check_level
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session, open_session
from abbe.service.errors import DoorOpen, PushNotBegun, StillActive, TableMismatch, TableRefused
from abbe.service.push.operations import VerificationResult
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.drivers.acme.control import serving
from tests.drivers.acme.one_table import OneTableControl
from tests.patience import within
from tests.service.devices.test_second_controller import RAW, machine_with


@pytest.fixture
async def control() -> AsyncIterator[OneTableControl]:
    async with serving(OneTableControl(RAW)) as served:
        yield served


@pytest.fixture
def driver_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    info = tmp_path / "site" / "acme_driver-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-driver\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[abbe.drivers]\nacme = tests.drivers.acme.one_table:DRIVER\n")
    monkeypatch.syspath_prepend(str(info.parent))
    importlib.invalidate_caches()


@pytest.fixture
def site(driver_installed: None, control: OneTableControl, tmp_path: Path) -> Site:
    return machine_with(tmp_path, f"acme://127.0.0.1:{control.port}")


@pytest.fixture
async def session(site: Site) -> AsyncIterator[Session]:
    async with open_session(site.urls) as opened:
        yield opened


@pytest.fixture
def store(tmp_path: Path):
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as opened:
        yield opened


def tables() -> NineTables:
    grid = tuple(np.linspace(low, high, 5) for low, high in ((0, 600), (0, 500), (0, 450)))
    curves = tuple(1e-3 * np.outer(np.arange(5.0), [1.0, -1.0, 2.0]) for _ in range(3))
    return NineTables(grid, curves, tuple(np.zeros((5, 3)) for _ in range(3)))


async def push(session: Session, store: Store, site: Site, *, better: bool):
    async def probe() -> VerificationResult:
        return VerificationResult(True, "as predicted")

    async def verify() -> VerificationResult:
        return VerificationResult(better, "better" if better else "not better")

    wanted = WantedTable(tables(), await read_base(session.controller), 100, None, {})
    return await Pushing(session.controller, store, site).bring(wanted, Questions(list, "a test", probe, verify))


async def test_nothing_is_written_before_its_level_was_commissioned_by_name(session, control, store, site) -> None:
    with pytest.raises(TableRefused, match="can only be read"):
        await check_level(session.controller, store, site)
    with pytest.raises(TableRefused, match=r"one table.*commission that lower level by name: abbe comp commission --one-bank"):
        await commission_levels(session.controller, store, site)
    with pytest.raises(TableRefused, match="can only be read"):
        await push(session, store, site, better=True)
    assert (control.acts, bytes(control.banks[0]).startswith(RAW)) == (True, True)


async def test_it_is_pushed_attended_and_taken_back(session, control, store, site) -> None:
    found = await commission_one_bank(session.controller, store, site)
    assert (found.capabilities.level, control.acts) == (1, True), found.rows()
    with pytest.raises(TableRefused, match="a person who approves has to be at the machine"):
        await check_level(session.controller, store, site, attended=False)
    assert (await check_level(session.controller, store, site)).level == 1

    back = await push(session, store, site, better=False)
    assert (back.kept, control.acts, (await read_base(session.controller)).image) == (False, True, RAW)
    kept = await push(session, store, site, better=True)
    base = await read_base(session.controller)
    assert (kept.kept, kept.crc, control.acts) == (True, crc32(base.image), True)
    assert base.status.bank_state[base.status.active_bank] is BankState.SEALED


@pytest.mark.parametrize(
    ("lacks", "said"),
    [
        ({"guards": False}, "accepts a write while the table acts"),
        ({"compares": False}, "accepts to switch off with another CRC"),
    ],
)
async def test_a_control_that_does_not_do_its_part_is_not_commissioned(session, control, store, site, lacks, said) -> None:
    vars(control).update(lacks)
    found = await commission_one_bank(session.controller, store, site)
    assert found.capabilities.level == 0
    assert any(said in row[2] for row in found.rows() if row[0] == "can_disable"), found.rows()
    assert control.acts
    with pytest.raises(TableRefused, match="can only be read"):
        await check_level(session.controller, store, site)


async def test_it_is_not_commissioned_with_the_door_open(session, control, store, site) -> None:
    control.flags += "d"
    with pytest.raises(DoorOpen):
        await commission_one_bank(session.controller, store, site)
    assert control.number == 0


@pytest.mark.parametrize("word", ["switch", "write", "read"])
async def test_a_line_that_breaks_while_tables_are_exchanged(control, store, site, word) -> None:
    """The push ends without a table that acts, or with the old one; the next session puts the old one back."""
    async with open_session(site.urls) as session:
        await commission_one_bank(session.controller, store, site)
        await push(session, store, site, better=True)
        old = (await read_base(session.controller)).image
        number = control.number

        async def probe() -> VerificationResult:
            raise AssertionError("nothing is measured")

        wanted = WantedTable(tables(), await read_base(session.controller), 100, None, {})
        pushing = Pushing(session.controller, store, site)
        control.hangs_up_at, control.from_number = word, number + 1  # from the switching off on
        with pytest.raises((StillActive, PushNotBegun, TableMismatch, DriverError)):
            await pushing.bring(wanted, Questions(list, "a test", probe, probe))
    assert (control.acts, control.hangs_up_at) == (False, "")
    async with open_session(site.urls) as session:
        await recover(session.controller, store, site)
        assert (control.acts, (await read_base(session.controller)).image) == (True, old)


@contextmanager
def served_in_a_thread(control: OneTableControl) -> Iterator[None]:
    """The command line has an event loop of its own."""
    started, loops = threading.Event(), []

    async def serve() -> None:
        async with serving(control):
            loops.append((asyncio.get_running_loop(), asyncio.Event()))
            started.set()
            await loops[0][1].wait()

    thread = threading.Thread(target=asyncio.run, args=(serve(),))
    thread.start()
    assert started.wait(within(10))
    try:
        yield
    finally:
        loop, stop = loops[0]
        loop.call_soon_threadsafe(stop.set)
        thread.join(within(10))


@pytest.mark.usefixtures("driver_installed")
def test_its_level_by_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Without the option it says what to ask for; with it the level is L1."""
    monkeypatch.chdir(tmp_path)
    control = OneTableControl(RAW)
    with served_in_a_thread(control):
        machine_with(tmp_path, f"acme://127.0.0.1:{control.port}")
        words = ["comp", "commission", "--levels-only", "-m", "mill.toml"]
        assert run(words) == 2
        assert "commission that lower level by name: abbe comp commission --one-bank" in capsys.readouterr().err
        assert run([*words, "--one-bank"]) == 0
    said = capsys.readouterr().out
    assert "level L1: attended pushes; no table acts while tables are exchanged" in said
    assert "can_disable" in said
    assert control.acts
