"""Make a database with the store of a checkout, whatever its age: ``PYTHONPATH=CHECKOUT python tests/migration/keep_database.py URL``.

Uses only what that version's own store has, so that what lies in ``stored/`` was written by the code of its time and not by today's.
How to keep a new one: ``stored/README.md``.
"""

from __future__ import annotations

import json
import struct
import sys
from datetime import UTC, datetime
from typing import Any

from abbe.service.storage import records
from abbe.service.storage.store import Store

NOW = datetime(2026, 11, 21, 3, 34, 5, 123456, tzinfo=UTC)
DOC: dict[str, Any] = {"µm": 0.1, "list": [None, 1e-7, -0.0], "text": "ü'\"\n\\ 工", "large": 2**53 + 1}
BYTES = bytes(range(256))
MACHINE = "VMC-1 ü'"


def fill(store: Any) -> None:
    """Write through every method for writing that the store of this version has."""
    first_tables(store)
    for method, write in (
        ("add_discovery", discoveries),
        ("add_checkpoint", lambda one: [one.add_checkpoint(1, "begun", DOC) for _ in range(2)]),
        ("add_push_entry", push_entries),
        ("add_proposal", proposals),
        ("add_user", people),
        ("append_audit", audit),
        ("add_rejection", decisions),
        ("put_station", lambda one: one.put_station(MACHINE, DOC)),
        ("add_alarm_entry", lambda one: [one.add_alarm_entry(MACHINE, 1, seq, "raised", DOC) for seq in range(2)]),
    ):
        if hasattr(store, method):
            write(store)


def first_tables(store: Any) -> None:
    """What there was from the beginning."""
    machine = store.add_machine(MACHINE, DOC)
    campaign = store.add_campaign(machine, "june", DOC)
    done = store.start_run(campaign, "r1", "helix", "fit", DOC)
    for seq in range(2):
        store.append_chunk(done, "bar", seq, 32, "raw", BYTES * (seq + 1), 0.1, 0.2 + seq, 2**40 + seq, 2**40 + 9)
    store.finish_run(done, "complete", "", DOC)
    store.start_run(campaign, "r2", "helix", "verify", DOC)
    solution = store.add_solution(campaign, "joint", [done], DOC)
    table = store.add_table(machine, solution, BYTES, 2**32 - 1, DOC)
    store.update_push(store.add_push(machine, table, "STAGED", DOC), "KEEP", DOC)
    store.add_verification(machine, campaign, "cannot tell", DOC)
    store.claim_slot("weekly", "2026-11-20T05:00:00Z")
    store.finish_slot("weekly", "2026-11-20T05:00:00Z", "done")
    store.claim_slot("weekly", "2026-11-27T05:00:00Z")
    store.outbox_done(store.outbox_add("plant/abbe/state", json.dumps(DOC)))
    store.outbox_add("plant/abbe/alarm", struct.pack(">d", 0.1))


def discoveries(store: Any) -> None:
    """A discovery, its steps, and two versions of a model."""
    new = getattr(records, "NewVersion", None)
    discovery = store.add_discovery(1, "ab" * 32, DOC)
    store.add_discovery_step(discovery, 0, "BEGUN", DOC)
    store.add_discovery_step(discovery, 1, "NAMED", DOC, new(MACHINE, None, DOC) if new else (MACHINE, DOC))
    if new:
        store.add_model(new(MACHINE, 1, DOC), discovery)
    else:
        store.add_model(MACHINE, DOC, discovery)


def push_entries(store: Any) -> None:
    """Two states of a push."""
    for seq, (prev, digest) in enumerate((("", "1" * 64), ("1" * 64, "2" * 64))):
        store.add_push_entry(records.PushEntryRecord(0, MACHINE, 1, seq, "SNAPSHOT", DOC, NOW.isoformat(), prev, digest))


def proposals(store: Any) -> None:
    """A proposal, and a yes to it."""
    number = store.add_proposal(MACHINE, 1, DOC, "d" * 64)
    store.add_approval(records.ApprovalRecord(0, number, "Anna ü", "anna", "d" * 64, "2099-01-01T00:00:00Z", ""))


def people(store: Any) -> None:
    """A user with a session and a token."""
    from abbe.service.storage.store_people import TokenRecord

    user = store.add_user("anna", "admin", "$argon2id$v=19$m=8,t=1,p=1$c2FsdA$aGFzaA")
    store.add_session(user, "5" * 64)
    store.add_token(TokenRecord(0, user, "scada", "abbe_1", "6" * 64, ["read"], "", "2099-01-01T00:00:00Z", None))


def audit(store: Any) -> None:
    """Two records of the audit, chained."""
    from abbe.service.storage.store_audit import AuditRecord

    for number, prev in ((1, ""), (2, "1" * 64)):
        record = AuditRecord(
            number, NOW.isoformat(), "anna", "table.push", MACHINE, "done", DOC, prev, str(number) * 64, "k" * 16, "m" * 64
        )
        store.append_audit(lambda _last, _utc, made=record: made)


def decisions(store: Any) -> None:
    """A no to a proposal, and the answer of a request with a key."""
    from abbe.service.storage.store_decisions import RejectionRecord

    store.add_rejection(RejectionRecord(0, 1, "Bert", "bert", "too large ü", ""))
    store.claim_reply("anna", "order-4711", "7" * 64)
    store.keep_reply("anna", "order-4711", 202, json.dumps(DOC))


def main(url: str) -> None:
    """Make the database; it must be empty."""
    with Store.open(url, utcnow=lambda: NOW) as store:
        fill(store)


if __name__ == "__main__":
    main(sys.argv[1])
