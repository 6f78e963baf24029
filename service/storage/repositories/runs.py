"""Runs: what was measured, from their start to their end."""

from __future__ import annotations

import zlib
from collections.abc import Sequence

from sqlalchemy import Connection, select, update

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import FINISHED, RUNNING, ChunkRecord, ImportedRun, RunRecord
from abbe.service.domain.owner import this_process
from abbe.service.errors import NotStored, StoreError
from abbe.service.storage.mapping import RUN, owner_of
from abbe.service.storage.repositories.chunks import insert_chunk, require_running
from abbe.service.storage.repositories.machines import Campaigns, insert_campaign, machine_id_of
from abbe.service.storage.repository import Repository, if_given, insert_row
from abbe.service.storage.tables import campaigns, runs


class Runs(Repository):
    """Runs of campaigns."""

    def start(self, campaign_id: int, label: str, test: str, role: str, doc: Doc) -> int:
        """Begin a run, owned by this process until it is finished; return its id.

        Parameters
        ----------
        label : str
            ``run_id`` of the exchange format, unique in the campaign, e.g. ``"r01"``.
        test, role : str
            As in the exchange format.
        doc : dict
            Start document (`abbe.service.runs.columns`).

        Raises
        ------
        StoreError
            The label is taken.
        """
        values = {"campaign_id": campaign_id, "label": label, "test": test, "role": role, "status": RUNNING, "reason": "", "start_doc": doc}
        return self._db.commit(lambda connection: _insert_run(connection, values | {"started_utc": self._db.now()}))

    def finish(self, run_id: int, status: str, reason: str, doc: Doc | None) -> None:
        """Close a run for good.

        Parameters
        ----------
        status : str
            One of `abbe.service.domain.measured.FINISHED`.
        reason : str
            A sentence; empty for a complete run.
        doc : dict or None
            End document; None if the end was not reached.

        Raises
        ------
        StoreError
            There is no such run, or it is already closed.
        """
        if status not in FINISHED:
            raise StoreError(f"run status {status!r} is not one of {', '.join(FINISHED)}")
        values = {"status": status, "reason": reason, "end_doc": doc, "ended_utc": self._db.now()}

        def work(connection: Connection) -> None:
            done = connection.execute(update(runs).where(runs.c.id == run_id, runs.c.status == RUNNING).values(values))
            if done.rowcount != 1:
                require_running(connection, run_id)

        self._db.commit(work)

    def import_campaign(self, machine: tuple[str, Doc], campaign: tuple[str, Doc], imported: Sequence[ImportedRun]) -> int:
        """Store a campaign that was measured elsewhere, entirely or after an error not at all; return its id.

        Parameters
        ----------
        machine, campaign : tuple of str and dict
            Name and document.
        imported : sequence of ImportedRun
            The runs; each gets one chunk in channel ``"columns"``.

        Raises
        ------
        StoreError
            There is a campaign of this name.
        """

        def work(connection: Connection) -> int:
            now = self._db.now()
            campaign_id = insert_campaign(connection, machine_id_of(connection, *machine, now), *campaign, now)
            for run in imported:
                _insert_imported(connection, campaign_id, run, now)
            return campaign_id

        return self._db.commit(work)

    def all(self, campaign: str | int | None = None) -> list[RunRecord]:
        """List runs (of one campaign, by name or id) in order of their start. Raises NotStored."""
        campaign_id = None if campaign is None else Campaigns(self._db).find(campaign).id
        return self._all(RUN, *if_given(runs.c.campaign_id, campaign_id))

    def latest(self, limit: int, *, campaign: str = "", test: str = "", status: str = "") -> list[RunRecord]:
        """List the newest runs, newest first, of a campaign, test and stored status; empty: any."""
        where = (
            *if_given(campaigns.c.name, campaign or None),
            *if_given(runs.c.test, test or None),
            *if_given(runs.c.status, status or None),
        )
        return self._all(RUN, *where, newest=True, limit=limit)

    def find(self, id_or_label: int | str) -> RunRecord:
        """Find a run by its label (``"r01"``, or ``"campaign/r01"`` where several campaigns use it), or by its id (also as text).

        Raises
        ------
        NotStored
            There is none.
        StoreError
            There is more than one.
        """
        text = str(id_or_label)
        named = (runs.c.label == text) | (campaigns.c.name + "/" + runs.c.label == text)
        found = self._all(RUN, named) if isinstance(id_or_label, str) else []
        if not found and text.isdecimal():
            found = self._all(RUN, runs.c.id == int(text))
        if not found:
            raise NotStored(f"no run {text!r} in {self._db.url}", "`abbe runs` lists what there is")
        if len(found) > 1:
            names = ", ".join(f"{one.campaign}/{one.label}" for one in found)
            raise StoreError(f"run {text!r} exists more than once", f"write one of {names}")
        return found[0]

    def numbered(self, run_id: int) -> RunRecord | None:
        """The run of an id, None if there is none."""
        return self._first(RUN, runs.c.id == run_id)


def _insert_run(connection: Connection, values: Doc) -> int:
    taken = select(runs.c.id).where(runs.c.campaign_id == values["campaign_id"], runs.c.label == values["label"])
    if connection.execute(taken).first() is not None:
        raise StoreError(f"run {values['label']!r} exists already in this campaign", "give it another label")
    return insert_row(connection, runs, **values, **owner_of(runs).values(this_process()))


def _insert_imported(connection: Connection, campaign_id: int, run: ImportedRun, now: str) -> None:
    """Store a run that was measured elsewhere; it is closed from the start."""
    values = {"campaign_id": campaign_id, "label": run.label, "test": run.test, "role": run.role, "start_doc": run.start_doc}
    run_id = _insert_run(connection, values | {"status": "complete", "reason": "imported", "started_utc": now, "ended_utc": now})
    insert_chunk(connection, ChunkRecord(run_id, "columns", 0, run.n, run.codec, zlib.crc32(run.payload), run.payload, 0.0, 0.0, 0, 0))
