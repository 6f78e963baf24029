"""A process that has everything imported and forks a measuring child on demand, so that a hundred kills do not cost a hundred starts.

Reads one JSON line a job from standard input: ``{"folder": ..., "urls": {...}, "name": ..., "untouched": true}``, answers the child's pid,
and when it has ended its exit code (negative: the signal). The child does what `abbe measure` does, and with --resume when it was begun.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import traceback
from pathlib import Path
from typing import Any

from abbe.service.campaigns.campaign_run import Confirm
from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.resume import resume
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import DeviceUrls, lock_machine, open_session
from abbe.service.domain.machine import machine_doc
from abbe.service.sequences.recipes.recipe import Circle, Diagonal, Helix, Linear
from abbe.service.sequences.recipes.recipe_file import shared_setups
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from tests.faults.sequencer_world import MACHINE


def plan(name: str) -> CampaignPlan:
    """Eight tests on five set-ups: three of them share a cup (the bar is changed), two a mirror."""
    centre = (300.0, 250.0, 100.0)
    recipes = (
        *shared_setups(
            (
                Helix("helix", "B1", "identify", centre, 40.0, turns=3.0, chord_mm=2.0),
                Helix("helix-back", "B1", "identify", centre, 40.0, turns=3.0, chord_mm=2.0, direction=-1),
                Helix("longer", "B1", "identify", centre, 60.0, turns=3.0, chord_mm=3.0),
            ),
            name,
        ),
        Circle("circle", "B2", "identify", (200.0, 200.0, 150.0), 40.0, "XY", feed_in_deg=20.0, feed_out_deg=20.0),
        Linear("lineX", "L1", "identify", 0, positions=7, at_share=(0.15, 0.15)),
        Linear("lineZ", "L2", "identify", 2, positions=7, at_share=(0.15, 0.15)),
        Diagonal("diagXYZ", "D1", "identify", "ppp", 2, "XYZ", unmount=False),
        Diagonal("diagZYX", "D1", "identify", "ppp", 2, "ZYX", mount=False),
    )
    return CampaignPlan(name, tuple(r.plan(MACHINE) for r in recipes))


async def job(words: dict[str, Any]) -> None:
    """Measure, or go on measuring."""

    async def confirm(_: str) -> bool:
        return bool(words["untouched"])

    urls = DeviceUrls(**words["urls"])
    site = Site("sim", MACHINE, machine_doc("sim", MACHINE), urls)
    with Store.open(f"sqlite:///{Path(words['folder']) / 'abbe.sqlite3'}") as store:
        campaign = plan(words["name"])
        with lock_machine(urls.cnc):
            await at_work(urls, store, site, campaign, confirm)


async def at_work(urls: DeviceUrls, store: Store, site: Site, campaign: CampaignPlan, confirm: Confirm) -> None:
    """Open the devices, and measure what is left."""
    async with open_session(urls) as session:
        await recover(session.controller, store, site)
        begun = any(c.name == campaign.name and store.checkpoints.of_campaign(c.id) for c in store.campaigns.all())
        found = await resume(session, store, site, campaign, campaign.name, confirm) if begun else None
        for line in found.messages if found is not None else ():
            print(line, file=sys.stderr)  # noqa: T201
        # killed between a campaign's first line and its journal's: there is nothing to go on with, and nothing was measured
        empty = next((c for c in store.campaigns.all() if c.name == campaign.name and found is None), None)
        first = None if empty is None else (empty.id, int(empty.doc["ctrl0_us"]))
        await measure(session, store, site, campaign, campaign=first, options=MeasureOptions(confirm=confirm, resumed=found))


def main() -> None:
    """Fork a child for every line."""
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    for line in sys.stdin:
        pid = os.fork()
        if pid == 0:
            try:
                asyncio.run(job(json.loads(line)))
            except BaseException:  # noqa: BLE001 - a child that fails says why, and ends
                traceback.print_exc()
                os._exit(1)
            os._exit(0)
        sys.stdout.write(f"{pid}\n")
        sys.stdout.flush()
        _, status = os.waitpid(pid, 0)
        sys.stdout.write(f"{os.waitstatus_to_exitcode(status)}\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
