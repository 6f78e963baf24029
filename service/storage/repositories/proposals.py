"""Proposals of tables and people's decisions on them: append-only."""

from __future__ import annotations

from abbe.service.domain.decisions import ProposalApproval, ProposalRecord, ProposalRejection
from abbe.service.domain.document import Doc
from abbe.service.storage.mapping import APPROVAL, PROPOSAL, REJECTION
from abbe.service.storage.repository import Repository, if_given
from abbe.service.storage.tables import approvals, proposals, rejections


class Proposals(Repository):
    """Proposals, approvals, rejections."""

    def add(self, machine: str, solution_id: int, doc: Doc, digest: str) -> int:
        """Store a proposal for a machine (by name) from a solution; return its id. ``digest``: SHA-256 of ``doc``, which holds no NaN."""
        return self._add(proposals, machine=machine, solution_id=solution_id, doc=doc, digest=digest, created_utc=self._db.now())

    def get(self, proposal_id: int) -> ProposalRecord:
        """Read one proposal. Raises NotStored."""
        return self._get(PROPOSAL, proposal_id, "proposal", "abbe comp show lists them")

    def all(self, machine: str | None = None) -> list[ProposalRecord]:
        """List proposals (for one machine), oldest first."""
        return self._all(PROPOSAL, *if_given(proposals.c.machine, machine))

    def approve(self, approval: ProposalApproval) -> int:
        """Store an approval; return its id."""
        return self._add(approvals, **APPROVAL.values(approval, "id", "utc"), utc=self._db.now())

    def approvals(self, proposal_id: int) -> list[ProposalApproval]:
        """List approvals of a proposal, oldest first."""
        return self._all(APPROVAL, approvals.c.proposal_id == proposal_id)

    def reject(self, rejection: ProposalRejection) -> int:
        """Store a rejection; return its id."""
        return self._add(rejections, **REJECTION.values(rejection, "id", "utc"), utc=self._db.now())

    def rejections(self, proposal_id: int) -> list[ProposalRejection]:
        """List rejections of a proposal, oldest first."""
        return self._all(REJECTION, rejections.c.proposal_id == proposal_id)
