"""Carries one test of a campaign to completion across pauses and suspensions, from checkpoint to checkpoint."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from typing import Any

from abbe.drivers.api import DeviceInfo, Point
from abbe.drivers.errors import DriverError, LinkDown, Rebooted, ReplyTimeout
from abbe.service.campaigns.device_checks import BEFORE_S
from abbe.service.devices.session import Session
from abbe.service.errors import BeamLost, Interlock, RunInterrupted, SetupDisturbed, StretchDiffers
from abbe.service.runs.columns import path_progress
from abbe.service.runs.pieces import ReadProgress
from abbe.service.sequences.control import Control, ExpectedTable, State, Suspending, Watching, check_expected, check_interlocks
from abbe.service.sequences.journal import DONE, WAITS, Journal, RunLine, lines_of
from abbe.service.sequences.resume_plan import Attempt, PathRemainder, ResumeTrail, anew, end_of, remounted, rest_of
from abbe.service.sequences.runner import Runner
from abbe.service.sequences.steps import CampaignPlan, ReadBar, RecordPath, TestPlan
from abbe.service.sequences.waiting import may_suspend, paused, suspended
from abbe.service.storage.store import Store

BALLBAR = "ballbar"
"""Name for a loss of the ball-bar's box in ``[limits] continue_after`` of the machine file."""
MOST_BREAKS = 5
"""How often a test restarts after the ball-bar box was lost; after that a person has to look."""
BREAKS = (LinkDown, ReplyTimeout, Rebooted)


async def bar_ready(session: Session, test: TestPlan) -> DeviceInfo | None:
    """Check before a run that the ball-bar's box, if needed, is still the same box with the same settings.

    Raises
    ------
    DriverError
        The box does not answer, is another one, or needs a person.
    """
    if session.ballbar is None or not any(isinstance(step, RecordPath | ReadBar) for step in test.steps):
        return None
    return await session.ballbar.make_ready(within_s=BEFORE_S)


class BarBreaks:
    """Waits for the ball-bar's box if its link is lost during a test.

    It waits only if the conditions of ``suspending`` contain ``ballbar``; otherwise the loss ends the measurement.
    """

    def __init__(self, session: Session, control: Control, suspending: Suspending) -> None:
        self._bar, self._control, self._suspending = session.ballbar, control, suspending
        self._count = 0

    async def wait(self, error: DriverError, runner: Runner, journal: Journal) -> None:
        """Wait for the box if a run ended with its loss; return at once after any other error, or if the measurement must not wait.

        Raises
        ------
        RunInterrupted
            The box is back: the test begins again in a new run. The person who plugged it in may have touched the set-up.
        DriverError
            The box did not come back in time, or another one did.
        Stopped, Aborted
            A person requested it.
        """
        if self._bar is None or error.device != self._bar.name or not isinstance(error, BREAKS):
            return
        self._count += 1
        if BALLBAR not in self._suspending.conditions or self._count > MOST_BREAKS:
            return
        self._control.now(State.SUSPENDED, str(error))
        await journal.add(WAITS, why=str(error), condition=BALLBAR)
        await self._control.unless_stopped(self._bar.make_ready(within_s=self._suspending.longest_s))
        runner.touched = True
        raise RunInterrupted(
            f"the link to the ball-bar's box was lost and restored ({error.code})",
            "the test begins again; its readings are kept as evidence",
        ) from error


MOST_TRIES = 5
"""Maximum number of consecutive suspensions or mountings of a test without a new point; after that a person has to look."""
LEAST_GAIN_MM = 1.0
"""Smallest increase of a path's read length that counts as progress."""
Confirm = Callable[[str], Awaitable[bool]]


def _in_vain(why: SetupDisturbed | Interlock | RunInterrupted) -> SetupDisturbed | Interlock | RunInterrupted:
    remedy = "find the cause at the machine, then resume: abbe measure -m MACHINE.toml --resume CAMPAIGN"
    return type(why)(f"{why.detail}; {MOST_TRIES + 1} times in a row without a new point", remedy)


async def decline(_: str) -> bool:
    """Answer no in an unattended campaign: nobody can confirm that a set-up is untouched, so it is mounted anew."""
    return False


async def _nothing_read(_: str, __: int) -> ReadProgress | None:
    """Report that nothing of a path was read, so that it begins again."""
    return None


def plan_hash(plan: CampaignPlan) -> str:
    """Return the hash of a campaign's tests; another recipe, or a version that computes another path, has another hash."""
    return hashlib.sha256(repr(plan.tests).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Item:
    """State of a test that is not complete yet.

    ``test`` and ``first`` as planned (``first`` mounts the set-up of ``test``); ``whole``: all steps in the present mounting, whose number
    is ``mounting``; ``left``: the remaining steps, from ``offset`` on; ``hand``: number of the last manual step done; ``before``: start
    position, if an earlier test mounted the set-up; ``remainder``: rest of an interrupted path; ``kept_mm``: greatest length read so far.
    """

    test: TestPlan
    first: TestPlan
    whole: TestPlan
    left: TestPlan
    mounting: int = 1
    offset: int = 0
    resume_trail: ResumeTrail = field(default_factory=ResumeTrail)
    hand: int | None = None
    before: Point | None = None
    tries: int = 0
    remainder: PathRemainder | None = None
    kept_mm: float = 0.0

    @property
    def setup(self) -> str:
        """Name of the set-up in the plan."""
        return self.test.setup_id

    def attempt(self) -> Attempt:
        """Return this state as the runner needs it for its next attempt."""
        return Attempt(self.test.label, self.setup, self.offset, self.mounting, self.resume_trail, remainder=self.remainder)


def items(plan: CampaignPlan) -> tuple[Item, ...]:
    """Return all tests of a plan, each from its beginning in the first mounting of its set-up."""
    made: list[Item] = []
    firsts: dict[str, TestPlan] = {}
    for test in plan.tests:
        first = firsts.setdefault(test.setup_id, test)
        before = end_of(made[-1].test) if made and first is not test and not test.mounts else None
        made.append(Item(test, first, test, test, before=before))
    return tuple(made)


def in_mounting(item: Item, mounting: int) -> Item:
    """Restart a test from its beginning in this mounting of its set-up, which an earlier test made."""
    whole = anew(item.test, mounting)
    return replace(item, whole=whole, left=whole, mounting=mounting)


def mounted_anew(item: Item, mounting: int) -> Item:
    """Restart a test from its beginning, with a new mounting."""
    whole = remounted(item.test, item.first, mounting)
    return replace(
        item, whole=whole, left=whole, mounting=mounting, offset=0, resume_trail=ResumeTrail(), hand=None, before=None, remainder=None
    )


def resumed_item(item: Item, hand: int | None, records: tuple[dict[str, Any], ...], so_far: ReadProgress | None = None) -> Item:
    """Resume a test from its last checkpoint, in the present mounting."""
    hand = item.hand if hand is None else hand
    left, offset, resume_trail, remainder = rest_of(item.whole, hand, records, item.before, so_far)
    return replace(item, left=left, offset=offset, resume_trail=resume_trail, hand=hand, remainder=remainder)


async def read_path(session: Session, store: Store, campaign: int, test: str, mounting: int) -> ReadProgress | None:
    """Return how far the path of a test was read in a mounting; None if that is unknown or the ball-bar's box was restarted since."""

    def look() -> ReadProgress | None:
        lines = lines_of(store.checkpoints.of_campaign(campaign), RunLine)
        runs = [one.run for one in lines if (one.test, one.mounting) == (test, mounting)]
        return path_progress(store, max(runs)) if runs else None

    found = await asyncio.to_thread(look) if session.ballbar is not None else None
    if found is None or session.ballbar is None:
        return None
    return found if await session.ballbar.peek_boot_id() == found.boot_id else None


def halfway(item: Item) -> str:
    """Return the question to a person before an interrupted path resumes."""
    return f"Set-up {item.setup} was left mounted, and test {item.test.label} is only partly measured. Is the set-up still untouched?"


@dataclass(frozen=True, slots=True)
class Resumed:
    """State from which an interrupted campaign resumes. ``done``: complete runs by test; ``start``: tests that do not begin as planned.

    ``campaign``: number and clock zero; ``mounted_us``: time of each mounting; ``messages``: findings, one sentence each; ``expected``:
    boot id and table of the controller at the beginning of the campaign.
    """

    campaign: tuple[int, int]
    done: dict[str, int]
    start: dict[str, Item]
    mountings: dict[str, int]
    used: frozenset[tuple[str, int]]
    mounted_us: dict[str, int]
    messages: tuple[str, ...]
    expected: ExpectedTable | None = None


@dataclass
class CampaignRun:
    """Context of a running campaign.

    ``mountings``: number of mountings of each set-up; ``used``: set-ups (planned name, mounting) with a complete run; ``labels``: used
    names of runs; ``read_path``: returns how far the path of a test was read in a mounting.
    """

    session: Session
    control: Control
    watching: Watching
    journal: Journal
    expected: ExpectedTable
    confirm: Confirm = decline
    mountings: dict[str, int] = field(default_factory=dict)
    used: set[tuple[str, int]] = field(default_factory=set)
    labels: set[str] = field(default_factory=set)
    freed: bool = False
    read_path: Callable[[str, int], Awaitable[ReadProgress | None]] = _nothing_read

    def runner(self) -> Runner:
        """Return a runner for one attempt."""
        return Runner(self.session, self.control, self.watching, self.journal, self.expected)

    async def complete(self, item: Item, once: Callable[[TestPlan, Attempt, Runner], Awaitable[int]]) -> int:
        """Run a test until it is complete; return the number of its complete run. ``once`` runs one attempt as one run of the store.

        Raises
        ------
        AbbeError, DriverError
            The test cannot continue without a person.
        """
        while True:
            self.mountings.setdefault(item.setup, item.mounting)
            await self._ready()
            runner = self.runner()
            try:
                run_id = await once(self._named(item.left), item.attempt(), runner)
            except (RunInterrupted, SetupDisturbed, Interlock) as why:
                so_far = None if isinstance(why, SetupDisturbed) else await self.read_path(item.test.label, item.mounting)
                kept_mm = max(item.kept_mm, so_far.pieces[-1].to_mm if so_far is not None else 0.0)
                gained = runner.gained or kept_mm > item.kept_mm + LEAST_GAIN_MM
                tries = 0 if gained or isinstance(why, RunInterrupted) else item.tries + 1
                if tries > MOST_TRIES:
                    raise _in_vain(why) from why
                item = replace(await self._next(item, runner, why, so_far), tries=tries, kept_mm=kept_mm)
                continue
            self.used.add((item.setup, item.mounting))
            await self.journal.add(DONE, test=item.test.label, run=run_id, setup=item.setup, mounting=item.mounting)
            return run_id

    async def _ready(self) -> None:
        """Check boot id, table and interlocks of the controller before a run, and clear a feed hold that a killed process left.

        Raises
        ------
        PreconditionsChanged, Interlock
            The run cannot start.
        """
        comp = await self.session.controller.comp_status()
        check_expected(self.expected, comp.boot_id, comp.bank_crc[comp.active_bank])
        if not self.freed:
            check_interlocks(await self.session.controller.status())
            await self.session.controller.abort()  # the status does not show an unfinished abort
            self.freed = True

    async def _next(
        self, item: Item, runner: Runner, why: RunInterrupted | SetupDisturbed | Interlock, so_far: ReadProgress | None
    ) -> Item:
        """Wait until the test can resume, and return its rest from the last checkpoint.

        Raises
        ------
        Interlock, Stopped, Aborted, PreconditionsChanged
            The test cannot resume.
        """
        if isinstance(why, StretchDiffers) and (item.setup, item.mounting) not in self.used:
            return resumed_item(item, runner.hand, ())  # no kept reading depends on the mounting
        if isinstance(why, SetupDisturbed):
            return self.again_mounted(item)
        if isinstance(why, Interlock):
            if not may_suspend(why, self.watching.suspending):
                raise why
            touched = await suspended(self.session, self.control, self.watching, self.expected, self.journal, why)
        else:
            touched = await paused(self.session, self.control, self.watching, self.expected, self.journal) or runner.touched
        if runner.asked is not None:  # the mounting was not confirmed as done
            return self.again_mounted(item)
        records = () if isinstance(why, BeamLost) else tuple(runner.records)
        again = resumed_item(item, runner.hand, records)
        item = resumed_item(item, runner.hand, records, so_far)
        if not touched or await self.untouched(item):
            return item
        return self.again_mounted(item) if (item.setup, item.mounting) in self.used else again

    async def untouched(self, item: Item) -> bool:
        """Whether the set-up is still usable after a person may have touched it.

        True if no readings are kept, and for a resumed laser run, which reads its last point again. Otherwise a person must confirm:
        repeating a stretch of the path shows whether the cup has moved along the bar, but not across it.
        """
        if item.resume_trail.carried:
            return True
        if (item.setup, item.mounting) in self.used:
            return await self.confirm(f"Set-up {item.setup} was left mounted and has complete runs. Is the set-up still untouched?")
        return item.remainder is None or await self.confirm(halfway(item))

    def again_mounted(self, item: Item) -> Item:
        """Return the test with one more mounting of its set-up."""
        number = self.mountings.get(item.setup, item.mounting) + 1
        self.mountings[item.setup] = number
        return mounted_anew(item, number)

    def _named(self, test: TestPlan) -> TestPlan:
        """Return the test under a name that no run of the campaign has yet."""
        label, n = test.label, 1
        while label in self.labels:
            n += 1
            label = f"{test.label}-{n}"
        self.labels.add(label)
        return replace(test, label=label)
