"""Continue a discovery on the connected machine: measure the proposal, join it with the old campaign, search again.

All state is stored. The document of a continuing campaign names its plan and the campaign that it continues. The two campaigns joined
form a new campaign, and its readings identify its discovery in the store. So the same command resumes wherever it was stopped.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from itertools import groupby

from abbe.service.campaign_data.campaign_folder import Campaign, from_store
from abbe.service.campaigns.device_checks import check_devices
from abbe.service.campaigns.measure import measure, start_campaign
from abbe.service.devices.session import Session
from abbe.service.discovery.discover import DiscoveryJob, prepare
from abbe.service.discovery.discovery_store import StoredJournal, journal_of
from abbe.service.domain.measured import RUNNING, CampaignRecord
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.run import Run
from abbe.service.effects.model_book import version
from abbe.service.errors import CampaignRefused, UnsafeToMove
from abbe.service.identification.removal import campaign_table
from abbe.service.sequences.steps import CampaignPlan, TestPlan, Unmount
from abbe.service.site import Site
from abbe.service.storage.store import Store

ROUNDS = 3
"""Number of proposals that are measured before a person has to decide."""
NO_CLOCK = "measure the campaign with `abbe measure` on this machine, and go on without switching the controller off"
COMPLETE = "complete"


@dataclass(frozen=True)
class LiveAddition:
    """A measurement that continues a campaign.

    ``plan``: the whole plan; ``remaining``: the part that is not completely measured, None if all is; ``begun``: its stored campaign, None
    before it begins; ``link``: the ``continues`` entry of that campaign's document; ``after_s``: least age of the continued campaign's last
    reading at the start, s.
    """

    plan: CampaignPlan
    remaining: CampaignPlan | None
    begun: CampaignRecord | None
    link: dict[str, str]
    after_s: float = 0.0


def addition_count(store: Store, name: str) -> int:
    """Count the additions in the chain of campaigns that ends with this one, to choose run labels that none of them has used."""
    before = {c.name: (c.doc.get("continues") or {}).get("campaign") for c in store.campaigns.all()}
    chain = [name]
    while (old := before.get(chain[-1])) is not None and old not in chain:
        chain.append(old)
    return len(chain) - 1


def find_addition(store: Store, campaign: Campaign, plan: CampaignPlan, after_s: float = 0.0) -> LiveAddition:
    """Return what is done and what remains of a plan that continues a campaign; a campaign begun for the same plan is resumed.

    A set-up is done only if all its tests were completed in one mounting. After an interrupted test the equipment in the machine is
    unknown: the operator is first asked to remove it, then mounts it again under the name of a new set-up.

    Raises
    ------
    UnsafeToMove
        Another process is measuring this campaign.
    """
    link = {"campaign": campaign.name, "plan": hashlib.sha256(repr(plan.tests).encode()).hexdigest()}
    begun = next((c for c in reversed(store.campaigns.all()) if c.doc.get("continues") == link), None)
    if begun is None:
        return LiveAddition(plan, plan, None, link, after_s)
    runs = store.runs.all(begun.id)
    for run in runs:
        if run.visible_status == RUNNING:
            raise UnsafeToMove(
                f"run {run.label} of campaign {begun.name} is being measured (process {run.owner.pid})",
                "wait until the measurement has ended",
            )
    states = {run.label: run.visible_status for run in runs}
    left = _remaining(plan.tests, states)
    return LiveAddition(replace(plan, name=begun.name), CampaignPlan(begun.name, left) if left else None, begun, link, after_s)


def _remaining(tests: tuple[TestPlan, ...], states: dict[str, str]) -> tuple[TestPlan, ...]:
    """Return the remaining tests in whole set-ups: an incomplete set-up starts again from its mounting.

    Another process cannot resume a set-up, because the bar may have moved or been removed.
    """
    out: list[TestPlan] = []
    for _, members in groupby(tests, key=lambda test: test.setup_id):
        group, attempt = tuple(members), 1
        while any(_attempt(t, attempt).label in states for t in group):
            if all(states.get(_attempt(t, attempt).label) == COMPLETE for t in group):
                break
            attempt += 1
        else:
            out += [_attempt(t, attempt) for t in group]
    if states and out:
        out[0] = replace(out[0], steps=(Unmount(), *out[0].steps))
    return tuple(out)


def _attempt(test: TestPlan, number: int) -> TestPlan:
    """Return the test for the n-th mounting of its set-up, with its own label and set-up name."""
    if number == 1:
        return test
    return replace(test.in_setup(f"{test.setup_id}-{number}"), label=f"{test.label}-{number}")


async def measure_added(
    session: Session, store: Store, site: Site, campaign: Campaign, what: LiveAddition, progress: ProgressSink
) -> float:
    """Measure what remains of an addition to a campaign. Every completed run is stored, even if a later one fails.

    Returns
    -------
    float
        0.0 after the measurement. If it is too early to begin, the seconds until then; nothing was asked or moved.

    Raises
    ------
    CampaignRefused
        The controller was restarted since the old campaign, is another one, or has another table active; nothing has moved.
    UnsafeToMove, MeasurementFault, DriverError
        The machine still moves on the path of an interrupted run, or the measurement failed.
    """
    if what.remaining is None:
        return 0.0
    status, comp = await session.controller.status(), await session.controller.comp_status()
    old = campaign.head
    if old.ctrl0_us is None or old.boot_id != comp.boot_id or old.ctrl0_us > status.ctrl_us:
        raise CampaignRefused(f"campaign {campaign.name} was measured before the controller restarted, or on another controller", NO_CLOCK)
    now = comp.bank_crc[comp.active_bank]
    tables = {run.table.crc for run in campaign.runs} - {None, now}
    if tables:
        raise CampaignRefused(f"campaign {campaign.name} was measured with another compensation table", "measure it again")
    wait_s: float = what.after_s - (1e-6 * (status.ctrl_us - old.ctrl0_us) - _last_s(campaign))
    if what.after_s > 0.0 and wait_s > 0.0:
        return wait_s
    if status.moving:  # the operator must not reach into a moving machine
        raise UnsafeToMove(
            "the machine is moving, perhaps on the path of an interrupted run", "wait until it stands still, then give the command again"
        )
    await check_devices(session, what.remaining, air=site.watching.air_c is not None)
    if what.begun is None:
        begun = await start_campaign(session, store, site, what.plan.name, {"continues": what.link})
    else:
        begun = (what.begun.id, what.begun.head.zero_us)
    await measure(session, store, site, what.remaining, progress=progress, campaign=begun)
    return 0.0


def _last_s(campaign: Campaign) -> float:
    """Return the time of a campaign's last reading, s of its clock."""
    return max((float(run.columns.t_s[-1]) for run in campaign.runs), default=0.0)


def next_search(store: Store, job: DiscoveryJob, journal: StoredJournal, name: str) -> tuple[DiscoveryJob, StoredJournal]:
    """Prepare the search of a campaign joined with the added campaign ``name``; ``journal``: journal of the previous search.

    The new search contains the readings of the previous one. So it starts from the same model version, and its finding replaces the
    previous one.
    """
    campaign = joined(job.campaign, from_store(store, name))
    base = None if journal.base is None else version(store, job.campaign.site.name, journal.base)
    following = replace(
        prepare(campaign, job.effects, base, table=campaign_table(store, campaign), since=job.since), expected_version=journal.version_after
    )
    return following, journal_of(store, following, journal)


def joined(old: Campaign, new: Campaign) -> Campaign:
    """Join the runs of both campaigns on the old campaign's clock, under the new campaign's name."""
    later_s = (new.head.zero_us - old.head.zero_us) * 1e-6
    runs = [*old.runs, *(_later(run, later_s) for run in new.runs)]
    doc = old.doc | {"campaign": new.name}
    return replace(new, runs=runs, doc=doc)


def _later(run: Run, by_s: float) -> Run:
    later = replace(run, columns=replace(run.columns, t_s=run.columns.t_s + by_s))
    return later if run.setup.t_set_s is None else later.mounted(run.setup.t_set_s + by_s)
