"""Store methods for alarms: lines that are only ever appended, each together with the message that tells of it."""

from __future__ import annotations

import json
from collections.abc import Sequence

from sqlalchemy import Connection, func, insert, select
from sqlalchemy.exc import IntegrityError

from abbe.service.domain.document import Doc
from abbe.service.domain.service_records import AlarmEntryRecord
from abbe.service.errors import StoreError
from abbe.service.storage.base import StoreBase
from abbe.service.storage.repositories.campaigns import new_id
from abbe.service.storage.tables import alarm_entries, outbox


class AlarmStore(StoreBase):
    """Alarms of machines."""

    def add_alarm_entry(
        self, machine: str, alarm: int | None, seq: int, kind: str, doc: Doc, messages: Sequence[tuple[str, Doc]] = ()
    ) -> AlarmEntryRecord:
        """Append a line to an alarm, with the messages that the broker is to be told: both or neither survive a power cut.

        Parameters
        ----------
        machine : str
            Name of the machine.
        alarm : int or None
            Which; None: the next one of this machine. 0 gathers what belongs to none.
        seq : int
            Number of the line: one more than the last that was read, so that whoever decided on old knowledge is refused.
        kind : str
            What happened (`abbe.service.verification.alarm_states`).
        doc : dict
            What is known of it.
        messages : sequence of (topic, document)
            Each is given the number of the alarm.

        Raises
        ------
        StoreError
            Somebody else wrote this line meanwhile.
        """

        def work(connection: Connection) -> AlarmEntryRecord:
            number = alarm if alarm is not None else _last(connection, machine) + 1
            values = {"machine": machine, "alarm": number, "seq": seq, "kind": kind, "doc": doc, "utc": self._now()}
            try:
                entry_id = new_id(connection, insert(alarm_entries).values(values))
            except IntegrityError:
                raise StoreError(
                    f"alarm {number} of {machine} was changed by somebody else meanwhile", "look at it, then try again"
                ) from None
            for topic, message in messages:
                payload = json.dumps({"alarm": number, **message}, ensure_ascii=False, allow_nan=False).encode()
                connection.execute(insert(outbox).values(topic=topic, payload=payload, created_utc=self._now()))
            return AlarmEntryRecord(entry_id, machine, number, seq, kind, doc, str(values["utc"]))

        return self._write(work)

    def alarm_entries(self, machine: str) -> list[AlarmEntryRecord]:
        """Read everything about a machine's alarms, in the order in which it was written."""
        query = select(alarm_entries).where(alarm_entries.c.machine == machine).order_by(alarm_entries.c.id)
        return [AlarmEntryRecord(*row) for row in self._read(lambda connection: connection.execute(query).all())]


def _last(connection: Connection, machine: str) -> int:
    found = connection.execute(select(func.max(alarm_entries.c.alarm)).where(alarm_entries.c.machine == machine)).scalar()
    return 0 if found is None else int(found)
