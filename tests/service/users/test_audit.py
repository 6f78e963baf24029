"""The audit: it grows, it is proved, and whatever is done to it is found."""

from __future__ import annotations

import os
import random
import sqlite3
import stat
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.service.audit.book import AuditBook, anchor_of, digest_of, faults, follow, mac_of
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AuditBroken, StoreError
from abbe.service.push.journal import GENESIS
from abbe.service.storage.store import Store
from tests.service.users.conftest import World

KEY = bytes(range(32))
TAMPERINGS = 10_000 if os.environ.get("ABBE_TEST_LONG") else 1000


def event(n: int) -> AuditEvent:
    return AuditEvent(
        who=f"user:u{n % 3}", action=f"POST /thing/{n % 5}", target=f"run {n}", outcome="done 200", doc={"n": n, "why": "µm & ü"}
    )


def chain(count: int) -> list[AuditEvent]:
    records: list[AuditEvent] = []
    for n in range(count):
        records.append(follow(records[-1] if records else None, f"2026-11-22T09:00:{n:02d}.000000Z", event(n), KEY))
    return records


def tampered(records: list[AuditEvent], rng: random.Random) -> tuple[str, list[AuditEvent]]:
    """One change by somebody who can write the database, and who knows how digests are made, but has not the key."""
    out, i = list(records), rng.randrange(len(records))
    kind = rng.choice(["edit", "edit and digest", "rechain", "delete", "swap", "truncate", "insert", "renumber"])
    if kind.startswith("edit") or kind == "rechain":
        key = rng.choice(
            ["utc", "who", "action", "target", "outcome", "doc", "prev", "digest", "key", "mac"][: 6 if kind != "edit" else 10]
        )
        old = getattr(out[i], key)
        out[i] = replace(out[i], **{key: {**old, "n": -1} if key == "doc" else _other(old, rng)})
    if kind in {"edit and digest", "rechain"}:
        head = out[i].prev
        for k in range(i, len(out) if kind == "rechain" else i + 1):
            r = out[k]
            digest = digest_of(replace(r, prev=head))
            out[k] = replace(r, prev=head, digest=digest, mac=mac_of(b"\0" * 32, digest))
            head = digest
    elif kind == "delete":
        del out[i]
    elif kind == "swap":
        j = rng.choice([k for k in range(len(out)) if k != i])
        out[i], out[j] = replace(out[j], id=out[i].id), replace(out[i], id=out[j].id)
    elif kind == "truncate":
        out = out[:i]
    elif kind == "insert":
        out.insert(i, replace(out[i], id=out[i].id))
    elif kind == "renumber":
        out = [r if k < i else replace(r, id=r.id - 1) for k, r in enumerate(out) if k != i]
    return kind, out


def _other(old: str, rng: random.Random) -> str:
    k = rng.randrange(len(old))
    return old[:k] + chr((ord(old[k]) + rng.randrange(1, 20)) % 120 + 1) + old[k + 1 :]


def test_every_one_of_a_thousand_tamperings_is_found() -> None:
    rng, records = random.Random(20261122), chain(40)
    heads = [anchor_of(r, KEY) for r in records]
    assert faults(records, heads, KEY) == []
    made: Counter[str] = Counter()
    found = 0
    while sum(made.values()) < TAMPERINGS:
        kind, changed = tampered(records, rng)
        if changed == records:
            continue
        made[kind] += 1
        found += bool(faults(changed, heads, KEY))
    assert found == TAMPERINGS
    assert min(made.values()) > 50
    assert len(made) == 8


def test_kept_heads_that_were_forged_or_removed_are_found() -> None:
    records = chain(5)
    heads = [anchor_of(r, KEY) for r in records]
    assert faults(records, [], KEY) == ["no checksums are kept outside the database: nobody would notice removed records"]
    assert any("not sealed" in text for text in faults(records, [*heads, replace(heads[-1], id=4)], KEY))
    assert faults([], heads, KEY)


def test_changes_in_the_database_itself_are_found(world: World, tmp_path: Path) -> None:
    """Past the triggers, as somebody would who has the file: real SQLite, one copy for each change."""
    for n in range(12):
        world.book.write(event(n))
    assert world.book.verify() == []
    world.store.close()
    source = tmp_path / "abbe.sqlite3"
    original = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    changes = (
        "UPDATE audit SET who = 'user:other' WHERE id = 5",
        "UPDATE audit SET doc = '{\"n\":99}' WHERE id = 5",
        "UPDATE audit SET mac = digest WHERE id = 12",
        "DELETE FROM audit WHERE id = 6",
        "DELETE FROM audit WHERE id > 9",
        "DELETE FROM audit",
        "UPDATE audit SET id = id + 100 WHERE id = 12",
    )
    for change in changes:
        for name, content in original.items():
            (tmp_path / name).write_bytes(content)
        with closing(sqlite3.connect(source)) as file:
            with pytest.raises(sqlite3.IntegrityError, match="the audit only grows"):
                file.execute(change)
            file.execute("DROP TRIGGER audit_no_update")
            file.execute("DROP TRIGGER audit_no_delete")
            file.execute(change)
            file.commit()
        with Store.open(world.url) as store:
            assert AuditBook(store, world.url).verify(), change


def test_the_key_is_the_owners_only_and_its_loss_is_seen(world: World) -> None:
    world.book.write(event(1))
    assert stat.S_IMODE(world.book.key_file.stat().st_mode) == 0o600
    world.book.key_file.unlink()
    fresh = AuditBook(world.store, world.url)
    assert "is missing" in fresh.verify()[0]
    fresh.write(event(2))  # the machine goes on being measured, and the audit says that it cannot be proved any more
    assert any("sealed with another key" in text for text in fresh.verify())


def test_writers_do_not_fork_the_chain(world: World) -> None:
    books = [AuditBook(world.store, world.url) for _ in range(4)]
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda n: books[n % 4].write(event(n)), range(40)))
    assert world.book.verify() == []
    assert [r.id for r in world.store.audit.events()] == list(range(1, 41))


def test_two_processes_do_not_fork_the_chain(world: World) -> None:
    program = (
        "import sys\nfrom abbe.service.audit.book import AuditBook\nfrom abbe.service.domain.service_records import AuditEvent\n"
        "from abbe.service.storage.store import Store\n"
        "with Store.open(sys.argv[1]) as store:\n    book = AuditBook(store, sys.argv[1])\n"
        "    for n in range(15): book.write(AuditEvent(who='w', action='a', target=str(n), outcome='done'))\n"
    )
    children = [subprocess.Popen([sys.executable, "-c", program, world.url]) for _ in range(2)]
    assert [child.wait() for child in children] == [0, 0]
    assert world.book.verify() == []
    assert len(world.store.audit.events()) == 30


def test_a_torn_line_of_the_heads_does_no_harm(world: World) -> None:
    world.book.write(event(1))
    with world.book.head_file.open("a") as file:
        file.write("2 abc")
    world.book.write(event(2))
    world.book.write(event(3))
    assert world.book.verify() == []


def test_passwords_of_addresses_are_masked(world: World) -> None:
    world.book.write(
        AuditEvent(who="w", action="a", target="mqtt://me:topsecret@host", outcome="done", doc={"db": "postgresql://me:topsecret@host/x"})
    )
    assert "topsecret" not in str(world.store.audit.events())


def test_a_record_that_cannot_be_written_is_an_error(world: World) -> None:
    world.book.write(event(1))
    world.store.close()
    with pytest.raises((AuditBroken, StoreError)):
        world.book.write(event(2))


def test_an_audit_in_memory_works() -> None:
    with Store.open("sqlite://") as store:
        book = AuditBook(store, "sqlite://")
        assert book.write(event(1)).prev == GENESIS
        assert book.verify() == []


def test_on_postgresql_two_stores_write_one_chain_that_only_grows(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = request.getfixturevalue("postgres")()
    monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path))
    with Store.open(url) as one, Store.open(url) as two, ThreadPoolExecutor(2) as pool:
        books = [AuditBook(store, url) for store in (one, two)]
        list(pool.map(lambda n: books[n % 2].write(event(n)), range(20)))
        assert books[0].verify() == []
        assert len(one.audit.events()) == 20
        assert {p.suffix for p in tmp_path.iterdir()} == {".audit-key", ".audit-head"}
        with pytest.raises(StoreError, match="the audit only grows"):
            one.commit(lambda connection: connection.exec_driver_sql("DELETE FROM audit"))
