"""The one gate before a table is measured for or pushed: everything that speaks against it, at once.

`ready` asks what holds for any table of this control, `admit` everything of one proposal. A push takes the `Admission` and cannot
begin without it; only `admit` makes one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

from abbe.models.compensation.tables import Predicted
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import check_commissioned
from abbe.service.compensation.proposal_checks import HoldReason, hold
from abbe.service.compensation.proposal_doc import load
from abbe.service.compensation.proved_levels import check_level
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.errors import TableRefused
from abbe.service.push.limits import PushLimits
from abbe.service.push.validate import promise_reason
from abbe.service.sequences.control import Control
from abbe.service.sequences.needed import check_devices
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.site import Site
from abbe.service.storage.store import Store


class NotAdmitted(TableRefused):
    """The gate is closed: nothing was written. ``reasons``: everything that speaks against it."""

    def __init__(self, reasons: Sequence[str], remedy: str = "") -> None:
        super().__init__("; ".join(reasons), remedy or "nothing was written")
        self.reasons = tuple(reasons)


@dataclass(frozen=True, slots=True)
class PushContext:
    """What a push works with.

    Parameters
    ----------
    session, store, site : Session, Store, Site
        Open devices, database, machine.
    progress : callable
        Hears how far it is.
    clock : Clock
        Now.
    rate_hz : int
        Of the ball-bar, in verifications.
    attended : bool
        A person orders it. Else the limits of unattended pushes hold as well, and a person's approval is needed in any case.
    control : Control
        Who may stop or pause it. While a table is in force that nothing has verified it cannot be paused, and a stop takes the old
        one back.
    """

    session: Session
    store: Store
    site: Site
    progress: ProgressSink = ignore_progress
    clock: Clock = field(default_factory=SystemClock)
    rate_hz: int = 100
    attended: bool = True
    control: Control = field(default_factory=Control)


@dataclass(frozen=True, slots=True)
class Admission:
    """A proposal that nothing speaks against, held against controller, approvals and limits as they were then."""

    held: HoldReason
    hint: str
    """What has to be said about the control; empty: nothing."""


async def ready(context: PushContext) -> str:
    """Make sure that a table could be pushed into this control and verified; return what has to be said about the control.

    Raises
    ------
    NotAdmitted
        It could not: its tables were never proved, it allows no such push.
    AbbeError, DriverError
        As of `recover` and `check_devices`.
    """
    hint, reasons, remedy = await _control(context)
    if reasons:
        raise NotAdmitted(reasons, remedy)
    return hint


async def admit(context: PushContext, number: int) -> Admission:
    """Let a stored proposal pass, if nothing speaks against it now. Nothing is written.

    Raises
    ------
    NotAdmitted
        All reasons against it.
    StoreError
        There is no such proposal, or its row was changed.
    AbbeError, DriverError
        As of `ready`.
    """
    hint, reasons, remedy = await _control(context)
    proposed = await asyncio.to_thread(load, context.store, number)
    held = await hold(context.session.controller, context.store, context.site, number, proposed, context.clock, attended=context.attended)
    reasons += held.reasons()
    if reasons:
        raise NotAdmitted(reasons, remedy)
    return Admission(held, hint)


async def _control(context: PushContext) -> tuple[str, list[str], str]:
    """What an earlier push left is finished first, and every device that a verification needs has answered."""
    session, store, site = context.session, context.store, context.site
    await recover(session.controller, store, site)
    await check_devices(session, verification(site.machine, rate_hz=context.rate_hz), air=site.watching.air_c is not None)
    hint, refused = "", []
    try:
        await check_commissioned(session.controller, store, site)
    except TableRefused as no:
        refused.append(no)
    try:
        hint = await check_level(session.controller, store, site, attended=context.attended)
    except TableRefused as no:
        refused.append(no)
    return hint, [no.detail for no in refused], refused[0].remedy if refused else ""


def check_promise(predicted: Predicted, limits: PushLimits) -> None:
    """Refuse what is not worth writing.

    Raises
    ------
    TableRefused
        The model promises too little, by itself or beside its own uncertainty (`PushLimits`).
    """
    no = promise_reason(predicted.before_mm, predicted.after_mm, predicted.u_model_mm, limits)
    if no:
        raise TableRefused(no, "the present table is as good as these runs can tell; nothing was written")
