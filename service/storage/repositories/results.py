"""What was computed from runs, and what was done with it: solutions, compensation tables, checks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, func, select

from abbe.service.domain.document import Doc
from abbe.service.domain.results import SolutionRecord, TableRecord, VerificationRecord
from abbe.service.storage.mapping import SOLUTION, TABLE, VERIFICATION
from abbe.service.storage.repositories.outbox import queue_message
from abbe.service.storage.repository import Repository, given, insert_row
from abbe.service.storage.tables import campaigns, comp_tables, machines, solutions, verifications


class Solutions(Repository):
    """Results of solvers."""

    def add(self, campaign_id: int, kind: str, run_ids: Sequence[int], doc: Doc) -> int:
        """Store what a solver (``kind``) found from some runs of a campaign."""
        return self._add(solutions, campaign_id=campaign_id, kind=kind, run_ids=list(run_ids), doc=doc, created_utc=self._db.now())

    def get(self, solution_id: int) -> SolutionRecord:
        """Read one solution. Raises NotStored."""
        return self._get(SOLUTION, solution_id, "solution")

    def all(self, campaign_id: int | None = None) -> list[SolutionRecord]:
        """List solutions (of one campaign), oldest first."""
        return self._all(SOLUTION, *given(solutions.c.campaign_id, campaign_id))

    def latest(self, kind: str, limit: int) -> list[SolutionRecord]:
        """List the newest solutions of a kind, newest first: each may be half a megabyte."""
        return self._all(SOLUTION, solutions.c.kind == kind, newest=True, limit=limit)


class Tables(Repository):
    """Compensation tables."""

    def add(self, machine_id: int, solution_id: int | None, image: bytes, crc: int, doc: Doc) -> int:
        """Store a table.

        Parameters
        ----------
        machine_id : int
            Its machine.
        solution_id : int or None
            Its solution; None for a table that was read back from the controller.
        image : bytes
            As the controller holds it.
        crc : int
            CRC-32 of the image.
        doc : dict
            Grid and prediction.
        """
        values = {"machine_id": machine_id, "solution_id": solution_id, "image": image, "crc": crc, "doc": doc}
        return self._add(comp_tables, **values, created_utc=self._db.now())

    def get(self, table_id: int) -> TableRecord:
        """Read one table. Raises NotStored."""
        return self._get(TABLE, table_id, "compensation table")

    def all(self, machine_id: int | None = None) -> list[TableRecord]:
        """List tables (of one machine), oldest first."""
        return self._all(TABLE, *given(comp_tables.c.machine_id, machine_id))


class Verifications(Repository):
    """Checks of machines."""

    def add(self, machine_id: int, campaign_id: int | None, verdict: str, doc: Doc) -> int:
        """Store the result of a check, with the campaign that was measured for it: figures, limits and verdict."""
        return self._add(verifications, machine_id=machine_id, campaign_id=campaign_id, verdict=verdict, doc=doc, utc=self._db.now())

    def add_with_messages(self, machine_id: int, doc: Doc, messages: Sequence[tuple[str, Doc]]) -> int:
        """Store the result of a check together with the messages about it: both or neither survive a power cut.

        Parameters
        ----------
        machine_id : int
            The machine, for checks that failed before they had a campaign.
        doc : dict
            As made by `abbe.service.scheduler.record`.
        messages : sequence of (topic, document)
            For the broker; each is given the number of the verification.
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
        return self._all(VERIFICATION, *given(verifications.c.machine_id, machine_id), newest=True, limit=limit)

    def of_machine(self, machine: str, limit: int = 100) -> list[VerificationRecord]:
        """List the latest checks of a machine by name, newest first, whatever descriptions it has had."""
        return self._all(VERIFICATION, verifications.c.machine_id.in_(_descriptions(machine)), newest=True, limit=limit)

    def counts(self, machine: str) -> dict[str, int]:
        """How many checks of a machine ended with each verdict, over its whole history."""
        query = select(verifications.c.verdict, func.count()).where(verifications.c.machine_id.in_(_descriptions(machine)))
        rows = self._db.read(lambda connection: connection.execute(query.group_by(verifications.c.verdict)).all())
        return {str(verdict): int(count) for verdict, count in rows}


def _descriptions(machine: str) -> Any:
    return select(machines.c.id).where(machines.c.name == machine)
