"""The store: everything that is kept, behind one class."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection

from service.storage.records import Doc, ImportedRun
from service.storage.store_campaigns import insert_campaign, machine_id_of
from service.storage.store_discoveries import DiscoveryStore
from service.storage.store_queues import QueueStore
from service.storage.store_results import ResultStore
from service.storage.store_runs import RunStore, insert_imported


class Store(RunStore, ResultStore, DiscoveryStore, QueueStore):
    """A database of machines, campaigns, runs, results, model books and queues.

    Any thread may call; writes happen one after the other in one thread.

    Open it with ``Store.open(url)``; in coroutines use ``await store.write(store.method, ...)``.
    """

    def import_campaign(self, machine: tuple[str, Doc], campaign: tuple[str, Doc], imported: Sequence[ImportedRun]) -> int:
        """Store a campaign that was measured elsewhere: everything, or after an error nothing.

        Parameters
        ----------
        machine, campaign : tuple of str and dict
            Name and document.
        imported : sequence of ImportedRun
            The runs; each gets one chunk in channel ``"columns"``.

        Returns
        -------
        int
            Id of the campaign.

        Raises
        ------
        StoreError
            If a campaign of this name is there already.
        """

        def work(connection: Connection) -> int:
            now = self._now()
            campaign_id = insert_campaign(connection, machine_id_of(connection, *machine, now), *campaign, now)
            for run in imported:
                insert_imported(connection, campaign_id, run, now)
            return campaign_id

        return self._write(work)
