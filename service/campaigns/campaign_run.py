"""One test of a campaign until it is complete: over pauses and suspensions, from checkpoint to checkpoint."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field, replace
from typing import Any

from abbe.drivers.api import DeviceInfo, Point
from abbe.drivers.errors import DriverError, LinkDown, Rebooted, ReplyTimeout
from abbe.service.devices.session import Session
from abbe.service.errors import BeamLost, Interlock, RunInterrupted, SetupDisturbed, StretchDiffers
from abbe.service.runs.columns import path_so_far
from abbe.service.runs.pieces import SoFar
from abbe.service.sequences.control import Control, State
from abbe.service.sequences.interlocks import Suspending, Watching, check_interlocks
from abbe.service.sequences.journal import DONE, RUN, WAITS, Journal
from abbe.service.sequences.needed import BEFORE_S
from abbe.service.sequences.path_resume import PathRemainder
from abbe.service.sequences.preconditions import ExpectedTable, check_expected
from abbe.service.sequences.resume_plan import Attempt, ResumeTrail, anew, end_of, remounted, rest_of
from abbe.service.sequences.runner import Runner
from abbe.service.sequences.steps import CampaignPlan, ReadBar, RecordPath, TestPlan
from abbe.service.sequences.waiting import may_suspend, paused, suspended
from abbe.service.storage.store import Store

BALLBAR = "ballbar"
"""The word in ``[limits] continue_after``."""
MOST_BREAKS = 5
"""So often a test begins again because the box was lost; then a person has to look at it."""
BREAKS = (LinkDown, ReplyTimeout, Rebooted)


async def bar_ready(session: Session, test: TestPlan) -> DeviceInfo | None:
    """Before a run: if it needs the ball-bar, the same box answers, and reads as it did when it was first met.

    Raises
    ------
    DriverError
        It is not there, is another one, or a person has to look at it.
    """
    if session.ballbar is None or not any(isinstance(step, RecordPath | ReadBar) for step in test.steps):
        return None
    return await session.ballbar.make_ready(within_s=BEFORE_S)


class BarBreaks:
    """What becomes of a test whose runs are ended by the loss of the box.

    Parameters
    ----------
    session : Session
        Open devices.
    control : Control
        How the wait can be stopped.
    suspending : Suspending
        Whether and how long to wait for the box; without ``ballbar`` in its conditions the error ends the measurement.
    """

    def __init__(self, session: Session, control: Control, suspending: Suspending) -> None:
        self._bar, self._control, self._suspending = session.ballbar, control, suspending
        self._count = 0

    async def wait(self, error: DriverError, runner: Runner, journal: Journal) -> None:
        """After a run that ended by this error: returns when nothing is to be done about it here.

        Raises
        ------
        RunInterrupted
            The box is back: the test begins again, in a run of its own. The person who plugged it in may have touched what is mounted.
        DriverError
            It did not come back in time, or another one did.
        Stopped, Aborted
            That was asked for meanwhile.
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
            f"the ball-bar's box was lost and is back ({error.code})", "the test begins again; what was read is kept as evidence"
        ) from error


MOST_TRIES = 5
"""So often in a row a test is suspended or mounted anew without a new point; then a person has to look."""
LEAST_GAIN_MM = 1.0
"""So much farther than ever before a path must have been read, for that to be a gain."""
Confirm = Callable[[str], Awaitable[bool]]


def _in_vain(why: SetupDisturbed | Interlock | RunInterrupted) -> SetupDisturbed | Interlock | RunInterrupted:
    return type(why)(f"{why.detail}; {MOST_TRIES + 1} times in a row without a new point", why.remedy)


async def decline(_: str) -> bool:
    """For unattended campaigns: no person confirms that a set-up was not touched, so it is mounted anew."""
    return False


async def _nothing_read(_: str, __: int) -> SoFar | None:
    """Paths begin again."""
    return None


def plan_hash(plan: CampaignPlan) -> str:
    """What a campaign is to measure, as one number: another recipe, or a version that draws another path, has another."""
    return hashlib.sha256(repr(plan.tests).encode()).hexdigest()


@dataclass(frozen=True, slots=True)
class Item:
    """A test on its way to being complete.

    ``test`` and ``first`` as planned (``first`` mounts the set-up that ``test`` uses); ``whole``: its steps in the present mounting, of
    which ``mounting`` is the number; ``left``: what is left of them from ``offset`` on; ``hand``: last step by hand that was done;
    ``before``: where the machine stood when it began with what an earlier test left mounted; ``remainder``: what is left of its path, if it
    was broken off; ``kept_mm``: the farthest that it was ever read.
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
        return str(self.test.setup["setup_id"])

    def attempt(self) -> Attempt:
        """What the runner gets."""
        return Attempt(self.test.label, self.setup, self.offset, self.mounting, self.resume_trail, remainder=self.remainder)


def items(plan: CampaignPlan) -> tuple[Item, ...]:
    """All tests of a plan, each from its beginning in the first mounting of its set-up."""
    made: list[Item] = []
    firsts: dict[str, TestPlan] = {}
    for test in plan.tests:
        first = firsts.setdefault(str(test.setup["setup_id"]), test)
        before = end_of(made[-1].test) if made and first is not test and not test.mounts else None
        made.append(Item(test, first, test, test, before=before))
    return tuple(made)


def in_mounting(item: Item, mounting: int) -> Item:
    """The test from its beginning, with what was mounted for the n-th time by an earlier test."""
    whole = anew(item.test, mounting)
    return replace(item, whole=whole, left=whole, mounting=mounting)


def mounted_anew(item: Item, mounting: int) -> Item:
    """The test from its beginning, mounting by itself."""
    whole = remounted(item.test, item.first, mounting)
    return replace(
        item, whole=whole, left=whole, mounting=mounting, offset=0, resume_trail=ResumeTrail(), hand=None, before=None, remainder=None
    )


def resumed_item(item: Item, hand: int | None, records: tuple[dict[str, Any], ...], so_far: SoFar | None = None) -> Item:
    """The test from its last checkpoint, in the present mounting."""
    hand = item.hand if hand is None else hand
    left, offset, resume_trail, remainder = rest_of(item.whole, hand, records, item.before, so_far)
    return replace(item, left=left, offset=offset, resume_trail=resume_trail, hand=hand, remainder=remainder)


async def read_path(session: Session, store: Store, campaign: int, test: str, mounting: int) -> SoFar | None:
    """How far the path of a test was read in a mounting, if the ball-bar's box has not been restarted since."""

    def look() -> SoFar | None:
        lines = (one.doc for one in store.checkpoints.of_campaign(campaign) if one.kind == RUN)
        runs = [int(one["run"]) for one in lines if one["test"] == test and one["mounting"] == mounting]
        return path_so_far(store, max(runs)) if runs else None

    found = await asyncio.to_thread(look) if session.ballbar is not None else None
    if found is None or session.ballbar is None:
        return None
    return found if await session.ballbar.peek_boot_id() == found.boot_id else None


def halfway(item: Item) -> str:
    """The question before a path goes on where it was."""
    return f"Set-up {item.setup} was left mounted, {item.test.label} half read. Has nobody touched it since?"


@dataclass(frozen=True, slots=True)
class Resumed:
    """Where a campaign goes on that was broken off: ``done`` complete runs by test, ``start`` the tests that begin elsewhere than planned.

    ``campaign``: number and clock zero; ``mounted_us``: when each mounting was made; ``said``: what was found, one sentence each;
    ``expected``: controller run and table that the campaign was begun with.
    """

    campaign: tuple[int, int]
    done: dict[str, int]
    start: dict[str, Item]
    mountings: dict[str, int]
    used: frozenset[tuple[str, int]]
    mounted_us: dict[str, int]
    said: tuple[str, ...]
    expected: ExpectedTable | None = None


@dataclass
class CampaignRun:
    """What it takes to carry a campaign through: who may say what, what is watched, where it is written down.

    ``mountings``: how often each set-up was mounted; ``used``: set-ups (planned name, mounting) with a complete run; ``labels``: taken
    names of runs; ``read_path``: how far the path of a test was read in a mounting.
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
    read_path: Callable[[str, int], Awaitable[SoFar | None]] = _nothing_read

    def runner(self) -> Runner:
        """A runner for one attempt."""
        return Runner(self.session, self.control, self.watching, self.journal, self.expected)

    async def complete(self, item: Item, once: Callable[[TestPlan, Attempt, Runner], Awaitable[int]]) -> int:
        """Run a test until it is complete; returns the number of its complete run.

        Parameters
        ----------
        once : callable
            Runs one attempt as one run of the store.

        Raises
        ------
        AbbeError, DriverError
            What cannot be gone on from without a person.
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
        """Before a run starts: the same controller with the same table, no other program, and no hold that a killed process has left.

        Raises
        ------
        WorldChanged, Interlock
            Not so.
        """
        comp = await self.session.controller.comp_status()
        check_expected(self.expected, comp.boot_id, comp.bank_crc[comp.active_bank])
        if not self.freed:
            check_interlocks(await self.session.controller.status())
            await self.session.controller.abort()  # an abort that was not finished is not to be seen in the status
            self.freed = True

    async def _next(self, item: Item, runner: Runner, why: RunInterrupted | SetupDisturbed | Interlock, so_far: SoFar | None) -> Item:
        """Wait as long as it has to, then the test from its last checkpoint.

        Raises
        ------
        Interlock, Stopped, Aborted, WorldChanged
            It does not go on.
        """
        if isinstance(why, StretchDiffers) and (item.setup, item.mounting) not in self.used:
            return resumed_item(item, runner.hand, ())  # nothing is kept that the mounting could contradict
        if isinstance(why, SetupDisturbed):
            return self.again_mounted(item)
        if isinstance(why, Interlock):
            if not may_suspend(why, self.watching.suspending):
                raise why
            touched = await suspended(self.session, self.control, self.watching, self.expected, self.journal, why)
        else:
            touched = await paused(self.session, self.control, self.watching, self.expected, self.journal) or runner.touched
        if runner.asked is not None:  # it is unknown how far the mounting has come
            return self.again_mounted(item)
        records = () if isinstance(why, BeamLost) else tuple(runner.records)
        again = resumed_item(item, runner.hand, records)
        item = resumed_item(item, runner.hand, records, so_far)
        if not touched or await self.untouched(item):
            return item
        return self.again_mounted(item) if (item.setup, item.mounting) in self.used else again

    async def untouched(self, item: Item) -> bool:
        """Whether what is mounted can still be used after a person may have touched it.

        A set-up of which nothing is kept has nothing that it could contradict; a laser run that goes on reads its last point again. Else a
        person must say so: the stretch of a path that is read twice shows a cup that was knocked along the bar, not across it.
        """
        if item.resume_trail.carried:
            return True
        if (item.setup, item.mounting) in self.used:
            return await self.confirm(f"Set-up {item.setup} was left mounted and has complete runs. Has nobody touched it since?")
        return item.remainder is None or await self.confirm(halfway(item))

    def again_mounted(self, item: Item) -> Item:
        """The test with its set-up mounted once more."""
        number = self.mountings.get(item.setup, item.mounting) + 1
        self.mountings[item.setup] = number
        return mounted_anew(item, number)

    def _named(self, test: TestPlan) -> TestPlan:
        """The test under a name that no run of the campaign has yet."""
        label, n = test.label, 1
        while label in self.labels:
            n += 1
            label = f"{test.label}-{n}"
        self.labels.add(label)
        return replace(test, label=label)
