"""Store methods for discoveries, whose states are only ever appended, and for the versions of machines' models."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from sqlalchemy import Connection, func, insert, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.sql import Select

from abbe.service.domain.document import Doc
from abbe.service.domain.results import DiscoveryRecord, ModelRecord, NewVersion, StepRecord
from abbe.service.errors import ModelMovedOn, NotStored, StoreError
from abbe.service.storage.base import StoreBase
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import discoveries, discovery_steps, machine_models


class DiscoveryStore(StoreBase):
    """Discoveries and model books."""

    def add_discovery(self, campaign_id: int, digest: str, doc: Doc) -> int:
        """Open a discovery.

        Parameters
        ----------
        campaign_id : int
            Of which campaign.
        digest : str
            Of readings, model and program.
        doc : dict
            What it starts from.

        Returns
        -------
        int
            Id.
        """
        values = {"campaign_id": campaign_id, "digest": digest, "doc": doc, "created_utc": self._now()}
        return self._write(lambda connection: new_id(connection, insert(discoveries).values(values)))

    def discoveries(self, campaign_id: int | None = None) -> list[DiscoveryRecord]:
        """List discoveries (of one campaign), oldest first."""
        query = select(discoveries).order_by(discoveries.c.id)
        if campaign_id is not None:
            query = query.where(discoveries.c.campaign_id == campaign_id)
        return [DiscoveryRecord(*row) for row in self._rows(query)]

    def discovery(self, discovery_id: int) -> DiscoveryRecord:
        """Read one discovery.

        Raises
        ------
        NotStored
            If there is none.
        """
        found = self._rows(select(discoveries).where(discoveries.c.id == discovery_id))
        if not found:
            raise NotStored(f"no discovery {discovery_id} in {self.url}")
        return DiscoveryRecord(*found[0])

    def discovery_steps(self, discovery_id: int) -> list[StepRecord]:
        """List the states that a discovery has reached, first to last."""
        query = select(discovery_steps).where(discovery_steps.c.discovery_id == discovery_id).order_by(discovery_steps.c.seq)
        return [StepRecord(*row) for row in self._rows(query)]

    def add_discovery_step(self, discovery_id: int, seq: int, state: str, doc: Doc, model: NewVersion | None = None) -> int | None:
        """Write the next state of a discovery and, together with it or not at all, the version of a model that it brings.

        Parameters
        ----------
        discovery_id : int
            Which.
        seq : int
            Number of the state, from 0.
        state : str
            The state.
        doc : dict
            Evidence, numbers, who decided.
        model : NewVersion, optional
            New version of a machine's model.

        Returns
        -------
        int or None
            Number of the new version.

        Raises
        ------
        StoreError
            If this state was written already: another process works on the same discovery.
        ModelMovedOn
            If the version that the new one was made on is not the current one any more. The state is not written either.
        """

        def work(connection: Connection) -> int | None:
            values = {"discovery_id": discovery_id, "seq": seq, "state": state, "doc": doc, "utc": self._now()}
            try:
                connection.execute(insert(discovery_steps).values(values))
            except IntegrityError:
                raise StoreError(
                    f"discovery {discovery_id} has step {seq} already: another process works on it", "wait for it, then run this again"
                ) from None
            return None if model is None else _add_version(connection, model, discovery_id, self._now())

        return self._write(work)

    def add_model(self, model: NewVersion, discovery_id: int | None = None) -> int:
        """Append a version to the model book of a machine.

        Parameters
        ----------
        model : NewVersion
            Machine, document, and the version that it was made on.
        discovery_id : int, optional
            Which discovery brought it; None for a person's doing.

        Returns
        -------
        int
            Number of the version, from 1.

        Raises
        ------
        ModelMovedOn
            If the version that it was made on is not the current one any more.
        """
        return self._write(lambda connection: _add_version(connection, model, discovery_id, self._now()))

    def models(self, machine: str | None = None) -> list[ModelRecord]:
        """List versions of models (of one machine), oldest first."""
        query = select(machine_models).order_by(machine_models.c.id)
        if machine is not None:
            query = query.where(machine_models.c.machine == machine)
        return [ModelRecord(*row) for row in self._rows(query)]

    def _rows(self, query: Select[Any]) -> Sequence[Any]:
        return self._read(lambda connection: connection.execute(query).all())


def _add_version(connection: Connection, model: NewVersion, discovery_id: int | None, now: str) -> int:
    """Compare and swap: the version is appended only to the one that it was made on.

    SQLite lets one writer in at a time, so the look decides. On PostgreSQL two may look at once; there the second one to insert
    the number waits for the first and meets the constraint.
    """
    table = machine_models.c
    last = connection.execute(select(func.max(table.version)).where(table.machine == model.machine)).scalar()
    if last != model.after:
        raise _moved_on(model, last)
    version = (model.after or 0) + 1
    values = {"machine": model.machine, "version": version, "discovery_id": discovery_id, "doc": model.doc, "created_utc": now}
    try:
        connection.execute(insert(machine_models).values(values))
    except IntegrityError:
        raise _moved_on(model, version) from None
    return version


def _moved_on(model: NewVersion, last: int | None) -> ModelMovedOn:
    made_on = "without any" if model.after is None else f"on version {model.after}"
    have = "no model" if last is None else f"model version {last}"
    return ModelMovedOn(
        f"machine {model.machine!r} has {have} now, and this was made {made_on}: nothing was added",
        f"look at it (`abbe model show {model.machine}`), then run this again",
    )
