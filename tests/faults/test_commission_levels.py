"""Commissioning of a controller's promises: an honest one is proved, each kind of lie is found, and what it may be used for falls with it.

The lies are played inside the simulated controller, behind its registers: our side sees only what is on the wire.
"""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from abbe.models.compensation.tables import NineTables, grid_positions, quantise
from abbe.service.compensation.commission_levels import RESTART, commission_levels
from abbe.service.compensation.proved_levels import check_level, level_status
from abbe.service.compensation.pushing import Pushing, PushResult, Questions, WantedTable
from abbe.service.errors import StillActive, TableRefused, UnsafeToMove
from abbe.service.push.journal import facts
from abbe.service.push.operations import VerificationResult
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from abbe.simulators.cnc import bank
from abbe.simulators.cnc.compensation import BankState, Compensation, CompResult
from tests.faults.sequencer_world import bench
from tests.patience import within

STAGED, STAGED_RESULT = 3, 8
SPEED = 12.0
"""A move of 3 mm takes a quarter of a second of wall time: many requests."""


@pytest.fixture
async def place(tmp_path: Path):
    async with bench(tmp_path, seed=3) as b:
        b.sim.pace(SPEED)
        b.sim.world.controller.comp._scale = SPEED  # leases last their wall time
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield b, store


def lies(b, kind: type[Compensation]) -> None:
    """From now on the controller's banks are of this kind."""
    b.sim.world.controller.comp.__class__ = kind


class NoGeneration(Compensation):
    """Activates whatever generation is expected."""

    def activate(self, number, owner, expected, *, may_act, now_s):
        return super().activate(number, owner, (expected[0], self.generation), may_act=may_act, now_s=now_s)


class NoCrc(Compensation):
    """Activates whatever CRC is expected."""

    def activate(self, number, owner, expected, *, may_act, now_s):
        return super().activate(number, owner, (self.crcs[number], expected[1]), may_act=may_act, now_s=now_s)


class NoLease(Compensation):
    """Takes SEAL and ACTIVATE from anybody, and gives the lease to everybody who asks."""

    def _refuse(self, number, owner, now_s):
        return CompResult.BANK_ACTIVE if number == self.active else CompResult.OK

    def lease(self, owner, lease_ms, now_s):
        self._owner = 0
        return super().lease(owner, lease_ms, now_s)


class Everlasting(Compensation):
    """A lease that never runs out."""

    def lease(self, owner, lease_ms, now_s):
        return super().lease(owner, lease_ms * 10_000, now_s)


class WhileMoving(Compensation):
    """Activates while the axes move."""

    def activate(self, number, owner, expected, *, may_act, now_s):
        return super().activate(number, owner, expected, may_act=True, now_s=now_s)


class Stuck(Compensation):
    """Its generation stands."""

    @property
    def generation(self):
        return 7

    @generation.setter
    def generation(self, value):
        pass


class SealNotCounted(Compensation):
    """Counts writes and activations, not seals."""

    def seal(self, number, owner, now_s):
        before = self.generation
        result = super().seal(number, owner, now_s)
        self.generation = before
        return result


class OneBank(Compensation):
    """Both banks are one memory."""

    def write(self, number, offset, values):
        done = super().write(number, offset, values)
        if done:
            self.words[self.active][offset : offset + len(values)] = values
        return done


class OpenBank(Compensation):
    """The bank in force takes writes."""

    def write(self, number, offset, values):
        if number != self.active:
            return super().write(number, offset, values)
        self.words[number][offset : offset + len(values)] = values
        self.states[number], self.crcs[number] = BankState.WRITING, 0
        self.generation += 1
        return True


class TakesNothing(Compensation):
    """Refuses every activation, so every wrong one as well."""

    def activate(self, number, owner, expected, *, may_act, now_s):
        return CompResult.INTERLOCK


class AtNextStart(Compensation):
    """Reads its tables at its start only: an activation is checked, and staged."""

    def activate(self, number, owner, expected, *, may_act, now_s):
        active, kind, correction, generation = self.active, self.kind, self.correction, self.generation
        result = super().activate(number, owner, expected, may_act=may_act, now_s=now_s)
        if result != CompResult.OK:
            return result
        self.active, self.kind, self.correction, self.generation = active, kind, correction, generation
        self.states[number] = STAGED
        return STAGED_RESULT


class NeverSeals(Compensation):
    """Takes no image at all."""

    def seal(self, number, owner, now_s):
        result = super()._refuse(number, owner, now_s)
        return result or CompResult.NOT_AN_IMAGE


def small_tables(b, slope: float = 1e-5) -> NineTables:
    grids = grid_positions(b.site.machine, (5, 5, 5))
    curves = tuple((g - g[0])[:, None] * np.full(3, slope) for g in grids)
    none = tuple(np.zeros_like(c) for c in curves)
    return quantise(NineTables(grids, (curves[0], curves[1], curves[2]), (none[0], none[1], none[2])), 1e-4)


async def push(b, store, *, attended: bool, slope: float = 1e-5) -> PushResult:
    async def yes() -> VerificationResult:
        return VerificationResult(True, "a stand-in")

    wanted = WantedTable(small_tables(b, slope), await read_base(b.session.controller), 100, None, {})
    pushing = Pushing(b.session.controller, store, b.site, attended=attended)
    return await pushing.bring(wanted, Questions(list, "a test", yes, yes))


def in_force(b) -> list[int]:
    comp = b.sim.world.controller.comp
    return comp.words[comp.active][: comp.words[comp.active][3]]


async def test_an_honest_controller_is_proved_and_may_be_pushed_into_by_night(place):
    b, store = place
    assert (await push(b, store, attended=True)).kept  # a real table is in force
    assert facts(tuple(store.pushes.entries("sim"))).level == 2  # not proved yet: what the status block shows
    comp, before = b.sim.world.controller.comp, in_force(b)
    where = b.sim.world.controller.position_mm.copy()
    active = comp.active
    found = await commission_levels(b.session.controller, store, b.site)
    assert found.capabilities.level == 3, found.rows()
    assert RESTART in found.not_shown
    assert (comp.active, in_force(b)) == (active, before)  # what was in force is so again
    assert comp.owner(b.sim.now_s()) == 0
    assert b.sim.world.controller.position_mm == pytest.approx(where, abs=1e-5)
    assert bank.parse(comp.words[1 - active])[0] == 1  # the copy stays
    assert (await level_status(b.session.controller, store, b.site)).hint == ""
    assert (await push(b, store, attended=False, slope=2e-5)).kept
    assert facts(tuple(e for e in store.pushes.entries("sim") if e.push == 2)).level == 3


async def test_never_proved_is_for_attended_pushes_only_and_says_so(place):
    b, store = place
    assert "never proved" in (await check_level(b.session.controller, store, b.site)).hint
    with pytest.raises(TableRefused, match="a person who approves has to be at the machine"):
        await check_level(b.session.controller, store, b.site, attended=False)
    gen = b.sim.world.controller.comp.generation
    with pytest.raises(TableRefused, match="a person who approves has to be at the machine"):
        await push(b, store, attended=False)
    assert b.sim.world.controller.comp.generation == gen


@pytest.mark.parametrize(
    ("kind", "lost", "level", "words"),
    [
        (NoGeneration, {"swap_compares"}, 2, "accepts an activation with another generation"),
        (NoCrc, {"swap_compares"}, 2, "accepts an activation with another CRC"),
        (NoLease, {"lease"}, 2, "accepts a lease for a second owner"),
        (Everlasting, {"lease"}, 2, "it does not run out"),
        (WhileMoving, {"interlocks"}, 2, "accepts an activation while an axis moves"),
        (Stuck, {"generation", "swap_compares"}, 0, "does not count a write (7 → 7)"),
        (SealNotCounted, {"generation"}, 0, "does not count a seal"),
        (
            OneBank,
            {"two_banks", "generation", "lease", "swap_compares", "interlocks"},
            0,
            "after a write into the inactive bank, a bank holds something else than it should",
        ),
        (OpenBank, {"two_banks"}, 0, "the active bank accepts writes"),
        (NeverSeals, {"two_banks", "swap_compares", "interlocks"}, 0, "cannot be made ready"),
        (TakesNothing, {"swap_compares"}, 2, "a correct activation is refused as well"),
    ],
)
async def test_a_controller_that_does_not_keep_a_promise_is_found_and_not_trusted_by_night(place, monkeypatch, kind, lost, level, words):
    b, store = place
    if kind is Everlasting:
        monkeypatch.setattr("abbe.service.compensation.commission_levels.RUNS_OUT_S", 1.0)  # of a lease of 0.3 s
    before, comp = in_force(b), b.sim.world.controller.comp
    lies(b, kind)
    found = await commission_levels(b.session.controller, store, b.site)
    assert {name for name, ok, _ in found.rows() if not ok} == lost, found.rows()
    assert words in "; ".join(text for _, ok, text in found.rows() if not ok)
    assert found.capabilities.level == level
    assert in_force(b) == before  # whatever it took wrongly, the same numbers act
    assert comp.owner(b.sim.now_s()) == 0
    with pytest.raises(TableRefused):
        await push(b, store, attended=False)
    if level < 2:
        with pytest.raises(TableRefused, match="can only be read"):
            await check_level(b.session.controller, store, b.site)


async def test_a_controller_that_acts_at_its_next_start_keeps_its_promises_too_and_nothing_stays_staged(place):
    b, store = place
    comp, before = b.sim.world.controller.comp, in_force(b)
    lies(b, AtNextStart)
    found = await commission_levels(b.session.controller, store, b.site)
    assert found.capabilities.level == 3, found.rows()
    assert "effective after the next start" in {name: text for name, _, text in found.rows()}["swap_compares"]
    assert comp.states == [BankState.SEALED, BankState.WRITING]
    assert in_force(b) == before


async def test_no_boot_id_is_no_level(place):
    b, store = place
    b.sim.registers._boot_id = 0
    found = await commission_levels(b.session.controller, store, b.site)
    assert [name for name, ok, _ in found.rows() if not ok] == ["boot_id"]
    assert found.capabilities.level == 0


async def test_where_nothing_may_move_the_watch_over_the_axes_is_not_proved(place):
    b, store = place
    b.sim.world.controller.switches.spindle_turning = True
    found = await commission_levels(b.session.controller, store, b.site)
    missing = {name: text for name, ok, text in found.rows() if not ok}
    assert "no axis may move now: the spindle turns" in missing["interlocks"]
    assert "a correct activation is refused as well: interlock" in missing["swap_compares"]
    assert found.capabilities.level == 2


async def test_another_firmware_is_another_controller(place, monkeypatch):
    b, store = place
    assert (await commission_levels(b.session.controller, store, b.site)).capabilities.level == 3
    honest = b.session.controller.identify

    async def newer():
        return replace(await honest(), firmware="map 1, newer")

    monkeypatch.setattr(b.session.controller, "identify", newer, raising=False)
    now = await level_status(b.session.controller, store, b.site)
    assert now.level == 2
    assert "controller or its firmware was replaced" in now.hint
    with pytest.raises(TableRefused, match="a person who approves"):
        await push(b, store, attended=False)
    other = replace(b.site, name="another machine")
    assert "never proved" in (await level_status(b.session.controller, store, other)).hint


async def test_a_restart_between_two_commissionings_is_evidence(place):
    b, store = place
    await commission_levels(b.session.controller, store, b.site)
    b.sim.registers._boot_id += 1
    found = await commission_levels(b.session.controller, store, b.site)
    assert RESTART not in found.not_shown
    assert found.capabilities.level == 3


async def test_an_unfinished_push_goes_first_for_the_bank_at_rest_holds_its_old_table(place):
    b, store = place
    before = in_force(b)
    controller = b.sim.world.controller

    async def cut() -> VerificationResult:
        controller.switches.spindle_turning = True  # from here on nothing can be activated, the way back included
        return VerificationResult(False, "worse")

    async def yes() -> VerificationResult:
        return VerificationResult(True, "a stand-in")

    wanted = WantedTable(small_tables(b), await read_base(b.session.controller), 100, None, {})
    with pytest.raises(StillActive):
        await Pushing(b.session.controller, store, b.site).bring(wanted, Questions(list, "a test", yes, cut))
    at_rest, gen = list(controller.comp.words[1 - controller.comp.active]), controller.comp.generation
    with pytest.raises(StillActive):
        await commission_levels(b.session.controller, store, b.site)
    assert (controller.comp.words[1 - controller.comp.active], controller.comp.generation) == (at_rest, gen)
    controller.switches.spindle_turning = False
    found = await commission_levels(b.session.controller, store, b.site)
    assert found.capabilities.level == 3, found.rows()
    assert in_force(b) == before  # the table that was never verified is gone


async def test_anothers_lease_is_left_alone(place):
    b, store = place
    await b.session.controller.lease(0xABBE0001, 60_000)
    gen = b.sim.world.controller.comp.generation
    with pytest.raises(UnsafeToMove, match="another owner has the lease"):
        await commission_levels(b.session.controller, store, b.site)
    assert b.sim.world.controller.comp.generation == gen


async def test_broken_off_while_the_axis_moves_it_stops_and_gives_the_lease_back(place):
    b, store = place
    before, active = in_force(b), b.sim.world.controller.comp.active
    work = asyncio.ensure_future(commission_levels(b.session.controller, store, b.site))
    async with asyncio.timeout(within(20)):
        while not b.sim.world.controller.moving:  # noqa: ASYNC110 - the simulator tells nobody
            await asyncio.sleep(0.002)
    work.cancel()
    with pytest.raises(asyncio.CancelledError):
        await work
    assert not b.sim.world.controller.moving
    assert (in_force(b), b.sim.world.controller.comp.active) == (before, active)
    assert b.sim.world.controller.comp.owner(b.sim.now_s()) == 0
    assert not store.solutions.all()
