"""Close what an earlier process left open: runs whose samples are still in capture segments, and an unfinished push.

The service does this at its start, and again when a push is left open with an unverified table in force. A failure is shown until a later
try succeeds.
"""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, MutableSequence
from dataclasses import asdict

import structlog

from abbe.drivers.errors import DriverError
from abbe.service.capture.recovery import recover_segments
from abbe.service.clock import Clock
from abbe.service.compensation.recover import recovered_session
from abbe.service.core.jobs import MachineClaim
from abbe.service.devices.session import DeviceUrls, lock_machine
from abbe.service.domain.push_entry import TERMINAL, PushState
from abbe.service.errors import AbbeError, MachineInUse
from abbe.service.scheduler.loop import AlarmSink
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.verification import verify

log = structlog.get_logger("abbe.recovery")

AGAIN_S = 30.0
LOOK_S = 5.0
"""Time between two looks at the journal for an open push, s; the controller is not asked."""
BUSY_S = 1.0
NAME = "recovery of an interrupted run or push"

Recover = Callable[[], Awaitable[str | None]]
"""``await recover()``: closes what is open; returns a text of what was done, or None. Opens the controller only if a push is open."""


IsOpen = Callable[[], Awaitable[bool]]
"""Returns whether the push journal shows the machine's last push as open; a push under way, or one that needs a person, is open, too."""


class PushRecovery:
    """Retries the recovery until no run and no push is open, and starts again when a push ends unfinished.

    Parameters
    ----------
    recover : callable
        ``await recover()`` makes one try.
    is_open : callable
        Whether a push is open; called again and again once everything was closed.
    claim : MachineClaim
        Claims the machine during a try, so that no check starts.
    alarms : AlarmSink
        Gets each new reason for a failure.
    attention : list of str
        Texts on the page until the recovery succeeds.
    changed : callable
        Called when ``attention`` has changed.
    """

    def __init__(
        self,
        recover: Recover,
        is_open: IsOpen,
        claim: MachineClaim,
        alarms: AlarmSink,
        attention: MutableSequence[str],
        clock: Clock,
        changed: Callable[[], None],
    ) -> None:
        self._recover, self._is_open, self._claim, self._alarms = recover, is_open, claim, alarms
        self._attention, self._clock, self._changed = attention, clock, changed
        self._reported: str | None = None

    async def run(self) -> None:
        """Work forever: close what is open, then watch for a push that any process leaves open."""
        while True:
            while not await self._try():
                await self._clock.sleep(AGAIN_S)
            while not await self._left_open():
                await self._clock.sleep(LOOK_S)

    async def _left_open(self) -> bool:
        """Look at the journal only: the machine is not locked if there is nothing to roll back."""
        try:
            return await self._is_open()
        except AbbeError as trouble:  # a push or a check may lock the database: the next look is soon
            log.warning("push journal unreadable; retry", cause=trouble.detail)
            return False

    async def _try(self) -> bool:
        while self._claim.take(NAME):  # a check runs, and has closed what was open before it moved; or the push itself runs
            await self._clock.sleep(BUSY_S)
        try:
            done = await self._recover()
        except (AbbeError, DriverError, OSError) as trouble:
            if isinstance(trouble, MachineInUse):
                log.info("waiting for another process", cause=str(trouble))
            else:
                await self._report(trouble)
            return False
        finally:
            self._claim.give_back()
        if done:
            log.warning("recovery done: open pushes are closed", what=done)
        self._show(None)
        return True

    async def _report(self, trouble: Exception) -> None:
        cause = verify.cause_of(trouble)
        text = f"{cause.code}: {cause.what}" + (f" - {cause.remedy}" if cause.remedy else "")
        if text == self._reported:
            return
        self._show(text)
        known = asdict(cause)
        log.error("recovery failed: open pushes remain open", **known)
        await self._alarms.alarm({**known, "at_utc": self._clock.utc().isoformat()})

    def _show(self, text: str | None) -> None:
        if self._reported is not None:
            self._attention.remove(self._reported)
        if text is not None:
            self._attention.append(text)
        self._reported = text
        self._changed()


async def recover_at_start(store: Store, site: Site) -> str | None:
    """Close interrupted runs; finish an open push, the only case that opens the controller. Return what was done; None: nothing was open.

    Raises
    ------
    AbbeError, DriverError
        As `abbe.service.compensation.recover.recover`: the controller cannot be reached, or a person has to look.
    """
    runs = await asyncio.to_thread(recover_segments, store, site.capture)
    done = [run.text for run in runs]
    if await push_is_open(store, site.name, site.urls.control):
        with lock_machine(site.urls.cnc):
            async with recovered_session(store, site, DeviceUrls(cnc=site.urls.cnc), report=done.append):
                pass
    return "; ".join(done) or None


async def push_is_open(store: Store, machine: str, control: str = "") -> bool:
    """Return whether the journal shows that the last push into a control is under way, waits for its rollback, or needs a person.

    Raises
    ------
    StoreError
        The database does not answer.
    """
    journal = await asyncio.to_thread(store.pushes.last, machine, control)
    if not journal:
        return False
    state = PushState(journal[-1].state)
    return state is PushState.OPERATOR or state not in TERMINAL
