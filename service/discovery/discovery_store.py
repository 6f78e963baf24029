"""Discoveries in the store: found again by what they were made of, written state by state."""

from __future__ import annotations

from abbe.service.campaign_data.campaign_folder import ensure_stored
from abbe.service.discovery.discover import DiscoveryJob, DiscoveryJournal
from abbe.service.domain.discovery import DiscoveryStep, SearchBase
from abbe.service.domain.document import document, record
from abbe.service.domain.model_book import ModelBook
from abbe.service.domain.results import DiscoveryRecord, NewVersion
from abbe.service.errors import ModelMovedOn
from abbe.service.storage.store import Store


class StoredJournal(DiscoveryJournal):
    """A journal whose every state is on the disk before the next thing happens; the last one together with the model's new version.

    ``base``: the version of the model whose effects were taken out of the readings; None where nothing was.
    """

    def __init__(self, store: Store, discovery_id: int, machine: str) -> None:
        super().__init__()
        self._store, self._id, self._machine = store, discovery_id, machine
        base = base_of(store.discoveries.get(discovery_id))
        self.base = base.model_version
        self._after = base.after
        self.steps = stored_steps(store, discovery_id)
        self.version = next((m.version for m in store.models.all(machine) if m.discovery_id == discovery_id), None)

    @property
    def id(self) -> int | None:
        """Number of the discovery in the store."""
        return self._id

    @property
    def leaves(self) -> int | None:
        """Version of the model that is the current one after this discovery, if no other is added: its own, or the one it saw."""
        return self._after if self.version is None else self.version

    def _keep(self, seq: int, step: DiscoveryStep, model: ModelBook | None) -> None:
        new = None if model is None else NewVersion(self._machine, self._after, document(model))
        try:
            self.version = self._store.discoveries.add_step(self._id, seq, step.state, document(step), new)
        except ModelMovedOn as moved:
            # Adding it to effects that its search has not seen could count one thing twice, or keep what was mended.
            again = "run the same command again: it searches anew with what the model knows now"
            raise ModelMovedOn(f"discovery {self._id}: {moved.detail}", f"{again}; what was found stays in discovery {self._id}") from None


def journal_of(store: Store, job: DiscoveryJob, before: StoredJournal | None = None) -> StoredJournal:
    """The journal of a job: that of the same search where there is one that still holds, else a new one. A folder is imported first.

    A search holds as long as the model's current version is the one it started from, or one that it or what went on with it brought.

    Parameters
    ----------
    before : StoredJournal, optional
        The ended discovery that this one goes on with, after more was measured. Its search holds as long as that one is gone on with.

    Raises
    ------
    CampaignRefused
        Another campaign of this name is in the store.
    """
    ensure_stored(store, job.campaign)
    campaign = store.campaigns.find(job.campaign.name)
    machine, digest = job.campaign.site.name, job.digest
    for old in reversed(store.discoveries.all(campaign.id)):
        if old.digest == digest and (_goes_on(old, before) if before is not None else _holds(store, old, machine, job.seen)):
            return StoredJournal(store, old.id, machine)
    base = SearchBase(
        model_version=None if job.base is None else job.base.version, after=job.seen, continues=None if before is None else before.id
    )
    return StoredJournal(store, store.discoveries.add(campaign.id, digest, document(base)), machine)


def base_of(one: DiscoveryRecord) -> SearchBase:
    """What a stored search goes out from."""
    return record(SearchBase, one.doc, f"discovery {one.id}")


def stored_steps(store: Store, discovery_id: int) -> list[DiscoveryStep]:
    """The states that a stored search has reached, first to last.

    Raises
    ------
    Unusable
        One of them was stored by a version that kept another form.
    """
    return [record(DiscoveryStep, s.doc, f"state {s.state} of discovery {discovery_id}") for s in store.discoveries.steps(discovery_id)]


def _goes_on(old: DiscoveryRecord, before: StoredJournal) -> bool:
    return base_of(old).continues == before.id


def _holds(store: Store, old: DiscoveryRecord, machine: str, now: int | None) -> bool:
    """Whether a search has nothing to learn from the model's current version."""
    brought = {m.version: m.discovery_id for m in store.models.all(machine)}
    if old.id in _line(store, None if now is None else brought.get(now)):
        return True
    return old.id not in brought.values() and base_of(old).after == now


def _line(store: Store, discovery_id: int | None) -> list[int]:
    """A discovery and those that it goes on with, back to the first one."""
    out: list[int] = []
    while discovery_id is not None:
        out.append(discovery_id)
        discovery_id = base_of(store.discoveries.get(discovery_id)).continues
    return out
