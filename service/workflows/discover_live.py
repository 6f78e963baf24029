"""Go on with a discovery on the connected machine: measure what was proposed, put it beside what there is, search again.

Nothing of it lives in memory alone. A campaign that goes on with another one says so in its document, with the plan it was begun for; the
joined campaign follows from the two, and the discovery of it is found by its readings. So the same command goes on wherever it was ended.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any

from service.devices.session import Session
from service.errors import CampaignRefused, UnsafeToMove
from service.events import ProgressSink
from service.sequences.steps import CampaignPlan, TestPlan
from service.site import Site
from service.storage.records import RUNNING, CampaignRecord
from service.storage.store import Store
from service.workflows.campaign_folder import Campaign, from_store
from service.workflows.discover import Job, prepare
from service.workflows.discovery_store import StoredJournal, journal_of
from service.workflows.measure import measure, start_campaign
from service.workflows.model_book import version

ROUNDS = 3
"""So many proposals are measured before a person has to look."""
NO_CLOCK = "measure the campaign with `abbe measure` on this machine, and go on without switching the controller off"
COMPLETE = "complete"


@dataclass(frozen=True)
class Added:
    """A measurement that goes on with a campaign.

    ``plan``: all of it; ``left``: what of it is not measured completely, None where nothing is left; ``begun``: its campaign in the store,
    None if it was not begun; ``link``: what that campaign's document says of it.
    """

    plan: CampaignPlan
    left: CampaignPlan | None
    begun: CampaignRecord | None
    link: dict[str, str]


def added(store: Store, campaign: Campaign, plan: CampaignPlan) -> Added:
    """How far a plan that goes on with a campaign was measured. A campaign that was begun for the same plan is gone on with.

    Raises
    ------
    UnsafeToMove
        Another process is measuring it.
    """
    link = {"campaign": campaign.name, "plan": hashlib.sha256(repr(plan.tests).encode()).hexdigest()}
    begun = next((c for c in reversed(store.campaigns()) if c.doc.get("continues") == link), None)
    if begun is None:
        return Added(plan, plan, None, link)
    runs = store.runs(begun.id)
    for run in runs:
        if run.visible_status == RUNNING:
            raise UnsafeToMove(
                f"run {run.label} of campaign {begun.name} is being measured (process {run.owner.pid})", "wait until it has ended"
            )
    states = {run.label: run.visible_status for run in runs}
    left = tuple(again for test in plan.tests if (again := _to_do(test, states)) is not None)
    return Added(replace(plan, name=begun.name), CampaignPlan(begun.name, left) if left else None, begun, link)


def _to_do(test: TestPlan, states: dict[str, str]) -> TestPlan | None:
    """A test as it is to be measured: under a name of its own where an earlier try was not completed. None: it was completed."""
    label, tries = test.label, 1
    while label in states:
        if states[label] == COMPLETE:
            return None
        tries += 1
        label = f"{test.label}-{tries}"
    return replace(test, label=label)


async def measure_added(session: Session, store: Store, site: Site, campaign: Campaign, what: Added, progress: ProgressSink) -> None:
    """Measure what is left of an addition to a campaign; every completed run is kept, whatever ends the next one.

    Raises
    ------
    CampaignRefused
        The old campaign has another clock than the machine has now, or another table was active; nothing has moved.
    UnsafeToMove, MeasurementFault, DriverError
        The measurement failed.
    """
    if what.left is None:
        return
    status, comp = await session.controller.status(), await session.controller.comp_status()
    old = campaign.doc
    if "ctrl0_us" not in old or old.get("boot_id") != comp.boot_id or old["ctrl0_us"] > status.ctrl_us:
        raise CampaignRefused(f"campaign {campaign.name} has not the clock that the machine has now", NO_CLOCK)
    now = comp.bank_crc[comp.active_bank]
    tables = {run.get("table", {}).get("crc") for run in campaign.runs} - {None, now}
    if tables:
        raise CampaignRefused(f"campaign {campaign.name} was measured with another compensation table", "measure it again")
    if what.begun is None:
        begun = await start_campaign(session, store, site, what.plan.name, {"continues": what.link})
    else:
        begun = (what.begun.id, int(what.begun.doc["ctrl0_us"]))
    await measure(session, store, site, what.left, progress=progress, campaign=begun)


def next_search(store: Store, job: Job, journal: StoredJournal, name: str) -> tuple[Job, StoredJournal]:
    """The search of a campaign joined with one that was added to it, and where it stands.

    The readings of the first search are in it again, so it starts from the version of the model that the first one started from, and
    its finding replaces what the first one has added.

    Parameters
    ----------
    journal : StoredJournal
        Of the search before, which has ended.
    name : str
        Of the added campaign.
    """
    campaign = joined(job.campaign, from_store(store, name))
    base = None if journal.base is None else version(store, job.campaign.site.name, journal.base)
    following = replace(prepare(campaign, job.effects, base), seen=journal.leaves)
    return following, journal_of(store, following, journal)


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
