"""The store: everything that is kept, behind one class."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select

from abbe.service.domain.document import Doc
from abbe.service.domain.measured import ImportedRun
from abbe.service.storage.repositories.alarms import AlarmStore
from abbe.service.storage.repositories.audit import AuditStore
from abbe.service.storage.repositories.campaigns import insert_campaign, machine_id_of
from abbe.service.storage.repositories.checkpoints import CheckpointStore
from abbe.service.storage.repositories.decisions import DecisionStore
from abbe.service.storage.repositories.discoveries import DiscoveryStore
from abbe.service.storage.repositories.health import HealthStore
from abbe.service.storage.repositories.heartbeats import HeartbeatStore
from abbe.service.storage.repositories.pages import PageStore
from abbe.service.storage.repositories.people import PeopleStore
from abbe.service.storage.repositories.proposals import ProposalStore
from abbe.service.storage.repositories.push import PushStore
from abbe.service.storage.repositories.queues import QueueStore
from abbe.service.storage.repositories.results import ResultStore
from abbe.service.storage.repositories.runs import RunStore, insert_imported
from abbe.service.storage.repositories.slots import SlotStore
from abbe.service.storage.tables import identity


class Store(
    RunStore,
    CheckpointStore,
    ResultStore,
    DiscoveryStore,
    ProposalStore,
    PushStore,
    QueueStore,
    SlotStore,
    HeartbeatStore,
    AlarmStore,
    PeopleStore,
    AuditStore,
    DecisionStore,
    PageStore,
    HealthStore,
):
    """A database of machines, campaigns, runs, results, model books and queues.

    Any thread may call; writes happen one after the other in one thread.

    Open it with ``Store.open(url)``; in coroutines use ``await store.write(store.method, ...)``.
    """

    def database_id(self) -> str:
        """What the database calls itself since its tables were made, whatever address it is reached by; 32 hex digits."""
        return str(self._read(lambda connection: connection.execute(select(identity.c.uid)).scalar_one()))

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
