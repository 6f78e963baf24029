"""Store methods for proposals of tables and their approvals: only ever appended, never changed."""

from __future__ import annotations

from sqlalchemy import insert, select

from abbe.service.domain.decisions import ProposalApproval, ProposalRecord
from abbe.service.domain.document import Doc
from abbe.service.errors import NotStored
from abbe.service.storage.base import StoreBase
from abbe.service.storage.mapping import RecordMapping
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import approvals, proposals

APPROVAL = RecordMapping(ProposalApproval, approvals)


class ProposalStore(StoreBase):
    """Proposals of tables."""

    def add_proposal(self, machine: str, solution_id: int, doc: Doc, digest: str) -> int:
        """Store a proposal.

        Parameters
        ----------
        machine : str
            Name of the machine.
        solution_id : int
            Solution that the tables follow from.
        doc : dict
            The proposal; no NaN.
        digest : str
            SHA-256 of it.

        Returns
        -------
        int
            Id.
        """
        values = {"machine": machine, "solution_id": solution_id, "doc": doc, "digest": digest, "created_utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(proposals).values(values)))

    def proposal(self, proposal_id: int) -> ProposalRecord:
        """Read one proposal; NotStored if there is none."""
        query = select(proposals).where(proposals.c.id == proposal_id)
        found = self._read(lambda connection: connection.execute(query).first())
        if found is None:
            raise NotStored(f"no proposal {proposal_id} in {self.url}", "abbe comp show lists them")
        return ProposalRecord(*found)

    def proposals(self, machine: str | None = None) -> list[ProposalRecord]:
        """List proposals (for one machine), oldest first."""
        query = select(proposals).order_by(proposals.c.id)
        if machine is not None:
            query = query.where(proposals.c.machine == machine)
        return [ProposalRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]

    def add_approval(self, approval: ProposalApproval) -> int:
        """Store an approval; its ``id`` and ``utc`` are given here. Returns the id."""
        values = APPROVAL.values(approval, "id") | {"utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(approvals).values(values)))

    def approvals(self, proposal_id: int) -> list[ProposalApproval]:
        """List approvals of a proposal, oldest first."""
        query = APPROVAL.select().where(approvals.c.proposal_id == proposal_id).order_by(approvals.c.id)
        return [APPROVAL.read(row) for row in self._read(lambda connection: connection.execute(query).all())]
