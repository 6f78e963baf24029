"""Store methods for what was computed and done: solutions, compensation tables, verifications."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import insert, select
from sqlalchemy.sql import Select

from abbe.service.domain.document import Doc
from abbe.service.domain.results import SolutionRecord, TableRecord, VerificationRecord
from abbe.service.errors import NotStored
from abbe.service.storage.base import StoreBase
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import comp_tables, machines, solutions, verifications


class ResultStore(StoreBase):
    """What was computed from runs, and what was done with it."""

    def add_solution(self, campaign_id: int, kind: str, run_ids: Sequence[int], doc: Doc) -> int:
        """Store a solver's result.

        Parameters
        ----------
        campaign_id : int
            Campaign.
        kind : str
            Which solver.
        run_ids : sequence of int
            Runs that went in.
        doc : dict
            The result.

        Returns
        -------
        int
            Id.
        """
        values = {"campaign_id": campaign_id, "kind": kind, "run_ids": list(run_ids), "doc": doc, "created_utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(solutions).values(values)))

    def solution(self, solution_id: int) -> SolutionRecord:
        """Read one solution; StoreError if there is none."""
        return SolutionRecord(*self._one(select(solutions).where(solutions.c.id == solution_id), f"solution {solution_id}"))

    def solutions(self, campaign_id: int | None = None) -> list[SolutionRecord]:
        """List solutions (of one campaign), oldest first."""
        query = select(solutions).order_by(solutions.c.id)
        if campaign_id is not None:
            query = query.where(solutions.c.campaign_id == campaign_id)
        return [SolutionRecord(*row) for row in self._all(query)]

    def latest_solutions(self, kind: str, limit: int) -> list[SolutionRecord]:
        """List the newest solutions of a kind, newest first: each may be half a megabyte."""
        query = select(solutions).where(solutions.c.kind == kind).order_by(solutions.c.id.desc()).limit(limit)
        return [SolutionRecord(*row) for row in self._all(query)]

    def add_table(self, machine_id: int, solution_id: int | None, image: bytes, crc: int, doc: Doc) -> int:
        """Store a compensation table.

        Parameters
        ----------
        machine_id : int
            For which machine.
        solution_id : int or None
            From which solution; None for a table read back from the controller.
        image : bytes
            As the controller holds it.
        crc : int
            Its CRC-32.
        doc : dict
            Grid and prediction.

        Returns
        -------
        int
            Id.
        """
        values = {"machine_id": machine_id, "solution_id": solution_id, "image": image, "crc": crc, "doc": doc, "created_utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(comp_tables).values(values)))

    def table(self, table_id: int) -> TableRecord:
        """Read one compensation table; StoreError if there is none."""
        return TableRecord(*self._one(select(comp_tables).where(comp_tables.c.id == table_id), f"compensation table {table_id}"))

    def tables(self, machine_id: int | None = None) -> list[TableRecord]:
        """List compensation tables (of one machine), oldest first."""
        query = select(comp_tables).order_by(comp_tables.c.id)
        if machine_id is not None:
            query = query.where(comp_tables.c.machine_id == machine_id)
        return [TableRecord(*row) for row in self._all(query)]

    def add_verification(self, machine_id: int, campaign_id: int | None, verdict: str, doc: Doc) -> int:
        """Store the result of a check.

        Parameters
        ----------
        machine_id : int
            Which machine.
        campaign_id : int or None
            The campaign measured for it.
        verdict : str
            E.g. ``"pass"``.
        doc : dict
            Figures and limits.

        Returns
        -------
        int
            Id.
        """
        values = {"machine_id": machine_id, "campaign_id": campaign_id, "verdict": verdict, "doc": doc, "utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(verifications).values(values)))

    def verifications(self, machine_id: int | None = None, limit: int = 100) -> list[VerificationRecord]:
        """List checks, newest first.

        Parameters
        ----------
        machine_id : int, optional
            Only this machine's.
        limit : int
            At most so many.

        Returns
        -------
        list of VerificationRecord
            The records.
        """
        query = select(verifications).order_by(verifications.c.id.desc()).limit(limit)
        if machine_id is not None:
            query = query.where(verifications.c.machine_id == machine_id)
        return [VerificationRecord(*row) for row in self._all(query)]

    def verifications_of(self, machine: str, limit: int = 100) -> list[VerificationRecord]:
        """Return the latest checks of a machine, newest first, whatever descriptions it has had.

        Parameters
        ----------
        machine : str
            Name of the machine.
        limit : int
            At most so many.
        """
        query = select(verifications).join(machines, machines.c.id == verifications.c.machine_id).where(machines.c.name == machine)
        query = query.order_by(verifications.c.id.desc()).limit(limit)
        return [VerificationRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]

    def _all(self, query: Select[Any]) -> Sequence[Any]:
        return self._read(lambda connection: connection.execute(query).all())

    def _one(self, query: Select[Any], what: str) -> Any:
        found = self._read(lambda connection: connection.execute(query).first())
        if found is None:
            raise NotStored(f"no {what} in {self.url}")
        return found
