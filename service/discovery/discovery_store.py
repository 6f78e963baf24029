"""Discoveries in the store: found by the digest of their input, written state by state."""

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
    """A journal that writes each state to the store before the discovery proceeds, the last one together with the new model version.

    ``base``: the model version whose effects were subtracted from the readings; None if nothing was subtracted.
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
    def version_after(self) -> int | None:
        """The current model version after this discovery: its own, or the one that it started with."""
        return self._after if self.version is None else self.version

    def _persist(self, seq: int, step: DiscoveryStep, model: ModelBook | None) -> None:
        new = None if model is None else NewVersion(self._machine, self._after, document(model))
        try:
            self.version = self._store.discoveries.add_step(self._id, seq, step.state, document(step), new)
        except ModelMovedOn as moved:
            # The search ignored the effects of the newer version: adding to them could count one twice or keep a repaired one.
            again = "run the same command again: it searches anew with the present model"
            raise ModelMovedOn(f"discovery {self._id}: {moved.detail}", f"{again}; the finding stays in discovery {self._id}") from None


def journal_of(store: Store, job: DiscoveryJob, before: StoredJournal | None = None) -> StoredJournal:
    """Return the journal of an equal search if it is still valid, else a new one; a campaign folder is imported first.

    A search is valid while the current model version is the one that it started from, or one that it or its continuation added.

    Parameters
    ----------
    before : StoredJournal, optional
        The ended discovery that this one continues after another measurement; its stored continuation is always valid.

    Raises
    ------
    CampaignRefused
        The store has a different campaign of this name.
    """
    ensure_stored(store, job.campaign)
    campaign = store.campaigns.find(job.campaign.name)
    machine, digest = job.campaign.site.name, job.digest
    for old in reversed(store.discoveries.all(campaign.id)):
        if old.digest == digest and (
            _continues(old, before) if before is not None else _is_valid(store, old, machine, job.expected_version)
        ):
            return StoredJournal(store, old.id, machine)
    base = SearchBase(
        model_version=None if job.base is None else job.base.version,
        after=job.expected_version,
        continues=None if before is None else before.id,
    )
    return StoredJournal(store, store.discoveries.add(campaign.id, digest, document(base)), machine)


def base_of(one: DiscoveryRecord) -> SearchBase:
    """Return the model versions that a stored search started from, and the discovery that it continues."""
    return record(SearchBase, one.doc, f"discovery {one.id}")


def stored_steps(store: Store, discovery_id: int) -> list[DiscoveryStep]:
    """Return the states of a stored search, first to last.

    Raises
    ------
    Unusable
        Another version of the program stored a state in another form.
    """
    return [record(DiscoveryStep, s.doc, f"state {s.state} of discovery {discovery_id}") for s in store.discoveries.steps(discovery_id)]


def _continues(old: DiscoveryRecord, before: StoredJournal) -> bool:
    return base_of(old).continues == before.id


def _is_valid(store: Store, old: DiscoveryRecord, machine: str, now: int | None) -> bool:
    """Whether a search is still valid for the current model version ``now``."""
    origin = {m.version: m.discovery_id for m in store.models.all(machine)}
    if old.id in _chain(store, None if now is None else origin.get(now)):
        return True
    return old.id not in origin.values() and base_of(old).after == now


def _chain(store: Store, discovery_id: int | None) -> list[int]:
    """Return a discovery and those that it continues, back to the first one."""
    out: list[int] = []
    while discovery_id is not None:
        out.append(discovery_id)
        discovery_id = base_of(store.discoveries.get(discovery_id)).continues
    return out
