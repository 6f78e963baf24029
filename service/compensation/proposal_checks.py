"""Reasons against a stored proposal now: all that was true when it was made is asked again before a register is written."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from typing import Any

from abbe.drivers.api import TableController
from abbe.service.clock import Clock
from abbe.service.compensation.candidates import scene_of, until_s
from abbe.service.compensation.proposal_doc import Proposed
from abbe.service.compensation.proposals import by_whom, login
from abbe.service.domain.decisions import ProposalApproval, ProposalRejection
from abbe.service.errors import TableRefused
from abbe.service.push.candidate import Candidate, CandidateContext, EvidenceSeal
from abbe.service.push.operations import Approval
from abbe.service.push.validate import content_digest, reasons_against
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.base_table import Base, read_base


@dataclass(frozen=True)
class HoldReason:
    """A proposal held against its machine, its controller and its approvals as they are now.

    ``attended``: a person pushes it; else an approval is needed even where two people are not demanded.
    """

    number: int
    proposed: Proposed
    site: Site
    base: Base
    scene: CandidateContext
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
        """All reasons against pushing it now; ``drift_mm``: what its solution leaves of a newer run that it has not seen."""
        candidate = self.proposed.candidate
        if drift_mm is not None and candidate.digest == content_digest(candidate):
            candidate = _drifted(candidate, drift_mm)
        found = [*self._bound(), *self._rejected(), *reasons_against(candidate, self.scene, self.site.limits), *self._approved()]
        if self.proposed.reasons and not found:
            found = [f"PROPOSED: with {len(self.proposed.reasons)} reasons against it, which are gone now: propose again"]
        return found

    def renewed(self, store: Store, now_s: float) -> HoldReason:
        """The same with the decisions of people and the time as they are now; the controller is as it was read."""
        approvals, rejections = tuple(store.proposals.approvals(self.number)), tuple(store.proposals.rejections(self.number))
        return replace(self, approvals=approvals, rejections=rejections, scene=replace(self.scene, now_s=now_s))

    def _bound(self) -> Iterator[str]:
        p, now = self.proposed, self.base
        if p.machine != self.site.doc:
            yield "MACHINE: the machine file describes another machine than it was proposed for (name, chain, strokes, pivots or tool)"
        if now.crc == p.candidate.base_crc and now.image != p.base.image:
            yield "BASE: the table in force has the CRC of the one that it was proposed on, and another content"
        if now.status.boot_id != p.base.boot:
            yield f"RESTART: the controller restarted since (boot {p.base.boot:08X} then, {now.status.boot_id:08X} now): measure again"
        if now.status.gen != p.base.gen:
            yield f"GENERATION: a bank was written since (generation {p.base.gen} then, {now.status.gen} now): propose again"
        if not set(p.candidate.evidence.calibrated_until_s) <= {until_s(day) for day in self.site.calibrated_until.values()}:
            yield "CERTIFICATE: the certificates in the machine file are others than when it was proposed: propose again"
        if self.site.limits != p.limits:
            yield f"LIMITS: changed since it was proposed ({_changed(asdict(p.limits), asdict(self.site.limits))}): propose again"

    def _rejected(self) -> Iterator[str]:
        for row in self.rejections[-1:]:
            yield f"REJECTED: by {row.name} at {row.utc}: {row.reason}"

    def _approved(self) -> Iterator[str]:
        found, why = valid_approval(self.proposed, self.approvals, self.scene.now_s, two_people=self.site.two_people)
        if self.site.two_people != self.proposed.two_people:
            yield "APPROVAL: whether two people are needed was changed in the machine file since it was proposed: propose again"
        elif self._needs_approval and found is None:
            yield f"APPROVAL: {why}"

    def approval(self, clock: Clock) -> Approval | None:
        """The approval that the push machine checks against what it has read; None where the one who orders the push approves it."""
        if not self._needs_approval:
            return None
        found, why = valid_approval(self.proposed, self.approvals, clock.utc().timestamp(), two_people=self.site.two_people)
        if found is None:
            raise TableRefused(why, "abbe comp approve; nothing was written")
        left_s = _utc_s(found.expiry) - clock.utc().timestamp()
        return Approval(found.digest, f"{found.name}; pushed by {self.by}", found.expiry, clock.monotonic_s() + left_s)


async def hold(
    controller: TableController, store: Store, site: Site, number: int, proposed: Proposed, clock: Clock, *, attended: bool = True
) -> HoldReason:
    """Read what a proposal is held against. Nothing is written."""
    base = await read_base(controller)
    scene = await scene_of(site, store, base, await controller.table_format(), proposed.tables, clock, attended=attended)
    approvals, rejections = await asyncio.to_thread(lambda: (store.proposals.approvals(number), store.proposals.rejections(number)))
    return HoldReason(number, proposed, site, base, scene, tuple(approvals), tuple(rejections), attended)


def valid_approval(
    proposed: Proposed, approvals: Sequence[ProposalApproval], now_s: float, *, two_people: bool
) -> tuple[ProposalApproval | None, str]:
    """The last approval that holds now; else None and why there is none."""
    why = "nobody has approved it: abbe comp approve"
    for row in reversed(approvals):
        if two_people and same_person(row.name, proposed.by):
            why = f"{row.name} proposed it and cannot be the one who approves it"
        elif row.digest != proposed.binding(row.expiry):
            why = f"what {row.name} approved is not this table on this base under these limits"
        elif now_s >= _utc_s(row.expiry):
            why = f"the approval of {row.name} expired at {row.expiry}"
        else:
            return row, ""
    return None, why


def same_person(one: str, other: str) -> bool:
    """Whether two names are the same person's."""
    return one.strip().casefold() == other.strip().casefold()


def _utc_s(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


def _drifted(candidate: Candidate, drift_mm: float) -> Candidate:
    """The candidate with what became known after it was signed; only to be judged, never stored."""
    later = replace(candidate, evidence=replace(candidate.evidence, drift_mm=drift_mm))
    digest = content_digest(later)
    return replace(later, digest=digest, seal=EvidenceSeal(later.seal.role, digest))


def _changed(then: dict[str, Any], now: dict[str, Any]) -> str:
    return ", ".join(f"{key} {_words(then[key])} then, {_words(now[key])} now" for key in then if then[key] != now[key])


def _words(value: object) -> str:
    return " to ".join(f"{v:g}" for v in value) if isinstance(value, tuple | list) else f"{value:g}"
