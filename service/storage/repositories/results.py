"""Results computed from runs: solutions, compensation tables, verifications, discoveries with their append-only states, and versions of
machines' models; and decisions on them: proposals with their approvals, and push journals.

A push journal is one append-only chain for each control, named after the machine that first pushed into it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from sqlalchemy import Connection, func, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.push_entry import PushEntry
from abbe.service.domain.results import (
    DiscoveryRecord,
    ModelRecord,
    NewVersion,
    ProposalApproval,
    ProposalRecord,
    ProposalRejection,
    SolutionRecord,
    StepRecord,
    TableRecord,
    VerificationRecord,
)
from abbe.service.errors import ModelMovedOn, StoreError
from abbe.service.storage.database import (
    APPROVAL,
    DISCOVERY,
    MODEL,
    PROPOSAL,
    PUSH_ENTRY,
    PUSH_MARK,
    REJECTION,
    SOLUTION,
    STEP,
    TABLE,
    VERIFICATION,
    Repository,
    if_given,
    insert_row,
)
from abbe.service.storage.repositories.service_records import queue_message
from abbe.service.storage.tables import (
    approvals,
    campaigns,
    comp_tables,
    discoveries,
    discovery_steps,
    machine_models,
    machines,
    proposals,
    push_entries,
    rejections,
    solutions,
    verifications,
)


class Solutions(Repository):
    """Results of solvers."""

    def add(self, campaign_id: int, kind: str, run_ids: Sequence[int], doc: Doc) -> int:
        """Store a solver's result (``kind``) from some runs of a campaign; return its id."""
        return self._add(solutions, campaign_id=campaign_id, kind=kind, run_ids=list(run_ids), doc=doc, created_utc=self._db.now())

    def get(self, solution_id: int) -> SolutionRecord:
        """Read one solution. Raises NotStored."""
        return self._get(SOLUTION, solution_id, "solution", "`abbe solve CAMPAIGN` stores one and says its number")

    def all(self, campaign_id: int | None = None) -> list[SolutionRecord]:
        """List solutions (of one campaign), oldest first."""
        return self._all(SOLUTION, *if_given(solutions.c.campaign_id, campaign_id))

    def latest(self, kind: str, limit: int) -> list[SolutionRecord]:
        """List the newest solutions of a kind, newest first. Each may be half a megabyte."""
        return self._all(SOLUTION, solutions.c.kind == kind, newest=True, limit=limit)


def insert_missing_tables(connection: Connection, machine_id: int, images: Mapping[int, bytes], now: str) -> None:
    """Store tables that came with runs measured elsewhere, by CRC, unless the machine has them already."""
    known = set(connection.scalars(select(comp_tables.c.crc).where(comp_tables.c.machine_id == machine_id)))
    for crc in images.keys() - known:
        row = {"machine_id": machine_id, "image": images[crc], "crc": crc, "doc": {"kind": "imported"}, "created_utc": now}
        connection.execute(comp_tables.insert().values(row))


class CompensationTables(Repository):
    """Compensation tables."""

    def add(self, machine_id: int, solution_id: int | None, image: bytes, crc: int, doc: Doc) -> int:
        """Store a table; return its id.

        ``solution_id`` None: a test step or a restored table. ``crc``: CRC-32 of ``image``; ``doc``: kind, and prediction or order.
        """
        values = {"machine_id": machine_id, "solution_id": solution_id, "image": image, "crc": crc, "doc": doc}
        return self._add(comp_tables, **values, created_utc=self._db.now())

    def add_missing(self, machine_id: int, images: Mapping[int, bytes]) -> None:
        """Store imported tables, by CRC, unless the machine has them already."""
        self._db.commit(lambda connection: insert_missing_tables(connection, machine_id, images, self._db.now()))

    def get(self, table_id: int) -> TableRecord:
        """Read one table. Raises NotStored."""
        return self._get(TABLE, table_id, "compensation table")

    def all(self, machine_id: int | None = None) -> list[TableRecord]:
        """List tables (of one machine), oldest first."""
        return self._all(TABLE, *if_given(comp_tables.c.machine_id, machine_id))


class Verifications(Repository):
    """Checks of machines."""

    def add(self, machine_id: int, campaign_id: int | None, verdict: str, doc: Doc) -> int:
        """Store the figures, limits and verdict of a check and the campaign that was measured for it; return its id."""
        return self._add(verifications, machine_id=machine_id, campaign_id=campaign_id, verdict=verdict, doc=doc, utc=self._db.now())

    def add_with_messages(self, machine_id: int, doc: Doc, messages: Sequence[tuple[str, Doc]]) -> int:
        """Store the result of a check and its messages in one transaction; return the number of the verification.

        Parameters
        ----------
        machine_id : int
            Used for checks that failed before they had a campaign.
        doc : dict
            As made by `abbe.service.verification.verify`.
        messages : sequence of (topic, document)
            For the broker; each document gets the number of the verification.
        """

        def work(connection: Connection) -> int:
            found = connection.execute(select(campaigns.c.id, campaigns.c.machine_id).where(campaigns.c.name == doc["campaign"])).first()
            campaign_id, of_machine = (None, machine_id) if found is None else (int(found.id), int(found.machine_id))
            values = {"machine_id": of_machine, "campaign_id": campaign_id, "verdict": doc["verdict"], "doc": doc}
            number = insert_row(connection, verifications, **values, utc=self._db.now())
            for topic, message in messages:
                queue_message(connection, topic, {"verification": number, **message}, self._db.now())
            return number

        return self._db.commit(work)

    def latest(self, machine_id: int | None = None, limit: int = 100) -> list[VerificationRecord]:
        """List checks (of one description of a machine), newest first."""
        return self._all(VERIFICATION, *if_given(verifications.c.machine_id, machine_id), newest=True, limit=limit)

    def of_machine(self, machine: str, limit: int = 100) -> list[VerificationRecord]:
        """List the latest checks of a machine by its name, newest first, including checks under earlier machine files."""
        return self._all(VERIFICATION, verifications.c.machine_id.in_(_descriptions(machine)), newest=True, limit=limit)

    def counts(self, machine: str) -> dict[str, int]:
        """Number of checks of a machine by verdict, over its whole history."""
        query = select(verifications.c.verdict, func.count()).where(verifications.c.machine_id.in_(_descriptions(machine)))
        rows = self._db.read(lambda connection: connection.execute(query.group_by(verifications.c.verdict)).all())
        return {str(verdict): int(count) for verdict, count in rows}


def _descriptions(machine: str) -> Any:
    return select(machines.c.id).where(machines.c.name == machine)


class Discoveries(Repository):
    """Searches for effects that a campaign's model lacks."""

    def add(self, campaign_id: int, digest: str, doc: Doc) -> int:
        """Open a discovery of a campaign; return its id. ``digest``: digest of readings, model and program; ``doc``: its start
        (`SearchBase`)."""
        return self._add(discoveries, campaign_id=campaign_id, digest=digest, doc=doc, created_utc=self._db.now())

    def get(self, discovery_id: int) -> DiscoveryRecord:
        """Read one discovery. Raises NotStored."""
        return self._get(DISCOVERY, discovery_id, "discovery")

    def all(self, campaign_id: int | None = None) -> list[DiscoveryRecord]:
        """List discoveries (of one campaign), oldest first."""
        return self._all(DISCOVERY, *if_given(discoveries.c.campaign_id, campaign_id))

    def steps(self, discovery_id: int) -> list[StepRecord]:
        """List the states that a discovery has reached, first to last."""
        return self._all(STEP, discovery_steps.c.discovery_id == discovery_id, order=discovery_steps.c.seq)

    def add_step(self, discovery_id: int, seq: int, state: str, doc: Doc, model: NewVersion | None = None) -> int | None:
        """Write the next state of a discovery and, in the same transaction, its new model version if there is one.

        ``seq``: number of the state, from 0; ``doc``: evidence, numbers, who decided. Returns the number of the new version, or None.

        Raises
        ------
        StoreError
            The state exists: another process works on the same discovery.
        ModelMovedOn
            The base of the new version is no longer the current version. The state is not written either.
        """

        def work(connection: Connection) -> int | None:
            try:
                insert_row(connection, discovery_steps, discovery_id=discovery_id, seq=seq, state=state, doc=doc, utc=self._db.now())
            except IntegrityError:
                raise StoreError(
                    f"discovery {discovery_id} has step {seq} already: another process works on it",
                    "wait until the other process has ended, then run this again",
                ) from None
            return None if model is None else _add_version(connection, model, discovery_id, self._db.now())

        return self._db.commit(work)


class Models(Repository):
    """Model books of machines."""

    def add(self, model: NewVersion, discovery_id: int | None = None) -> int:
        """Append a version to the model book of a machine; return its number, from 1. ``discovery_id`` None: a person made it.

        Raises
        ------
        ModelMovedOn
            Its base is no longer the current version.
        """
        return self._db.commit(lambda connection: _add_version(connection, model, discovery_id, self._db.now()))

    def all(self, machine: str | None = None) -> list[ModelRecord]:
        """List versions of models (of one machine), oldest first."""
        return self._all(MODEL, *if_given(machine_models.c.machine, machine))


def _add_version(connection: Connection, model: NewVersion, discovery_id: int | None, now: str) -> int:
    """Append the version only if its base is the current one (compare and swap).

    On SQLite the SELECT is enough, because only one writer works at a time. On PostgreSQL two processes may read the same current version;
    the second INSERT then waits for the first and fails, as machine and version must be unique.
    """
    table = machine_models.c
    last = connection.execute(select(func.max(table.version)).where(table.machine == model.machine)).scalar()
    if last != model.after:
        raise _moved_on(model, last)
    version = (model.after or 0) + 1
    values = {"machine": model.machine, "version": version, "discovery_id": discovery_id, "doc": model.doc, "created_utc": now}
    try:
        insert_row(connection, machine_models, **values)
    except IntegrityError:
        raise _moved_on(model, version) from None
    return version


def _moved_on(model: NewVersion, last: int | None) -> ModelMovedOn:
    made_on = "without any" if model.after is None else f"on version {model.after}"
    have = "no model" if last is None else f"model version {last}"
    return ModelMovedOn(
        f"machine {model.machine!r} has {have} now, but the new version was made {made_on}: nothing was added",
        f"look at the present model (`abbe model show --of {model.machine}`), then run this again",
    )


class Proposals(Repository):
    """Proposals, approvals, rejections."""

    def add(self, machine: str, solution_id: int, doc: Doc, digest: str) -> int:
        """Store a proposal for a machine (by name) from a solution; return its id. ``doc`` holds no NaN; ``digest``: its SHA-256."""
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
"""Keys of an entry's document that `Pushes.marks` reads: CRCs of tables, machine, control, and who vouched for a table."""
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
        """Name of a control's journal: the name of the first machine that pushed into the control.

        ``control``: identity of the control; empty: unknown, so take the journal in which this machine name was last used.
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
        """Read the entries of all journals in the order of writing, their documents reduced to `MARKS`, without images."""
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
        An empty ``control`` means unknown: then it is the journal in which this machine name was last used.
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
