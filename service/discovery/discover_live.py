"""Go on with a discovery on the connected machine: measure what was proposed, put it beside what there is, search again.

Nothing of it lives in memory alone. A campaign that goes on with another one says so in its document, with the plan it was begun for; the
joined campaign follows from the two, and the discovery of it is found by its readings. So the same command goes on wherever it was ended.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

from abbe.service.campaign_data.campaign_folder import Campaign, from_store
from abbe.service.campaigns.measure import measure, start_campaign
from abbe.service.devices.session import Session
from abbe.service.discovery.discover import DiscoveryJob, prepare
from abbe.service.discovery.discovery_store import StoredJournal, journal_of
from abbe.service.domain.measured import RUNNING, CampaignRecord
from abbe.service.domain.progress import ProgressSink
from abbe.service.effects.model_book import version
from abbe.service.errors import CampaignRefused, UnsafeToMove
from abbe.service.identification.table_removal import table_then
from abbe.service.sequences.needed import check_devices
from abbe.service.sequences.steps import CampaignPlan, TestPlan, Unmount
from abbe.service.site import Site
from abbe.service.storage.store import Store

ROUNDS = 3
"""So many proposals are measured before a person has to look."""
NO_CLOCK = "measure the campaign with `abbe measure` on this machine, and go on without switching the controller off"
COMPLETE = "complete"


@dataclass(frozen=True)
class Added:
    """A measurement that goes on with a campaign.

    ``plan``: all of it; ``left``: what of it is not measured completely, None where nothing is left; ``begun``: its campaign in the store,
    None if it was not begun; ``link``: what that campaign's document says of it; ``after_s``: the last reading of the campaign that it goes
    on with is to be so old when it begins.
    """

    plan: CampaignPlan
    left: CampaignPlan | None
    begun: CampaignRecord | None
    link: dict[str, str]
    after_s: float = 0.0


def rounds(store: Store, name: str) -> int:
    """How many additions a campaign stands on, itself counted if it is one: what its runs are labelled by is taken."""
    before = {c.name: (c.doc.get("continues") or {}).get("campaign") for c in store.campaigns.all()}
    chain = [name]
    while (old := before.get(chain[-1])) is not None and old not in chain:
        chain.append(old)
    return len(chain) - 1


def added(store: Store, campaign: Campaign, plan: CampaignPlan, after_s: float = 0.0) -> Added:
    """How far a plan that goes on with a campaign was measured. A campaign that was begun for the same plan is gone on with.

    A set-up counts only where all its tests were completed in one mounting. Nobody knows what hangs in the machine after a test was broken
    off: whoever goes on is asked first to take it away, then mounts anew under a new set-up's name.

    Raises
    ------
    UnsafeToMove
        Another process is measuring it.
    """
    link = {"campaign": campaign.name, "plan": hashlib.sha256(repr(plan.tests).encode()).hexdigest()}
    begun = next((c for c in reversed(store.campaigns.all()) if c.doc.get("continues") == link), None)
    if begun is None:
        return Added(plan, plan, None, link, after_s)
    runs = store.runs.all(begun.id)
    for run in runs:
        if run.visible_status == RUNNING:
            raise UnsafeToMove(
                f"run {run.label} of campaign {begun.name} is being measured (process {run.owner.pid})", "wait until it has ended"
            )
    states = {run.label: run.visible_status for run in runs}
    left = _left(plan.tests, states)
    return Added(replace(plan, name=begun.name), CampaignPlan(begun.name, left) if left else None, begun, link, after_s)


def _left(tests: tuple[TestPlan, ...], states: dict[str, str]) -> tuple[TestPlan, ...]:
    """What is to be measured of whole set-ups: each from its mounting on where a try was begun and not completed.

    Without the process that mounted it a set-up cannot be gone on with: the bar may hang, and cannot follow a move, or be gone.
    """
    out: list[TestPlan] = []
    for _, members in groupby(tests, key=lambda test: str(test.setup["setup_id"])):
        group, tries = tuple(members), 1
        while any(_tried(t, tries).label in states for t in group):
            if all(states.get(_tried(t, tries).label) == COMPLETE for t in group):
                break
            tries += 1
        else:
            out += [_tried(t, tries) for t in group]
    if states and out:
        out[0] = replace(out[0], steps=(Unmount(), *out[0].steps))
    return tuple(out)


def _tried(test: TestPlan, tries: int) -> TestPlan:
    """A test of a set-up that is mounted for the n-th time: its runs and its cup have names of their own."""
    if tries == 1:
        return test
    return replace(test, label=f"{test.label}-{tries}", setup=test.setup | {"setup_id": f"{test.setup['setup_id']}-{tries}"})


async def measure_added(session: Session, store: Store, site: Site, campaign: Campaign, what: Added, progress: ProgressSink) -> float:
    """Measure what is left of an addition to a campaign; every completed run is kept, whatever ends the next one.

    Returns
    -------
    float
        0.0: it was measured. Else it is too early for it: seconds from now until it can begin; nothing was asked or moved.

    Raises
    ------
    CampaignRefused
        The old campaign has another clock than the machine has now, or another table was active; nothing has moved.
    UnsafeToMove, MeasurementFault, DriverError
        The machine still runs the path of a run that was broken off, or the measurement failed.
    """
    if what.left is None:
        return 0.0
    status, comp = await session.controller.status(), await session.controller.comp_status()
    old = campaign.doc
    if "ctrl0_us" not in old or old.get("boot_id") != comp.boot_id or old["ctrl0_us"] > status.ctrl_us:
        raise CampaignRefused(f"campaign {campaign.name} has not the clock that the machine has now", NO_CLOCK)
    now = comp.bank_crc[comp.active_bank]
    tables = {run.get("table", {}).get("crc") for run in campaign.runs} - {None, now}
    if tables:
        raise CampaignRefused(f"campaign {campaign.name} was measured with another compensation table", "measure it again")
    wait_s: float = what.after_s - (1e-6 * (status.ctrl_us - old["ctrl0_us"]) - _last_s(campaign))
    if what.after_s > 0.0 and wait_s > 0.0:
        return wait_s
    if status.moving:  # nobody is asked to reach into it
        raise UnsafeToMove("the machine is moving: it may run the path of a run that was broken off", "wait until it stands, then go on")
    await check_devices(session, what.left, air=site.watching.air_c is not None)
    if what.begun is None:
        begun = await start_campaign(session, store, site, what.plan.name, {"continues": what.link})
    else:
        begun = (what.begun.id, int(what.begun.doc["ctrl0_us"]))
    await measure(session, store, site, what.left, progress=progress, campaign=begun)
    return 0.0


def _last_s(campaign: Campaign) -> float:
    """When the last reading of a campaign was taken, on its clock."""
    return max((float(run["columns"]["t_s"][-1]) for run in campaign.runs), default=0.0)


def next_search(store: Store, job: DiscoveryJob, journal: StoredJournal, name: str) -> tuple[DiscoveryJob, StoredJournal]:
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
    following = replace(prepare(campaign, job.effects, base, table=table_then(store, campaign), since=job.since), seen=journal.leaves)
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
