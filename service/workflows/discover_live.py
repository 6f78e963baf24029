"""Go on with a discovery on the connected machine: measure what was proposed, put it beside what there is, search again."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from typing import Any

from service.devices.session import Session
from service.errors import CampaignRefused
from service.events import ProgressSink
from service.sequences.steps import CampaignPlan
from service.site import Site
from service.storage.store import Store
from service.workflows.campaign_folder import Campaign, from_store
from service.workflows.measure import measure

ROUNDS = 3
"""So many proposals are measured before a person has to look."""
NO_CLOCK = "measure the campaign with `abbe measure` on this machine, and go on without switching the controller off"


async def measured_next(
    session: Session, store: Store, site: Site, campaign: Campaign, plan: CampaignPlan, progress: ProgressSink
) -> Campaign:
    """Run a plan and return the old campaign with its runs, under the new campaign's name.

    Raises
    ------
    CampaignRefused
        The old campaign has another clock than the machine has now, or another table was active; nothing has moved.
    UnsafeToMove, MeasurementFault, DriverError
        The measurement failed.
    """
    status, comp = await session.controller.status(), await session.controller.comp_status()
    old = campaign.doc
    if "ctrl0_us" not in old or old.get("boot_id") != comp.boot_id or old["ctrl0_us"] > status.ctrl_us:
        raise CampaignRefused(f"campaign {campaign.name} has not the clock that the machine has now", NO_CLOCK)
    now = comp.bank_crc[comp.active_bank]
    tables = {run.get("table", {}).get("crc") for run in campaign.runs} - {None, now}
    if tables:
        raise CampaignRefused(f"campaign {campaign.name} was measured with another compensation table", "measure it again")
    await measure(session, store, site, plan, progress=progress)
    return joined(campaign, await asyncio.to_thread(from_store, store, plan.name))


def joined(old: Campaign, new: Campaign) -> Campaign:
    """Both campaigns' runs on the old one's clock, under the new one's name."""
    later_s = (new.doc["ctrl0_us"] - old.doc["ctrl0_us"]) * 1e-6
    runs = [*old.runs, *(_later(run, later_s) for run in new.runs)]
    doc = old.doc | {"campaign": new.name}
    return replace(new, runs=runs, doc=doc)


def _later(run: dict[str, Any], by_s: float) -> dict[str, Any]:
    setup = run["setup"] | {"t_set_s": float(run["setup"]["t_set_s"]) + by_s}
    columns = run["columns"] | {"t_s": [t + by_s for t in run["columns"]["t_s"]]}
    return run | {"setup": setup, "columns": columns}
