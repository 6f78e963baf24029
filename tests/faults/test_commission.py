"""Commissioning against a simulated control that takes corrections otherwise than they are meant."""

from __future__ import annotations

import asyncio
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.service.compensation.commission import check_commissioned, commission, commissioned
from abbe.service.compensation.recover import recover
from abbe.service.domain.progress import Progress, ignore_progress
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.errors import Interlock, StillActive, TableRefused
from abbe.service.sequences.control import Suspending, Watching
from abbe.service.storage.store import Store
from abbe.simulators.cnc import bank
from tests.faults.sequencer_world import bench

SPEED = 200.0
PLACES = 24 if os.environ.get("ABBE_TEST_LONG") else 8
"""Eight are enough for the same limits."""


@pytest.fixture
async def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("abbe.service.compensation.commission.PLACES", PLACES)
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(SPEED)
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


def takes(monkeypatch: pytest.MonkeyPatch, response: np.ndarray) -> None:
    """The control applies corrections through a matrix, as a wrong convention does: nothing that can be read back shows it."""
    honest = bank.parse

    def parse(image):
        kind, correction = honest(image)
        return kind, lambda command_mm: correction(command_mm) @ response.T

    monkeypatch.setattr(bank, "parse", parse)


async def test_an_honest_control_is_proved(place):
    b, store = place
    controller = b.session.controller
    assert await commissioned(controller, store, b.site) is None
    with pytest.raises(TableRefused, match="never proved"):
        await check_commissioned(controller, store, b.site)
    active = b.sim.world.controller.comp.active
    crc = b.sim.world.controller.comp.crcs[active]
    found = await commission(b.session, store, b.site, progress=ignore_progress)
    assert found.proof.proved, found.proof.faults
    assert np.abs(found.proof.response - np.eye(3)).max() < 0.1
    await check_commissioned(controller, store, b.site)
    comp = b.sim.world.controller.comp
    assert comp.crcs[comp.active] == crc  # the table that was in force is in force again
    entries = store.pushes.entries(b.site.name)
    assert [e.state for e in entries if e.state in TERMINAL] == [PushState.ROLLED_BACK] * 4


async def test_a_control_with_another_convention_is_named_and_no_table_is_written_any_more(place, monkeypatch):
    b, store = place
    takes(monkeypatch, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]))
    found = await commission(b.session, store, b.site, progress=ignore_progress)
    x, y, z = found.proof.faults
    assert x == "X: it moves Y"
    assert y == "Y: it moves X, the sign is reversed"
    assert z.startswith("Z: the step has no effect")
    with pytest.raises(TableRefused, match="does not act as the tables say"):
        await check_commissioned(b.session.controller, store, b.site)


async def test_another_unit_stops_at_the_first_step(place, monkeypatch):
    b, store = place
    takes(monkeypatch, 25.4 * np.eye(3))
    with pytest.raises(TableRefused, match="reads the values of its tables in another unit"):
        await commission(b.session, store, b.site, progress=ignore_progress)
    comp = b.sim.world.controller.comp
    assert store.pushes.entries(b.site.name)[-1].state is PushState.ROLLED_BACK
    assert np.abs(comp.correction(np.array([[300.0, 250.0, 200.0]]))).max() == 0.0
    assert await commissioned(b.session.controller, store, b.site) is False
    assert b.sim.world.ballbar._cup_mm is None  # and cup and bar are away


async def test_a_door_in_the_middle_ends_it_with_the_old_table_and_says_what_is_mounted(place):
    b, store = place
    site = replace(b.site, watching=Watching(None, Suspending(frozenset({"door"}), longest_s=5.0, settle_s=0.05), unknown_s=5.0))
    seen: list[str] = []
    log = b.sim.registers.log

    def shut_when_heard(commands: int) -> None:
        if any(c.kind in ("hold", "abort") for c in log[commands:]):
            b.sim.world.controller.set_door(is_open=False)
        else:
            asyncio.get_running_loop().call_later(0.001, shut_when_heard, commands)

    def progress(now: Progress) -> None:
        if now.stage.endswith(" X") and now.points == 5 and not seen:
            seen.append(now.stage)
            b.sim.world.controller.set_door(is_open=True)
            shut_when_heard(len(log))

    with pytest.raises((Interlock, StillActive)) as raised:
        await commission(b.session, store, site, progress=progress)
    assert seen
    assert any("may still be mounted" in note for note in raised.value.__notes__)
    b.sim.world.controller.set_door(is_open=False)
    await b.session.controller.abort()  # as whoever measures next does before anything else
    await recover(b.session.controller, store, site)
    comp = b.sim.world.controller.comp
    assert np.abs(comp.correction(np.array([[300.0, 250.0, 200.0]]))).max() == 0.0
    assert store.pushes.entries(b.site.name)[-1].state is PushState.ROLLED_BACK


async def test_a_unit_too_coarse_for_a_harmless_step_is_refused_before_anything_is_mounted(place, monkeypatch):
    b, store = place
    honest = b.session.controller.table_format

    async def coarse():
        return replace(await honest(), lsb_nm=2000)

    monkeypatch.setattr(b.session.controller, "table_format", coarse, raising=False)
    with pytest.raises(TableRefused, match="too coarse"):
        await commission(b.session, store, b.site, progress=ignore_progress)
    assert not store.pushes.entries(b.site.name)
    assert not store.runs.all()
