"""Commissioning of a control's tables: write a known step, measure it with the ball-bar, and infer sign, axis and unit.

A first step of half a micrometre shows a wrong unit without harm: a control that reads millimetres moves half a millimetre, which is within
the bar's stroke. Then each axis gets a step of 10 µm, which is rolled back before the next one. The bar stays mounted throughout. Every
table goes through the push machine like any other, and any failure rolls back.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from abbe.drivers.api import Identity
from abbe.models.arrays import F2
from abbe.models.compensation.sign_probe import Shift, SignProof, bar_shift, sign_proof, step_tables
from abbe.models.compensation.tables import NineTables, grid_positions, quantise
from abbe.models.machine import AXES
from abbe.service.audit.book import by_whom
from abbe.service.campaigns.bar_places import BarPlaces, PlaceReadings
from abbe.service.compensation.proved_levels import identity
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session
from abbe.service.domain.progress import ProgressSink
from abbe.service.errors import TableMismatch, TableRefused
from abbe.service.push.operations import VerificationResult
from abbe.service.sequences.control import Suspending
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, check_test_step, read_base

KIND = "sign-proof"
STEP_MM, FIRST_MM = 0.010, 0.0005
HARMLESS = 10.0
"""Largest motion of the tool by the first step, as a multiple of the step."""
STROKE_MM, LARGEST_RATIO = 1.0, 1000.0
"""Stroke of the bar either way; largest factor by which a wrong unit enlarges a step."""
PLACES = 24
GRID = (25, 21, 19)
U_READING_MM = 0.0003
UPRIGHT = 2


@dataclass(frozen=True, slots=True)
class SignCommissioning:
    """Result of a commissioning, and its id in the store."""

    proof: SignProof
    solution_id: int


@dataclass
class CommissioningContext:
    """Context of one commissioning: open devices, database, machine, and the places that the ball-bar reads."""

    session: Session
    store: Store
    site: Site
    bar: BarPlaces

    async def read_with_table(self, what: str, tables: NineTables, base: Base, lsb_nm: int) -> PlaceReadings:
        """Read all places with test tables in force; afterwards the old tables are in force again, whatever happens."""
        now = await read_base(self.session.controller)
        if now.crc != base.crc:
            raise TableMismatch("the active table was changed during commissioning", "start commissioning again")
        found: list[PlaceReadings] = []

        async def read() -> VerificationResult:
            found.append(await self.bar.read(what))
            return VerificationResult(False, f"{KIND}: {what} was read")  # a test step is never kept

        wanted = WantedTable(tables, now, lsb_nm, None, {"kind": KIND, "what": what})
        await Pushing(self.session.controller, self.store, self.site).bring(wanted, Questions(list, by_whom(), read, read))
        if not found:
            raise TableMismatch(
                "the controller or its tables changed before the ball-bar was read", "look at the controller, then begin again"
            )
        return found[0]


async def commission(session: Session, store: Store, site: Site, *, progress: ProgressSink) -> SignCommissioning:
    """Measure the effect of a correction at the control. Takes about ten minutes of machine time and one mounting of cup and bar.

    Any interlock ends it, even one that the machine file lets a measurement wait for, because a test table is in force.

    Raises
    ------
    TableRefused
        The first small step moved the tool too far, or the control's unit is too coarse for it. The old table is in force.
    StillActive, TableMismatch, Interlock, MeasurementFault, DriverError
        From pushing and measuring.
    """
    site = replace(site, watching=replace(site.watching, suspending=Suspending()))
    await recover(session.controller, store, site)
    base = await read_base(session.controller)
    lsb_nm = (await session.controller.table_format()).lsb_nm
    known = identity(await session.controller.identify())
    number = sum(c.name.startswith(KIND) for c in await asyncio.to_thread(store.campaigns.all)) + 1
    context = CommissioningContext(session, store, site, BarPlaces(session, store, site, progress, f"{KIND} {number}", PLACES))
    steps = _steps(context, base, lsb_nm)  # also checks their limits, before anything is mounted
    async with context.bar.cleared_away():
        proof = await _prove(context, base, steps)
        campaign = await asyncio.to_thread(store.campaigns.find, f"{context.bar.name} before")
        solution_id = await store.write(store.solutions.add, campaign.id, KIND, context.bar.run_ids, _doc(proof) | {"identity": known})
    return SignCommissioning(proof, solution_id)


@dataclass(frozen=True, slots=True)
class _Steps:
    """The test tables: one with a small step in every axis, then one per axis with a larger step; steps in whole units of the control."""

    lsb_nm: int
    small_mm: float
    small: NineTables
    step_mm: float
    each: tuple[NineTables, NineTables, NineTables]


def _steps(context: CommissioningContext, base: Base, lsb_nm: int) -> _Steps:
    lsb_mm = lsb_nm * 1e-6
    small_mm, step_mm = (max(round(s / lsb_mm), 1) * lsb_mm for s in (FIRST_MM, STEP_MM))
    if small_mm * LARGEST_RATIO > STROKE_MM:
        raise TableRefused(
            f"the control's unit of {lsb_mm * 1e3:g} µm is too coarse: if the control takes it as mm, a step leaves the bar's stroke",
            "prove sign and unit with a dial indicator, with the axis clear of all obstacles; nothing was written",
        )
    tables = _base_tables(context.site, base)
    x, y, z = (quantise(_stepped(context, tables, (axis,), step_mm), lsb_mm) for axis in range(3))
    small = quantise(_stepped(context, tables, (0, 1, 2), small_mm), lsb_mm)
    for one in (small, x, y, z):
        check_test_step(one, base.tables, context.site.limits)
    return _Steps(lsb_nm, small_mm, small, step_mm, (x, y, z))


async def _prove(context: CommissioningContext, base: Base, steps: _Steps) -> SignProof:
    """Read the places with each table and infer the proof; store a wrong unit before raising its error."""
    before = await context.bar.read("before")
    first = await context.read_with_table("first", steps.small, base, steps.lsb_nm)
    moved_mm = float(np.abs(first.deviation_mm - before.deviation_mm).max())
    if moved_mm > HARMLESS * max(steps.small_mm, FIRST_MM):
        moved = f"a step of {steps.small_mm * 1e3:g} µm moved the tool by {moved_mm * 1e3:.1f} µm"
        what = f"{moved}: the control reads the values of its tables in another unit"
        campaign = await asyncio.to_thread(context.store.campaigns.find, f"{context.bar.name} before")
        doc = {"step_mm": steps.small_mm, "faults": [what], "proved": False}
        await context.store.write(context.store.solutions.add, campaign.id, KIND, context.bar.run_ids, doc)
        raise TableRefused(what, "the old table is in force; look up the unit of the tables in the control's manual")
    read = [await context.read_with_table(AXES[axis], steps.each[axis], base, steps.lsb_nm) for axis in range(3)]
    after = await context.bar.read("after")
    return sign_proof(steps.step_mm, _shifts(context.bar.directions(before), before, read, after))


def _base_tables(site: Site, base: Base) -> NineTables:
    """Return the tables in force; zeros if there is no correction."""
    if base.tables is not None:
        return base.tables
    grids = grid_positions(site.machine, GRID)
    zeros = tuple(np.zeros((g.size, 3)) for g in grids)
    both = (zeros[0], zeros[1], zeros[2])
    return NineTables(grids, both, both)


def _stepped(context: CommissioningContext, tables: NineTables, axes: tuple[int, ...], step_mm: float) -> NineTables:
    """Add a step to the tables of some axes, over the whole reach of the bar."""
    for axis in axes:
        centre, reach = context.bar.centre_mm[axis], context.bar.radius_mm + 1.0
        low_mm = centre - (1.0 if axis == UPRIGHT else reach)  # the places are on the upper hemisphere
        try:
            tables = step_tables(tables, axis, step_mm, low_mm, centre + reach)
        except ValueError as error:
            raise TableRefused(str(error), "the machine's strokes are too short for this test; nothing was written") from None
    return tables


def _shifts(directions: F2, before: PlaceReadings, read: list[PlaceReadings], after: PlaceReadings) -> tuple[Shift, Shift, Shift]:
    # "before", small step, X, Y, Z, "after": five equal intervals
    found = [
        bar_shift(directions, before.deviation_mm, one.deviation_mm, after.deviation_mm, U_READING_MM, share=(k + 2) / 5.0)
        for k, one in enumerate(read)
    ]
    return found[0], found[1], found[2]


def _doc(proof: SignProof) -> dict[str, Any]:
    return {
        "step_mm": proof.step_mm,
        "response": proof.response.tolist(),
        "u_response": proof.u.tolist(),
        "faults": list(proof.faults),
        "proved": proof.proved,
    }


async def commissioned(controller: Identity, store: Store, site: Site) -> bool | None:
    """Whether the last commissioning of this machine's control has proved sign, axis and unit.

    None: there was none, or control or firmware were replaced since then.
    """
    info = identity(await controller.identify())
    doc = await asyncio.to_thread(_last, store, site)
    if doc is None or (doc["proved"] and doc.get("identity") != info):
        return None
    return bool(doc["proved"])


def _last(store: Store, site: Site) -> dict[str, Any] | None:
    ids = {c.id for c in store.campaigns.all() if store.machines.get(c.machine_id).name == site.name}
    last = [s for s in store.solutions.all() if s.kind == KIND and s.campaign_id in ids][-1:]
    return dict(last[0].doc) if last else None


async def check_commissioned(controller: Identity, store: Store, site: Site) -> None:
    """Refuse a table for a control that was never commissioned successfully.

    Raises
    ------
    TableRefused
        Sign, axis and unit were never proved, or the last commissioning found that the control does not act as the tables say.
    """
    found = await commissioned(controller, store, site)
    if found is False:
        raise TableRefused(
            "the last commissioning of this machine found that its control does not act as the tables say",
            "correct the control, then run abbe comp commission again; nothing was written",
        )
    if found is None:
        raise TableRefused(
            "sign, axis and unit of this control's tables were never proved: with a wrong unit a table could move the axes too far",
            "run abbe comp commission, which proves them with small steps in about ten minutes; nothing was written",
        )
