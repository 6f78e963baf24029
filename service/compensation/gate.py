"""The one gate in front of every push: it reports all reasons against a table at once.

`check_preconditions` checks the conditions for any table of this control, `admit` also those for one proposal. A push needs an `Admission`,
which only `admit` makes.

`PushPrecheck` repeats all checks of the proposal before a register is written.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from typing import Any

from abbe.drivers.api import TableController
from abbe.models.compensation.tables import Predicted
from abbe.service.audit.book import by_whom, login
from abbe.service.campaigns.device_checks import check_devices
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.commission import check_commissioned
from abbe.service.compensation.proposal_decisions import valid_approval
from abbe.service.compensation.proposal_doc import Proposed, load
from abbe.service.compensation.proposals import candidate_context, until_s
from abbe.service.compensation.proved_levels import LevelStatus, check_level
from abbe.service.compensation.recover import recover
from abbe.service.devices.session import Session
from abbe.service.domain.progress import ProgressSink, ignore_progress
from abbe.service.domain.results import ProposalApproval, ProposalRejection
from abbe.service.errors import TableRefused
from abbe.service.push.journal import PUSHED_BY, Capabilities
from abbe.service.push.operations import Approval
from abbe.service.push.validate import (
    Candidate,
    CandidateContext,
    EvidenceSeal,
    PushLimits,
    content_digest,
    promise_reason,
    reasons_against,
)
from abbe.service.sequences.control import Control
from abbe.service.sequences.recipes.campaigns import verification
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import Base, read_base

BY_ITS_OWN_PUSH = ("BASE: ", "GENERATION: ", "SIGN: ", "GAIN: ", "PROMISE: ")
"""What speaks against a proposal that is in force already, because it is."""


@dataclass(frozen=True)
class PushPrecheck:
    """A proposal with its machine, its controller and its decisions as they are now.

    ``attended``: a person pushes it; otherwise it needs an approval even where two people are not demanded.
    """

    number: int
    proposed: Proposed
    site: Site
    base: Base
    context: CandidateContext
    approvals: tuple[ProposalApproval, ...]
    rejections: tuple[ProposalRejection, ...] = ()
    attended: bool = True

    @property
    def _needs_approval(self) -> bool:
        return self.site.two_people or not self.attended

    @property
    def by(self) -> str:
        """Who pushes."""
        return by_whom() if self.attended else f"{login()}, by the service"

    def reasons(self, drift_mm: float | None = None) -> list[str]:
        """All reasons against pushing the proposal now.

        ``drift_mm``: rms residual of the proposal's solution in a newer run, which the solution did not use, mm.
        """
        candidate = self.proposed.candidate
        if drift_mm is not None and candidate.digest == content_digest(candidate):
            candidate = _drifted(candidate, drift_mm)
        found = [*self._bound(), *self._rejected(), *reasons_against(candidate, self.context, self.site.limits), *self._approved()]
        if any(reason.startswith("SAME: ") for reason in found):
            found = [reason for reason in found if not reason.startswith(BY_ITS_OWN_PUSH)]
        if self.proposed.reasons and not found:
            found = [f"PROPOSED: {len(self.proposed.reasons)} reasons were against the table and no longer hold: propose again"]
        return found

    def renewed(self, store: Store, now_s: float) -> PushPrecheck:
        """Return a copy with the present decisions and time; the controller is not read again."""
        approvals, rejections = tuple(store.proposals.approvals(self.number)), tuple(store.proposals.rejections(self.number))
        return replace(self, approvals=approvals, rejections=rejections, context=replace(self.context, now_s=now_s))

    def _bound(self) -> Iterator[str]:
        p, now = self.proposed, self.base
        if p.machine != self.site.doc:
            yield "MACHINE: the machine file has changed since the proposal (name, chain, strokes, pivots or tool)"
        if now.crc == p.candidate.base_crc and now.image != p.base.image:
            yield "BASE: the table in force has the CRC of the table at the proposal, but other content"
        if now.status.boot_id != p.base.boot:
            boots = f"boot {p.base.boot:08X} then, {now.status.boot_id:08X} now"
            yield f"RESTART: the controller restarted since the proposal ({boots}): measure again"
        if now.status.gen != p.base.gen:
            yield f"GENERATION: a bank was written since the proposal (generation {p.base.gen} then, {now.status.gen} now): propose again"
        if not set(p.candidate.evidence.calibrated_until_s) <= {until_s(day) for day in self.site.calibrated_until.values()}:
            yield "CERTIFICATE: the certificates in the machine file have changed since the proposal: propose again"
        if self.site.limits != p.limits:
            changes = _changed(asdict(p.limits), asdict(self.site.limits))
            yield f"LIMITS: the limits have changed since the proposal ({changes}): propose again"

    def _rejected(self) -> Iterator[str]:
        for row in self.rejections[-1:]:
            yield f"REJECTED: by {row.name} at {row.utc}: {row.reason}"

    def _approved(self) -> Iterator[str]:
        found, why = valid_approval(self.proposed, self.approvals, self.context.now_s, two_people=self.site.two_people)
        if self.site.two_people != self.proposed.two_people:
            yield "APPROVAL: two_people in the machine file has changed since the proposal: propose again"
        elif self._needs_approval and found is None:
            yield f"APPROVAL: {why}"

    def approval(self, clock: Clock) -> Approval | None:
        """The approval that the push machine checks against the controller; None where the person who orders the push approves it."""
        if not self._needs_approval:
            return None
        found, why = valid_approval(self.proposed, self.approvals, clock.utc().timestamp(), two_people=self.site.two_people)
        if found is None:
            raise TableRefused(why, "abbe comp approve; nothing was written")
        left_s = datetime.fromisoformat(found.expiry).timestamp() - clock.utc().timestamp()
        return Approval(found.digest, f"{found.name}{PUSHED_BY}{self.by}", found.expiry, clock.monotonic_s() + left_s)


async def precheck(
    controller: TableController, store: Store, site: Site, number: int, proposed: Proposed, clock: Clock, *, attended: bool = True
) -> PushPrecheck:
    """Read the state of machine, controller and decisions for a proposal. Nothing is written."""
    base = await read_base(controller)
    context = await candidate_context(site, store, base, await controller.table_format(), proposed.tables, clock, attended=attended)
    approvals, rejections = await asyncio.to_thread(lambda: (store.proposals.approvals(number), store.proposals.rejections(number)))
    return PushPrecheck(number, proposed, site, base, context, tuple(approvals), tuple(rejections), attended)


def _drifted(candidate: Candidate, drift_mm: float) -> Candidate:
    """Return the candidate with a drift that became known after it was signed; this copy is only checked, never stored."""
    later = replace(candidate, evidence=replace(candidate.evidence, drift_mm=drift_mm))
    digest = content_digest(later)
    return replace(later, digest=digest, seal=EvidenceSeal(later.seal.role, digest))


def _changed(then: dict[str, Any], now: dict[str, Any]) -> str:
    return ", ".join(f"{key} {_formatted(then[key])} then, {_formatted(now[key])} now" for key in then if then[key] != now[key])


def _formatted(value: object) -> str:
    return " to ".join(f"{v:g}" for v in value) if isinstance(value, tuple | list) else "none" if value is None else f"{value:g}"


@dataclass(frozen=True, slots=True)
class PushContext:
    """Open devices, database, machine and options of a push.

    ``rate_hz``: readings of the ball-bar per second in verifications. ``attended``: a person orders the push; otherwise the limits of
    unattended pushes hold as well, and an approval is always needed. ``control``: stops or pauses the push; while an unverified table is in
    force the push cannot be paused, and a stop rolls the table back. ``poses``: poses of an artefact that verify a table made of artefacts,
    in place of diagonals and a helix.
    """

    session: Session
    store: Store
    site: Site
    progress: ProgressSink = ignore_progress
    clock: Clock = field(default_factory=SystemClock)
    rate_hz: int = 100
    attended: bool = True
    control: Control = field(default_factory=Control)
    poses: CampaignPlan | None = None

    def verification(self, name: str) -> CampaignPlan:
        """Return the tests that are measured before and after a push."""
        if self.poses is None:
            return verification(self.site.machine, rate_hz=self.rate_hz, name=name)
        return replace(self.poses, name=name)


@dataclass(frozen=True, slots=True)
class Admission:
    """The token that a push needs: a proposal with no reason against it, and the readings and decisions that prove this.

    ``level``: proved level of the control (`abbe.service.push.journal`). ``hint``: a warning about the control for people, or empty.
    """

    precheck: PushPrecheck
    level: int
    hint: str


async def check_preconditions(context: PushContext) -> LevelStatus:
    """Check that this control can take a table and that the table could be verified; return the control's proved level.

    Raises
    ------
    TableRefused
        The control was never commissioned, or allows no push of this kind.
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
        With all reasons against the proposal.
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
    await check_devices(session, context.verification("verify"), air=site.watching.air_c is not None)
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
    if not no:
        return
    gain_mm = predicted.before_mm - predicted.after_mm
    if predicted.u_model_mm > limits.share * predicted.before_mm or gain_mm >= limits.gain * predicted.before_mm:
        raise TableRefused(no, "these runs determine the errors too poorly: measure more (`abbe plan`); nothing was written")
    raise TableRefused(no, "tables of this kind remove no more: `abbe solve --tables` compares the kinds; nothing was written")
