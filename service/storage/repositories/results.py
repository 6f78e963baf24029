"""Results computed from runs: solutions, compensation tables, verifications."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, func, select

from abbe.service.domain.document import Doc
from abbe.service.domain.results import SolutionRecord, TableRecord, VerificationRecord
from abbe.service.storage.mapping import SOLUTION, TABLE, VERIFICATION
from abbe.service.storage.repositories.outbox import queue_message
from abbe.service.storage.repository import Repository, if_given, insert_row
from abbe.service.storage.tables import campaigns, comp_tables, machines, solutions, verifications


class Solutions(Repository):
    """Results of solvers."""

    def add(self, campaign_id: int, kind: str, run_ids: Sequence[int], doc: Doc) -> int:
        """Store a solver's result (``kind``) from some runs of a campaign; return its id."""
        return self._add(solutions, campaign_id=campaign_id, kind=kind, run_ids=list(run_ids), doc=doc, created_utc=self._db.now())

    def get(self, solution_id: int) -> SolutionRecord:
        """Read one solution. Raises NotStored."""
        return self._get(SOLUTION, solution_id, "solution")

    def all(self, campaign_id: int | None = None) -> list[SolutionRecord]:
        """List solutions (of one campaign), oldest first."""
        return self._all(SOLUTION, *if_given(solutions.c.campaign_id, campaign_id))

    def latest(self, kind: str, limit: int) -> list[SolutionRecord]:
        """List the newest solutions of a kind, newest first. Each may be half a megabyte."""
        return self._all(SOLUTION, solutions.c.kind == kind, newest=True, limit=limit)


class Tables(Repository):
    """Compensation tables."""

    def add(self, machine_id: int, solution_id: int | None, image: bytes, crc: int, doc: Doc) -> int:
        """Store a table; return its id.

        ``solution_id`` None: the table was read back from the controller. ``crc``: CRC-32 of ``image``; ``doc``: grid and prediction.
        """
        values = {"machine_id": machine_id, "solution_id": solution_id, "image": image, "crc": crc, "doc": doc}
        return self._add(comp_tables, **values, created_utc=self._db.now())

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
        """Store the result of a check together with its messages: both or neither survive a power cut.

        Parameters
        ----------
        machine_id : int
            Used for checks that failed before they had a campaign.
        doc : dict
            As made by `abbe.service.scheduler.record`.
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
        """List the latest checks of a machine by name, newest first, over all its descriptions."""
        return self._all(VERIFICATION, verifications.c.machine_id.in_(_descriptions(machine)), newest=True, limit=limit)

    def counts(self, machine: str) -> dict[str, int]:
        """How many checks of a machine ended with each verdict, over its whole history."""
        query = select(verifications.c.verdict, func.count()).where(verifications.c.machine_id.in_(_descriptions(machine)))
        rows = self._db.read(lambda connection: connection.execute(query.group_by(verifications.c.verdict)).all())
        return {str(verdict): int(count) for verdict, count in rows}


def _descriptions(machine: str) -> Any:
    return select(machines.c.id).where(machines.c.name == machine)
