"""Reads the ball-bar, mounted once, repeatedly at the same few positions while tables change in between."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

import numpy as np

from abbe.drivers.errors import DriverError
from abbe.models.arrays import F1, F2
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.devices.session import Session
from abbe.service.domain.machine import Point
from abbe.service.domain.progress import ProgressSink
from abbe.service.errors import AbbeError, MeasurementFault, PushNotBegun, TableRefused
from abbe.service.runs.columns import load_run
from abbe.service.sequences.check import paced
from abbe.service.sequences.control import Control
from abbe.service.sequences.recipes.campaigns import hemisphere
from abbe.service.sequences.recipes.recipe import HelixPoints
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store

TURNS = 3.0
SAMPLES = 50
STILL_MOUNTED = "cup and bar may still be mounted: take them out before anything moves"


@dataclass(frozen=True, slots=True)
class PlaceReadings:
    """One pass over the positions: commanded coordinates, shape (n, 3), and readings, shape (n,), mm."""

    places_mm: F2
    deviation_mm: F1


@dataclass
class BarPlaces:
    """Reads ``places`` positions on a hemisphere; the first pass mounts cup and bar, `cleared_away` takes them out.

    ``control`` belongs to the surrounding job.
    """

    session: Session
    store: Store
    site: Site
    progress: ProgressSink
    name: str
    places: int
    control: Control = field(default_factory=Control)
    centre_mm: Point = (0.0, 0.0, 0.0)
    radius_mm: float = 0.0
    run_ids: list[int] = field(default_factory=list)
    mounted: bool = False
    """Whether cup and bar may be mounted: from the first motion towards mounting until they are certainly out."""

    def __post_init__(self) -> None:
        self.centre_mm, self.radius_mm = hemisphere(self.site.machine, (0.5, 0.5, 0.35), 0.6)

    async def read(self, what: str) -> PlaceReadings:
        """Read all positions with the table in force, as a separate campaign.

        Raises
        ------
        MeasurementFault
            A position has no valid reading.
        """
        first, self.mounted = not self.mounted, True
        recipe = HelixPoints(
            what, "P", "holdout", self.centre_mm, self.radius_mm, turns=TURNS, points=self.places, mount=first, unmount=False,
            link_mm=None if first else self._end(), samples=SAMPLES,
        )  # fmt: skip
        plan = paced(CampaignPlan(f"{self.name} {what}", (recipe.plan(self.site.machine),)), self.site.max_feed_mm_min)
        options = MeasureOptions(control=self.control, part=True)
        ids = await measure(self.session, self.store, self.site, plan, progress=self.progress, options=options)
        self.run_ids += ids
        columns = (await asyncio.to_thread(load_run, self.store, ids[0])).columns
        if not columns.valid.all():
            raise MeasurementFault(
                "the ball-bar gave no valid reading at some positions", "check that the bar sits in both cups, then begin again"
            )
        return PlaceReadings(columns.q_mm, columns.readings_mm)

    def directions(self, readings: PlaceReadings) -> F2:
        """Return unit vectors from the cup to the tool, shape (n, 3)."""
        out = readings.places_mm - np.array(self.centre_mm)
        return np.asarray(out / np.linalg.norm(out, axis=1)[:, None], dtype=np.float64)

    def _end(self) -> Point:
        recipe = HelixPoints("", "P", "holdout", self.centre_mm, self.radius_mm, turns=TURNS, points=self.places)
        return recipe.path()[0][-1]

    async def clear_away(self) -> None:
        """Take cup and bar out if they are mounted; an error gets the note that they may still be mounted."""
        if not self.mounted:
            return
        try:
            await self.session.need_fixture().unmount()
        except BaseException as error:
            error.add_note(STILL_MOUNTED)
            raise
        self.mounted = False

    @asynccontextmanager
    async def cleared_away(self) -> AsyncIterator[None]:
        """After the block, take cup and bar out, or warn that they may still be mounted: the next motion could hit them."""
        try:
            yield
        except (TableRefused, PushNotBegun, MeasurementFault) as error:  # the axes stand, and a person can reach in
            try:
                await self.clear_away()
            except (AbbeError, DriverError) as again:
                error.add_note(f"{STILL_MOUNTED} ({again})")
            raise
        except BaseException as error:
            if self.mounted and STILL_MOUNTED not in getattr(error, "__notes__", []):
                error.add_note(STILL_MOUNTED)
            raise
        await self.clear_away()
