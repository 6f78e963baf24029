"""Discoveries in the store: found again by what they were made of, written state by state."""

from __future__ import annotations

from typing import Any

from service.storage.records import DiscoveryRecord
from service.storage.store import Store
from service.workflows.campaign_folder import ensure_stored
from service.workflows.discover import Job, Journal
from service.workflows.model_book import current


class StoredJournal(Journal):
    """A journal whose every state is on the disk before the next thing happens; the last one together with the model's new version."""

    def __init__(self, store: Store, discovery_id: int, machine: str) -> None:
        super().__init__()
        self._store, self._id, self._machine = store, discovery_id, machine
        self.states = [(s.state, s.doc) for s in store.discovery_steps(discovery_id)]
        self.version = next((m.version for m in store.models(machine) if m.discovery_id == discovery_id), None)

    @property
    def id(self) -> int | None:
        """Number of the discovery in the store."""
        return self._id

    def _keep(self, seq: int, state: str, doc: dict[str, Any], model: dict[str, Any] | None) -> None:
        self.version = self._store.add_discovery_step(self._id, seq, state, doc, None if model is None else (self._machine, model))


def journal_of(store: Store, job: Job) -> StoredJournal:
    """The journal of a job: that of the same search where there is one that still holds, else a new one. A folder is imported first.

    A finished search holds as long as the model's current version is the one it started from or brought.

    Raises
    ------
    CampaignRefused
        Another campaign of this name is in the store.
    """
    ensure_stored(store, job.campaign)
    record = store.campaign(job.campaign.name)
    machine, digest = job.campaign.site.name, job.digest
    newest = current(store, machine)
    now = None if newest is None else newest.version
    for old in reversed(store.discoveries(record.id)):
        if old.digest == digest and _holds(StoredJournal(store, old.id, machine), old, now):
            return StoredJournal(store, old.id, machine)
    doc = {"model_version": None if job.base is None else job.base.version}
    return StoredJournal(store, store.add_discovery(record.id, digest, doc), machine)


def _holds(journal: StoredJournal, record: DiscoveryRecord, now: int | None) -> bool:
    start = record.doc["model_version"]
    return (journal.version if journal.version is not None else start) == now
