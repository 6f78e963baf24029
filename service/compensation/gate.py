"""The one gate before a table is measured for or pushed: all reasons against it, at once.

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
from abbe.service.compensation.proved_levels import LevelStatus, check_level
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.errors import TableRefused
from abbe.service.push.levels import Capabilities
from abbe.service.push.limits import PushLimits
from abbe.service.push.validate import promise_reason
from abbe.service.sequences.control import Control
from abbe.service.sequences.needed import check_devices
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.site import Site
from abbe.service.storage.store import Store


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
    """The token of a push: a proposal that had no reason against it, with what its controller and people said then.

    ``level``: capability level of the controller (`abbe.service.push.levels`). ``hint``: what has to be said about the control; empty:
    nothing.
    """

    held: HoldReason
    level: int
    hint: str


async def ready(context: PushContext) -> LevelStatus:
    """Make sure that a table could be pushed into this control and verified; return what its commissioning has proved.

    Raises
    ------
    TableRefused
        It could not: its tables were never proved, it allows no such push.
    AbbeError, DriverError
        As of `recover` and `check_devices`.
    """
    level, refused = await _control(context)
    if refused:
        raise _refused(refused)
    return level


async def admit(context: PushContext, number: int, control: LevelStatus | None = None) -> Admission:
    """Let a stored proposal pass if there is no reason against it now. Nothing is written.

    What can change until the table is written is asked once more by the push machine (`abbe.service.push.machine`): bank and generation
    of the table in force, the decisions of people, the age of the measurement.

    Parameters
    ----------
    context : PushContext
        Devices, store and machine.
    number : int
        Of the proposal.
    control : LevelStatus, optional
        From `ready`, where that was asked before; default: it is asked now.

    Raises
    ------
    TableRefused
        All reasons against it.
    StoreError
        There is no such proposal, or its row was changed.
    AbbeError, DriverError
        As of `ready`.
    """
    level, refused = (control, []) if control is not None else await _control(context)
    proposed = await asyncio.to_thread(load, context.store, number)
    held = await hold(context.session.controller, context.store, context.site, number, proposed, context.clock, attended=context.attended)
    reasons = held.reasons()
    if refused or reasons:
        raise _refused(refused, reasons)
    return Admission(held, level.level, level.hint)


async def _control(context: PushContext) -> tuple[LevelStatus, list[TableRefused]]:
    """What the control was proved to do, and why it takes no table. What an earlier push left is finished first, and every device that a
    verification needs has answered.
    """
    session, store, site = context.session, context.store, context.site
    if not session.recovered:
        await recover(session.controller, store, site)
    await check_devices(session, verification(site.machine, rate_hz=context.rate_hz), air=site.watching.air_c is not None)
    level, refused = LevelStatus(Capabilities(), ""), []
    try:
        await check_commissioned(session.controller, store, site)
    except TableRefused as no:
        refused.append(no)
    try:
        level = await check_level(session.controller, store, site, attended=context.attended)
    except TableRefused as no:
        refused.append(no)
    return level, refused


def _refused(refused: Sequence[TableRefused], reasons: Sequence[str] = ()) -> TableRefused:
    return TableRefused.because([*(no.detail for no in refused), *reasons], refused[0].remedy if refused else "nothing was written")


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
