"""A control with another wire, other units, other states and another URL scheme is opened, watched, moved and corrected by the service
as it is: a driver and one entry point are all that it takes (decision 0034)."""

from __future__ import annotations

import importlib
import re
from collections.abc import AsyncIterator
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.api import BankState, Condition
from abbe.drivers.errors import BadUrl, Refused
from abbe.drivers.tables import TableImage, crc32, encode
from abbe.models.compensation.tables import NineTables
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.config import load_machine
from abbe.service.devices.session import Session, open_session
from abbe.service.errors import ConfigError, DoorOpen
from abbe.service.push.operations import VerificationResult
from abbe.service.sequences.control import Control, check_interlocks
from abbe.service.sequences.paths import follow_path
from abbe.service.sequences.steps import FollowPath
from abbe.service.site import Site, site_of
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.drivers.acme.control import AcmeControl, serving
from tests.pretended import as_if_commissioned

ROOT = Path(__file__).resolve().parents[3]
RAW = encode(TableImage(0, 1, 100, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0, 0, 0), ()))
MACHINE = """
name = "mill"
chain = "w-X-Y-b-Z-t"
[stroke_mm]
X = [0, 600]
Y = [0, 500]
Z = [0, 450]
[devices]
cnc = "{url}"
"""


@pytest.fixture
def driver_installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What `pip install acme-driver` leaves behind."""
    info = tmp_path / "site" / "acme_driver-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-driver\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[abbe.drivers]\nacme = tests.drivers.acme.driver:DRIVER\nbroken = no_such_driver:IT\n")
    monkeypatch.syspath_prepend(str(info.parent))
    importlib.invalidate_caches()


def machine_with(folder: Path, url: str) -> Site:
    """The site of a machine file whose controller has this URL."""
    (folder / "mill.toml").write_text(MACHINE.format(url=url))
    return site_of(load_machine(folder / "mill.toml").machine)


@pytest.fixture
async def control() -> AsyncIterator[AcmeControl]:
    async with serving(AcmeControl(RAW)) as served:
        yield served


@pytest.fixture
async def session(driver_installed: None, control: AcmeControl, tmp_path: Path) -> AsyncIterator[Session]:
    async with open_session(machine_with(tmp_path, f"acme://127.0.0.1:{control.port}").urls) as opened:
        yield opened


def test_without_the_driver_its_scheme_is_not_known(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="unknown scheme 'acme'"):
        machine_with(tmp_path, "acme://127.0.0.1:4000")


@pytest.mark.usefixtures("driver_installed")
async def test_a_driver_that_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    urls = machine_with(tmp_path, "broken://127.0.0.1:4000").urls
    with pytest.raises(BadUrl, match="no_such_driver:IT cannot be loaded"):
        async with open_session(urls):
            raise AssertionError("opened")


async def test_its_conditions_are_judged_like_those_of_any_control(session: Session, control: AcmeControl) -> None:
    status = await session.controller.status()
    check_interlocks(status)
    assert status.conditions == Condition.REMOTE | Condition.REFERENCED | Condition.DRIVES_ON | Condition.IN_POSITION
    control.flags += "d"
    with pytest.raises(DoorOpen):
        check_interlocks(await session.controller.status())
    with pytest.raises(Refused, match="not safe"):
        await session.controller.move((1.0, 0.0, 0.0), feed_mm_min=1000.0, timeout_s=5.0)


async def test_it_moves_and_follows_a_path(session: Session, control: AcmeControl) -> None:
    status = await session.controller.move((10.0, 20.0, 30.5), feed_mm_min=1000.0, timeout_s=5.0)
    assert (status.position_mm, control.at_um) == ((10.0, 20.0, 30.5), (10_000, 20_000, 30_500))
    await follow_path(session.controller, FollowPath(((10.0, 20.0, 30.5), (11.0, 20.0, 30.5), (12.0, 20.0, 30.5)), 1000.0), Control())
    assert control.at_um == (12_000, 20_000, 30_500)


async def test_a_table_is_pushed_into_it(session: Session, control: AcmeControl, tmp_path: Path) -> None:
    site = machine_with(tmp_path, f"acme://127.0.0.1:{control.port}")
    grid = tuple(np.linspace(low, high, 5) for low, high in ((0, 600), (0, 500), (0, 450)))
    curves = tuple(1e-3 * np.outer(np.arange(5.0), [1.0, -1.0, 2.0]) for _ in range(3))
    tables = NineTables(grid, curves, tuple(np.zeros((5, 3)) for _ in range(3)))
    measured: list[str] = []

    async def good() -> VerificationResult:
        measured.append("looked")
        return VerificationResult(True, "as predicted")

    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        await as_if_commissioned(session.controller, store, site)
        wanted = WantedTable(tables, await read_base(session.controller), 100, None, {})
        result = await Pushing(session.controller, store, site).bring(wanted, Questions(list, "a test", good, good))
    now = await session.controller.comp_status()
    assert (result.kept, result.crc, len(measured)) == (True, control.crc[1], 2)
    assert (now.active_bank, now.bank_state, now.lease_owner) == (1, (BankState.SEALED, BankState.SEALED), 0)
    assert crc32(await session.controller.read_bank(1)) == control.crc[1]


def test_the_service_knows_no_protocol_of_a_controller() -> None:
    """The scheme of a second control occurs nowhere in the product."""
    found = [p for room in ("service", "drivers") for p in (ROOT / room).rglob("*.py") if re.search(r"\bacme://", p.read_text())]
    assert found == []
