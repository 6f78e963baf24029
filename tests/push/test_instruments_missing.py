"""An instrument that is missing must not keep an unverified table in force: it is taken back first, then the instrument is asked for.

Before, the devices were opened together: `measure` ended at "no laser", and the table of a killed push stayed active.
"""

from __future__ import annotations

import asyncio
import re
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.drivers.errors import DriverError
from abbe.service.clock import SystemClock
from abbe.service.compensation import pushing
from abbe.service.compensation.approved import PushOrder
from abbe.service.compensation.push_approved import push_approved
from abbe.service.config import load_machine
from abbe.service.domain.measured import this_process
from abbe.service.domain.progress import ignore_progress
from abbe.service.jobs.check import run_check
from abbe.service.jobs.guided_campaign import run_guided_campaign
from abbe.service.jobs.investigate import InvestigationContext
from abbe.service.sequences.control import Control
from abbe.service.sequences.recipes.campaigns import identification
from abbe.service.site import Site, site_of
from tests.push.test_whose_table import Left, left_in_probation
from tests.scenarios.conftest import ABBE

pytestmark = pytest.mark.timeout(120)


@pytest.fixture
def nothing() -> Iterator[str]:
    """The address of a laser where nothing listens."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        yield f"modbus+tcp://127.0.0.1:{taken.getsockname()[1]}"


@pytest.fixture(autouse=True)
def killed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever pushes is a process of before the computer's last start: gone, for every process that looks."""
    gone = replace(this_process(), start="an earlier start")
    monkeypatch.setattr(pushing, "this_process", lambda: gone)


@asynccontextmanager
async def killed_push(folder: Path) -> AsyncIterator[Left]:
    """Its table is in force; the ball-bar's line, which is for one process, is free."""
    async with left_in_probation(folder) as left:
        assert await left.active() != left.base
        await left.b.session.need_ballbar().close()
        yield left


def machine_file(left: Left, folder: Path, laser: str | None) -> Path:
    """The simulated machine with this laser (None: left out) and the database of the killed push."""
    urls, strokes = left.b.site.urls, left.b.site.machine.stroke_mm.tolist()
    devices = {"cnc": urls.cnc, "ballbar": urls.ballbar, "laser": laser, "fixture": urls.fixture}
    lines = ['name = "sim"', 'chain = "w-X-Y-b-Z-t"', "tool_mm = [0.0, 0.0, -120.0]", "[stroke_mm]"]
    lines += [f"{axis} = {stroke}" for axis, stroke in zip("XYZ", strokes, strict=True)]
    lines += ["[calibration]", "ballbar = 2099-12-31", "laser = 2099-12-31"]
    lines += ["[store]", f'url = "sqlite:///{folder / "killed.sqlite3"}"']
    lines += ["[devices]"] + [f'{role} = "{url}"' for role, url in devices.items() if url is not None]
    path = folder / "machine.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def full(site: Site, left: Left) -> InvestigationContext:
    """The full campaign, asked for."""
    return InvestigationContext(site, left.store, identification(site.machine), SystemClock(), ignore_progress)


async def nothing_to_note() -> None:
    """Of a push: it began."""


async def typed(*words: str) -> tuple[int | None, str]:
    """A command in a process of its own: exit code and what stands on standard error."""
    child = await asyncio.create_subprocess_exec(*ABBE, *words, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.PIPE)
    _, err = await child.communicate()
    return child.returncode, err.decode()


@pytest.mark.parametrize(
    ("words", "there"),
    [
        (("measure", "-m", "FILE", "--recipe", "quick-check"), True),
        (("measure", "-m", "FILE", "--recipe", "quick-check"), False),
        (("comp", "push", "-m", "FILE", "1"), True),
    ],
    ids=["measure", "measure, none in the file", "comp push"],
)
async def test_a_command_takes_the_table_back_and_then_misses_the_laser(
    words: tuple[str, ...], there: bool, tmp_path: Path, nothing: str
) -> None:
    async with killed_push(tmp_path) as left:
        file = machine_file(left, tmp_path, nothing if there else None)
        code, err = await typed(*(str(file) if word == "FILE" else word for word in words))
        assert code == 2, err
        assert "push 1 was not verified" in err
        assert (nothing if there else "a laser for") in err.splitlines()[-1]
        assert await left.active() == left.base


async def test_a_scheduled_check_takes_the_table_back_and_then_misses_the_laser(tmp_path: Path, nothing: str) -> None:
    async with killed_push(tmp_path) as left:
        config = load_machine(machine_file(left, tmp_path, nothing)).machine
        with pytest.raises(DriverError, match=re.escape(nothing)):
            await run_check(config, left.store, "quick-check", ignore_progress)
        assert await left.active() == left.base


async def test_a_led_campaign_does_so(tmp_path: Path, nothing: str) -> None:
    async with killed_push(tmp_path) as left:
        site = site_of(load_machine(machine_file(left, tmp_path, nothing)).machine)
        with pytest.raises(DriverError, match=re.escape(nothing)):
            await run_guided_campaign(full(site, left), {}, "ann")
        assert await left.active() == left.base


async def test_a_led_campaign_without_any_laser_does_so(tmp_path: Path) -> None:
    """Every device that the file names is there: what is missing is found once they are open."""
    async with killed_push(tmp_path) as left:
        site = site_of(load_machine(machine_file(left, tmp_path, None)).machine)
        with pytest.raises(Exception, match="needs a laser for test"):
            await run_guided_campaign(full(site, left), {}, "ann")
        assert await left.active() == left.base


async def test_the_push_of_an_approved_proposal_does_so(tmp_path: Path, nothing: str) -> None:
    async with killed_push(tmp_path) as left:
        site = site_of(load_machine(machine_file(left, tmp_path, nothing)).machine)
        ended = await push_approved(site, left.store, PushOrder(1, nothing_to_note, ignore_progress, Control()), clock=SystemClock())
        assert ended.word == "failed"
        assert nothing in ended.text
        assert await left.active() == left.base
