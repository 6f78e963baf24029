"""Decisions: proposals with their approvals, and push journals.

A push journal is one append-only chain for each control, named after the machine that first pushed into it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy import Connection, func, select

from abbe.service.domain.decisions import ProposalApproval, ProposalRecord, ProposalRejection
from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushEntry
from abbe.service.errors import StoreError
from abbe.service.storage.database import APPROVAL, PROPOSAL, PUSH_ENTRY, PUSH_MARK, REJECTION, Repository, if_given, insert_row
from abbe.service.storage.tables import approvals, proposals, push_entries, rejections


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


MARKS = ("base_crc", "crc", "accepted_crc", "machine", "control", "by")
"""Keys of an entry's document that `Pushes.marks` reads: tables, machine, control, and who vouched."""
NAME_LENGTH = 200


class Pushes(Repository):
    """Journals of pushes."""

    def append(self, entry: PushEntry) -> int:
        """Append an entry to its journal if the entry before it is still the last one; return its id. On return it is on disk.

        Raises
        ------
        StoreError
            Another process has written an entry meanwhile, or the entry cannot be written.
        """

        def work(connection: Connection) -> int:
            query = select(push_entries.c.digest).where(push_entries.c.machine == entry.machine).order_by(push_entries.c.id.desc()).limit(1)
            head = connection.execute(query).scalar()
            if head is not None and head != entry.prev:
                raise StoreError(
                    f"push {entry.push} of {entry.machine}: another process has written into the journal meanwhile",
                    "another process pushes or recovers on this machine: wait until it has ended",
                )
            return insert_row(connection, push_entries, **PUSH_ENTRY.values(entry, "number"))

        return self._db.commit(work)

    def chain(self, machine: str, control: str = "") -> str:
        """Name of a control's journal, that of the first machine that pushed into it.

        ``control``: identity of the control; empty: unknown, then it is the journal in which this machine name was last used.
        """
        doc = push_entries.c.doc
        names = (push_entries.c.machine, doc["machine"].as_string().label("name"), doc["control"].as_string().label("control"))
        query = select(*names).where(push_entries.c.seq == 0).order_by(push_entries.c.id.desc())
        rows = self._db.read(lambda connection: connection.execute(query).all())
        return chain_of([(row.machine, row.name or row.machine, row.control or "") for row in rows], machine, control)

    def entries(self, machine: str, control: str = "") -> list[PushEntry]:
        """Read the journal of all pushes of a machine's control from its beginning (`chain`)."""
        return self.entries_of(self.chain(machine, control))

    def entries_of(self, chain: str) -> list[PushEntry]:
        """Read a journal by its name."""
        return self._all(PUSH_ENTRY, push_entries.c.machine == chain)

    def last(self, machine: str, control: str = "") -> list[PushEntry]:
        """Read the journal of the last push of a machine's control (`chain`); empty if there was none."""
        chain = self.chain(machine, control)
        latest = select(func.max(push_entries.c.push)).where(push_entries.c.machine == chain).scalar_subquery()
        return self._all(PUSH_ENTRY, push_entries.c.machine == chain, push_entries.c.push == latest)

    def marks(self) -> list[PushEntry]:
        """Read the entries of all journals in the order of writing; documents hold `MARKS` only, no images."""
        marks = [push_entries.c.doc[key].as_string().label(f"mark_{key}") for key in MARKS]
        query = PUSH_MARK.select().add_columns(*marks).order_by(push_entries.c.id)
        rows = self._db.read(lambda connection: connection.execute(query).mappings().all())
        return [
            replace(
                PUSH_MARK.from_values(row),
                doc={key: int(value) if key.endswith("crc") else str(value) for key in MARKS if (value := row[f"mark_{key}"]) is not None},
            )
            for row in rows
        ]


def chain_of(begun: Sequence[tuple[str, str, str]], machine: str, control: str) -> str:
    """Find the journal of a control.

    Parameters
    ----------
    begun : sequence of tuple
        First entries of pushes, newest first: journal, machine name, control (empty: unknown).
    machine, control : str
        Without a control the name decides: the journal in which it was last used.
    """
    if not control:
        return next((chain for chain, name, _ in begun if name == machine), machine)
    last: dict[str, tuple[str, str]] = {}
    for chain, name, at in begun:
        last.setdefault(chain, (name, at))
    # Only the last address of each journal counts: a control may have left an earlier one.
    own = next((chain for chain, (_, at) in last.items() if at == control), None)
    if own is not None:
        return own
    # An unknown control has a new address. It owns the journal of its name, unless a machine of another name has used that since.
    # `abbe.service.compensation.recover.is_own` checks an open push in it against the control.
    named = next((chain for chain, (name, _) in last.items() if name == machine), None)
    if named is not None:
        return named
    return machine if machine not in last else f"{machine} ({control})"[:NAME_LENGTH]
