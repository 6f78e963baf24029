"""Alarms: append-only entries, each stored together with its messages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from sqlalchemy import Connection, func, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.service_records import AlarmEntryRecord
from abbe.service.errors import StoreError
from abbe.service.storage.mapping import ALARM_ENTRY
from abbe.service.storage.repositories.outbox import queue_message
from abbe.service.storage.repository import Repository, insert_row
from abbe.service.storage.tables import alarm_entries


class Alarms(Repository):
    """Alarms of machines."""

    def append(
        self, machine: str, alarm: int | None, seq: int, kind: str, doc: Doc, messages: Sequence[tuple[str, Doc]] = ()
    ) -> AlarmEntryRecord:
        """Append an entry to an alarm, with the messages for the broker: both or neither survive a power cut.

        Parameters
        ----------
        alarm : int or None
            None: the next alarm of this machine. 0 collects entries that belong to no alarm.
        seq : int
            One more than the last entry that the caller has read, so that a decision on stale data is refused.
        kind : str
            One of `abbe.service.verification.alarm_states`.
        messages : sequence of (topic, document)
            Each document gets the number of the alarm.

        Raises
        ------
        StoreError
            Somebody else wrote this entry meanwhile.
        """

        def work(connection: Connection) -> AlarmEntryRecord:
            last = select(func.coalesce(func.max(alarm_entries.c.alarm), 0)).where(alarm_entries.c.machine == machine)
            number = alarm if alarm is not None else int(connection.execute(last).scalar_one()) + 1
            entry = AlarmEntryRecord(0, machine, number, seq, kind, doc, self._db.now())
            try:
                entry_id = insert_row(connection, alarm_entries, **ALARM_ENTRY.values(entry, "id"))
            except IntegrityError:
                raise StoreError(
                    f"alarm {number} of {machine} was changed by somebody else meanwhile", "look at it, then try again"
                ) from None
            for topic, message in messages:
                queue_message(connection, topic, {"alarm": number, **message}, self._db.now())
            return replace(entry, id=entry_id)

        return self._db.commit(work)

    def entries(self, machine: str) -> list[AlarmEntryRecord]:
        """Read all entries of a machine's alarms in the order of writing."""
        return self._all(ALARM_ENTRY, alarm_entries.c.machine == machine)
