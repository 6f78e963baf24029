"""Resumes a campaign after Ctrl-C, an interlock, a crash or a power cut. Every complete run is used, and used once.

All preconditions are checked again and reported; a change that prevents resuming is refused in one line.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from abbe.drivers.api import beam_is_good, is_zeroed
from abbe.drivers.errors import DriverError
from abbe.service.campaigns.campaign_run import (
    Confirm,
    Item,
    Resumed,
    halfway,
    in_mounting,
    items,
    mounted_anew,
    plan_hash,
    read_path,
    resumed_item,
)
from abbe.service.devices.session import Session
from abbe.service.domain.artefact import ARTEFACT_TEST
from abbe.service.domain.measured import RUNNING, CampaignRecord, CheckpointRecord
from abbe.service.errors import PreconditionsChanged, UnsafeToMove
from abbe.service.runs.chunks import LASER_CHANNEL, decode_json
from abbe.service.sequences.control import ExpectedTable, check_expected, check_interlocks, check_ours
from abbe.service.sequences.journal import BEGUN, ENDED, BegunLine, HandLine, RunLine, lines_of
from abbe.service.sequences.recipes.campaigns import RecipeSource
from abbe.service.sequences.resume_plan import anew, remounted
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store

COMPLETE = "complete"
MOUNTS = ("MountBar", "MountLaser", "MountArtefact")


@dataclass(frozen=True, slots=True)
class JournalEntries:
    """A campaign's journal: the latest ``begun`` line, the manual steps, and the lines of runs by run number."""

    begun: BegunLine
    ended: bool
    hand: tuple[HandLine, ...]
    runs: dict[int, RunLine]


def read_journal(store: Store, campaign: CampaignRecord) -> JournalEntries:
    """Read the journal of a campaign. Raises PreconditionsChanged if there is none."""
    found: list[CheckpointRecord] = store.checkpoints.of_campaign(campaign.id)
    begun = lines_of(found, BegunLine)
    if not begun:
        raise PreconditionsChanged(
            f"campaign {campaign.name!r} has no journal",
            "it was imported, or measured by an older version of Abbe: measure it anew under another name",
        )
    hand = tuple(lines_of(found, HandLine))
    last = max(k for k, one in enumerate(found) if one.kind == BEGUN)
    ended = any(one.kind == ENDED for one in found[last:])
    return JournalEntries(begun[-1], ended, hand, {one.run: one for one in lines_of(found, RunLine)})


def begun_source(store: Store, name: str) -> RecipeSource:
    """Return the source of an interrupted campaign's plan. Raises PreconditionsChanged if the journal does not name it."""
    source = read_journal(store, store.campaigns.find(name)).begun.source
    if "recipe" not in source:
        raise PreconditionsChanged(f"the journal of campaign {name!r} does not name its recipe", "give it: --recipe FILE.toml (or --helix)")
    return RecipeSource(**source)


async def resume(session: Session, store: Store, site: Site, plan: CampaignPlan, name: str, confirm: Confirm | None) -> Resumed:
    """Find out where a campaign resumes. Stops a motion that is still running; nothing else moves.

    ``plan`` must be the original one. ``confirm`` asks whether a set-up with complete runs is untouched; if not, it is mounted anew. None:
    nobody is asked, and every set-up with a remaining test is mounted anew, after a prompt to clear away what is mounted.

    Raises
    ------
    PreconditionsChanged
        The plan, the machine or the table has changed, or the controller was restarted.
    UnsafeToMove
        Another process is measuring the campaign, or an interlock holds.
    """
    campaign = store.campaigns.find(name)
    lines = read_journal(store, campaign)
    _same_plan(store, campaign, lines, site, plan)
    comp = await session.controller.comp_status()
    expected = ExpectedTable(lines.begun.boot_id, lines.begun.table_crc)
    check_expected(expected, comp.boot_id, comp.bank_crc[comp.active_bank])
    messages = [f"campaign {campaign.name!r}: plan, machine and table are the same, and the controller was not restarted"]
    status = await session.controller.status()
    check_ours(status)
    if status.moving:
        await session.controller.abort()
        messages.append("the machine was still moving: it was stopped")
    check_interlocks(await session.controller.status())
    found = _Finder(store, campaign.id, plan, lines, {run.id: run.visible_status for run in store.runs.all(campaign.id)})
    start = await found.starts(session, confirm, messages)
    messages.insert(1, f"{len(found.done)} of {len(plan.tests)} tests are complete")
    begun = (campaign.id, campaign.head.zero_us)
    return Resumed(begun, found.done, start, found.mountings, frozenset(found.used), found.mounted_us, tuple(messages), expected)


def _same_plan(store: Store, campaign: CampaignRecord, lines: JournalEntries, site: Site, plan: CampaignPlan) -> None:
    owner = lines.begun.owner
    if owner is not None and not lines.ended and not owner.is_gone():
        raise UnsafeToMove(
            f"campaign {campaign.name!r} is being measured (process {owner.pid} on {owner.host})", "wait until the measurement has ended"
        )
    for run in store.runs.all(campaign.id):
        if run.visible_status == RUNNING:
            raise UnsafeToMove(
                f"run {run.label} of campaign {campaign.name} is being measured (process {run.owner.pid})",
                "wait until the measurement has ended",
            )
    if lines.begun.plan != plan_hash(plan):
        raise PreconditionsChanged(
            f"campaign {campaign.name!r} was begun with another recipe (or feed limit, or version of Abbe)",
            "resume with the original recipe, or measure a new campaign",
        )
    if store.machines.get(campaign.machine_id).doc != site.doc:
        raise PreconditionsChanged(
            f"campaign {campaign.name!r} was measured on another machine, or the machine file was changed", "measure a new campaign"
        )


class _Finder:
    """Finds which tests of a plan are done, what is mounted, and where the rest begins."""

    def __init__(self, store: Store, campaign: int, plan: CampaignPlan, lines: JournalEntries, states: dict[int, str]) -> None:
        self._store, self._campaign, self._lines, self._items = store, campaign, lines, items(plan)
        complete = {n: one for n, one in lines.runs.items() if states.get(n) == COMPLETE}
        self.done = {one.test: n for n, one in complete.items()}
        self.used = {(one.setup, one.mounting) for one in complete.values()}
        self.mountings: dict[str, int] = {}
        self.mounted_us: dict[str, int] = {}
        for one in lines.hand:
            setup, number = one.setup, one.mounting
            self.mountings[setup] = max(number, self.mountings.get(setup, 1))
            if one.phase == "done" and one.what in MOUNTS:
                if one.ctrl_us is None:
                    raise PreconditionsChanged(f"the journal states no time for the mounting of set-up {setup}", "measure a new campaign")
                self.mounted_us[setup if number == 1 else f"{setup}-{number}"] = one.ctrl_us

    async def starts(self, session: Session, confirm: Confirm | None, messages: list[str]) -> dict[str, Item]:
        """Return the first remaining test of every begun set-up."""
        start: dict[str, Item] = {}
        for setup in self.mountings:
            item = next((i for i in self._items if i.setup == setup and i.test.label not in self.done), None)
            if item is not None:
                start[item.test.label] = await self._start(session, item, confirm, messages)
        return start

    async def _start(self, session: Session, item: Item, confirm: Confirm | None, messages: list[str]) -> Item:
        setup, number = item.setup, self.mountings[item.setup]
        hand = [one for one in self._lines.hand if (one.setup, one.mounting) == (setup, number)]
        why = ""
        if hand[-1].phase != "done":
            why = "nobody confirmed that it was mounted"
        elif hand[-1].what == "Unmount":
            why = "it was taken away"
        elif confirm is None:
            why = "nobody was asked whether it is untouched"
        else:
            item = await self._in_place(session, item, number, hand[-1])
            if (setup, number) in self.used and not item.resume_trail.carried:
                question = f"Set-up {setup} was left mounted and has complete runs. Is the set-up still untouched?"
                why = "" if await confirm(question) else "it has complete runs, and nobody confirmed that it is untouched"
            elif item.remainder is not None and not await confirm(halfway(item)):
                item = resumed_item(item, item.hand, ())
        if why:
            messages.append(f"set-up {setup} must be mounted again for {item.test.label}: {why}")
            self.mountings[setup] = number + 1
            return mounted_anew(item, number + 1)
        kept = len(item.resume_trail.carried)
        how = f"resumes after point {kept}, which is read again" if kept else "begins again"
        if item.resume_trail.again:
            n = item.resume_trail.n_features
            how = f"resumes after {n} features; the first one is touched again" if n else "resumes; the sphere is touched again"
        if item.remainder is not None:
            at = f"{item.remainder.offset_mm:.0f} of {item.remainder.whole_mm:.0f} mm"
            how = f"resumes at {at} of its path, and reads a stretch before it again"
        messages.append(f"set-up {setup} is still mounted: {item.test.label} {how}")
        return item

    async def _in_place(self, session: Session, item: Item, number: int, last: HandLine) -> Item:
        """Return the test from its last checkpoint, in the present mounting."""
        label = item.test.label
        mounted_it = any((one.test, one.mounting) == (label, number) and one.what in MOUNTS for one in self._lines.hand)
        if number > 1 and mounted_it:
            whole = remounted(item.test, item.first, number)
            item = Item(item.test, item.first, whole, whole, number)
        else:
            item = (
                in_mounting(item, number) if number > 1 else Item(item.test, item.first, anew(item.test, 1), item.test, before=item.before)
            )
        hand = last.step if last.test == label else None
        artefact = item.test.test == ARTEFACT_TEST
        records = self._records(label, number, earlier=artefact) if artefact or await counting(session) else ()
        return resumed_item(item, hand, records, await read_path(session, self._store, self._campaign, label, number))

    def _records(self, label: str, number: int, *, earlier: bool) -> tuple[dict[str, Any], ...]:
        """Return the records of the last run of a test in this mounting, or, with ``earlier``, of its last run that has records."""
        runs = sorted((n for n, one in self._lines.runs.items() if (one.test, one.mounting) == (label, number)), reverse=True)
        for run in runs if earlier else runs[:1]:
            found = [record for chunk in self._store.chunks.of_run(run, LASER_CHANNEL) for record in decode_json(chunk.payload)]
            if found:
                return tuple(found)
        return ()


async def counting(session: Session) -> bool:
    """Whether the laser still counts from its last zero."""
    if session.laser is None:
        return False
    try:
        status = (await session.laser.peek()).status
    except DriverError:
        return False
    return is_zeroed(status) and beam_is_good(status)
