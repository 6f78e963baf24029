"""Reasons against a stored proposal now: everything that held when it was made is checked again before a register is written."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from typing import Any

from abbe.drivers.api import TableController
from abbe.service.clock import Clock
from abbe.service.compensation.candidates import candidate_context, until_s
from abbe.service.compensation.proposal_doc import Proposed
from abbe.service.compensation.proposals import by_whom, login
from abbe.service.domain.decisions import ProposalApproval, ProposalRejection
from abbe.service.errors import TableRefused
from abbe.service.push.operations import Approval
from abbe.service.push.validate import Candidate, CandidateContext, EvidenceSeal, content_digest, reasons_against
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.base_table import Base, read_base


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
        """All reasons against pushing it now. ``drift_mm``: residual of its solution in a newer run that it was not solved from."""
        candidate = self.proposed.candidate
        if drift_mm is not None and candidate.digest == content_digest(candidate):
            candidate = _drifted(candidate, drift_mm)
        found = [*self._bound(), *self._rejected(), *reasons_against(candidate, self.context, self.site.limits), *self._approved()]
        if self.proposed.reasons and not found:
            found = [f"PROPOSED: with {len(self.proposed.reasons)} reasons against it, which no longer hold: propose again"]
        return found

    def renewed(self, store: Store, now_s: float) -> PushPrecheck:
        """The same with the present decisions and time; the controller stays as it was read."""
        approvals, rejections = tuple(store.proposals.approvals(self.number)), tuple(store.proposals.rejections(self.number))
        return replace(self, approvals=approvals, rejections=rejections, context=replace(self.context, now_s=now_s))

    def _bound(self) -> Iterator[str]:
        p, now = self.proposed, self.base
        if p.machine != self.site.doc:
            yield "MACHINE: the machine file differs from the one at the proposal (name, chain, strokes, pivots or tool)"
        if now.crc == p.candidate.base_crc and now.image != p.base.image:
            yield "BASE: the table in force has the CRC of the one that it was proposed on, and another content"
        if now.status.boot_id != p.base.boot:
            yield f"RESTART: the controller restarted since (boot {p.base.boot:08X} then, {now.status.boot_id:08X} now): measure again"
        if now.status.gen != p.base.gen:
            yield f"GENERATION: a bank was written since (generation {p.base.gen} then, {now.status.gen} now): propose again"
        if not set(p.candidate.evidence.calibrated_until_s) <= {until_s(day) for day in self.site.calibrated_until.values()}:
            yield "CERTIFICATE: the certificates in the machine file have changed since it was proposed: propose again"
        if self.site.limits != p.limits:
            yield f"LIMITS: changed since it was proposed ({_changed(asdict(p.limits), asdict(self.site.limits))}): propose again"

    def _rejected(self) -> Iterator[str]:
        for row in self.rejections[-1:]:
            yield f"REJECTED: by {row.name} at {row.utc}: {row.reason}"

    def _approved(self) -> Iterator[str]:
        found, why = valid_approval(self.proposed, self.approvals, self.context.now_s, two_people=self.site.two_people)
        if self.site.two_people != self.proposed.two_people:
            yield "APPROVAL: the machine file has changed two_people since it was proposed: propose again"
        elif self._needs_approval and found is None:
            yield f"APPROVAL: {why}"

    def approval(self, clock: Clock) -> Approval | None:
        """The approval that the push machine checks against its readings; None where the person who orders the push approves it."""
        if not self._needs_approval:
            return None
        found, why = valid_approval(self.proposed, self.approvals, clock.utc().timestamp(), two_people=self.site.two_people)
        if found is None:
            raise TableRefused(why, "abbe comp approve; nothing was written")
        left_s = _utc_s(found.expiry) - clock.utc().timestamp()
        return Approval(found.digest, f"{found.name}; pushed by {self.by}", found.expiry, clock.monotonic_s() + left_s)


async def precheck(
    controller: TableController, store: Store, site: Site, number: int, proposed: Proposed, clock: Clock, *, attended: bool = True
) -> PushPrecheck:
    """Read the state of machine, controller and decisions for a proposal. Nothing is written."""
    base = await read_base(controller)
    context = await candidate_context(site, store, base, await controller.table_format(), proposed.tables, clock, attended=attended)
    approvals, rejections = await asyncio.to_thread(lambda: (store.proposals.approvals(number), store.proposals.rejections(number)))
    return PushPrecheck(number, proposed, site, base, context, tuple(approvals), tuple(rejections), attended)


def valid_approval(
    proposed: Proposed, approvals: Sequence[ProposalApproval], now_s: float, *, two_people: bool
) -> tuple[ProposalApproval | None, str]:
    """The last valid approval; otherwise None and the reason."""
    why = "nobody has approved it: abbe comp approve"
    for row in reversed(approvals):
        if two_people and same_person(row.name, proposed.by):
            why = f"{row.name} proposed it and cannot approve it"
        elif row.digest != proposed.binding(row.expiry):
            why = f"what {row.name} approved is not this table on this base under these limits"
        elif now_s >= _utc_s(row.expiry):
            why = f"the approval of {row.name} expired at {row.expiry}"
        else:
            return row, ""
    return None, why


def same_person(one: str, other: str) -> bool:
    """Whether two names belong to the same person: letter case and outer blanks do not count."""
    return one.strip().casefold() == other.strip().casefold()


def _utc_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _drifted(candidate: Candidate, drift_mm: float) -> Candidate:
    """The candidate with the drift that became known after signing; it is checked only, never stored."""
    later = replace(candidate, evidence=replace(candidate.evidence, drift_mm=drift_mm))
    digest = content_digest(later)
    return replace(later, digest=digest, seal=EvidenceSeal(later.seal.role, digest))


def _changed(then: dict[str, Any], now: dict[str, Any]) -> str:
    return ", ".join(f"{key} {_formatted(then[key])} then, {_formatted(now[key])} now" for key in then if then[key] != now[key])


def _formatted(value: object) -> str:
    return " to ".join(f"{v:g}" for v in value) if isinstance(value, tuple | list) else f"{value:g}"
