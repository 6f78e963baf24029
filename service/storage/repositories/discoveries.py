"""Discoveries with their append-only states, and versions of machines' models."""

from __future__ import annotations

from sqlalchemy import Connection, func, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.results import DiscoveryRecord, ModelRecord, NewVersion, StepRecord
from abbe.service.errors import ModelMovedOn, StoreError
from abbe.service.storage.mapping import DISCOVERY, MODEL, STEP
from abbe.service.storage.repository import Repository, if_given, insert_row
from abbe.service.storage.tables import discoveries, discovery_steps, machine_models


class Discoveries(Repository):
    """Searches for what a campaign's model lacks."""

    def add(self, campaign_id: int, digest: str, doc: Doc) -> int:
        """Open a discovery of a campaign. ``digest``: of readings, model and program; ``doc``: what it starts from."""
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
        """Write the next state of a discovery and, in the same transaction, the model version that it brings.

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
                    f"discovery {discovery_id} has step {seq} already: another process works on it", "wait for it, then run this again"
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
    """Compare and swap: append the version only if its base is the current one.

    SQLite has one writer at a time, so the SELECT decides. On PostgreSQL two may read at once; the second one to insert the number waits
    for the first and violates the constraint.
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
        f"machine {model.machine!r} has {have} now, and this was made {made_on}: nothing was added",
        f"look at it (`abbe model show {model.machine}`), then run this again",
    )
