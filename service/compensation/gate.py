"""The one gate in front of every push: it reports all reasons against a table at once.

`check_preconditions` asks what holds for any table of this control, `admit` everything about one proposal. A push takes the `Admission`
and cannot begin without it; only `admit` makes one.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass, field

from abbe.models.compensation.tables import Predicted
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import check_commissioned
from abbe.service.compensation.proposal_checks import PushPrecheck, precheck
from abbe.service.compensation.proposal_doc import load
from abbe.service.compensation.proved_levels import LevelStatus, check_level
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.errors import TableRefused
from abbe.service.push.limits import Capabilities, PushLimits
from abbe.service.push.validate import promise_reason
from abbe.service.sequences.control import Control
from abbe.service.sequences.needed import check_devices
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.site import Site
from abbe.service.storage.store import Store


@dataclass(frozen=True, slots=True)
class PushContext:
    """What a push works with.

    ``rate_hz``: of the ball-bar, in verifications. ``attended``: a person orders the push; otherwise the limits of unattended pushes hold
    as well, and an approval is always needed. ``control``: stops or pauses the push; while an unverified table is in force the push cannot
    be paused, and a stop rolls it back.
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
    """The token of a push: a proposal with no reason against it, and the readings and decisions that this rests on.

    ``level``: capability level of the controller (`abbe.service.push.limits`). ``hint``: a warning about the control for people, or empty.
    """

    precheck: PushPrecheck
    level: int
    hint: str


async def check_preconditions(context: PushContext) -> LevelStatus:
    """Check that this control can take a table and that the table could be verified; return its proved level.

    Raises
    ------
    TableRefused
        The control was never commissioned, or allows no such push.
    AbbeError, DriverError
        From `recover` and `check_devices`.
    """
    level, refused = await _check_control(context)
    if refused:
        raise _refused(refused)
    return level


async def admit(context: PushContext, number: int, control: LevelStatus | None = None) -> Admission:
    """Admit a stored proposal if there is no reason against it now. Nothing is written.

    The push machine (`abbe.service.push.machine`) checks again what can change before the table is written: bank and generation of the
    table in force, decisions of people, age of the measurement.

    Parameters
    ----------
    number : int
        Number of the proposal.
    control : LevelStatus, optional
        Result of an earlier `check_preconditions`. Default: it is called now.

    Raises
    ------
    TableRefused
        With all reasons against it.
    StoreError
        There is no such proposal, or its row was changed.
    AbbeError, DriverError
        From `check_preconditions`.
    """
    level, refused = (control, []) if control is not None else await _check_control(context)
    proposed = await asyncio.to_thread(load, context.store, number)
    checked = await precheck(
        context.session.controller, context.store, context.site, number, proposed, context.clock, attended=context.attended
    )
    reasons = checked.reasons()
    if refused or reasons:
        raise _refused(refused, reasons)
    return Admission(checked, level.level, level.hint)


async def _check_control(context: PushContext) -> tuple[LevelStatus, list[TableRefused]]:
    """Finish an interrupted push, check every device that a verification needs; return the proved level and the refusals."""
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
    """Refuse tables that are not worth writing.

    Raises
    ------
    TableRefused
        The promised improvement is too small, absolutely or against the uncertainty of the model (`PushLimits`).
    """
    no = promise_reason(predicted.before_mm, predicted.after_mm, predicted.u_model_mm, limits)
    if no:
        raise TableRefused(no, "the present table is as good as these runs can tell; nothing was written")
