"""What cannot be recorded is not done: asked before a command acts, said in one line, and said as well when it shows only afterwards."""

from __future__ import annotations

import json
import os
import pwd
import shutil
import sqlite3
import stat
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest
import typer

from abbe.service.audit.book import AuditBook, follow
from abbe.service.cli import run
from abbe.service.cli.administration.audit import record_all
from abbe.service.cli.common import print_table
from abbe.service.domain.service_records import AuditEvent
from abbe.service.errors import AuditBroken, StoreError
from abbe.service.storage.engine import private_file, readable_by_others
from abbe.service.storage.store import Store
from tests.migration import next_revision
from tests.service.users.conftest import World

URL = "sqlite:///abbe.sqlite3"
EVIL = "\x1b[2J\x9b1;31m\nrecord 99\r\u202e\udcff\0"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ABBE_DB", raising=False)
    return tmp_path


@pytest.fixture
def open_folder() -> Iterator[Path]:
    """A folder that every account can get into, unlike pytest's own."""
    path = Path(tempfile.mkdtemp(prefix="abbe-test-"))
    path.chmod(0o777)
    yield path
    shutil.rmtree(path)


@contextmanager
def not_ours(file: Path) -> Iterator[None]:
    """As who may read all files of the folder but this one: another account if we are root, else without the right to read."""
    if os.geteuid() != 0:
        file.chmod(0)
        yield
        return
    nobody = pwd.getpwnam("nobody").pw_uid
    for other in file.parent.iterdir():
        os.chown(other, 0 if other == file else nobody, -1)
    os.seteuid(nobody)
    try:
        yield
    finally:
        os.seteuid(0)


def event(n: int) -> AuditEvent:
    return AuditEvent(who="w", action="a", target=str(n), outcome="done")


def test_a_key_of_somebody_else_is_refused_in_one_line_before_anything(open_folder: Path) -> None:
    url = f"sqlite:///{open_folder / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        first = AuditBook(store, url)
        first.write(event(1))
        first.ready()
        assert first.verify() == []  # also: whatever Python loads for this is loaded, the other account may not be able to
        with not_ours(first.key_file):
            book = AuditBook(store, url)
            for ask in (book.ready, lambda: book.write(event(2))):
                with pytest.raises(AuditBroken, match=r"\.audit-key: Permission denied \(it belongs to .*rights .* - .*chown") as found:
                    ask()
                assert found.value.code == "AUD-001"
                assert "\n" not in str(found.value)
            assert "Permission denied" in book.verify()[0]
        assert len(store.audit.events()) == 1


def test_ready_leaves_nothing_behind_and_sees_each_file(world: World) -> None:
    world.book.ready()
    folder = world.book.key_file.parent
    assert not [p.name for p in folder.iterdir() if "audit" in p.name]
    world.book.head_file.mkdir()
    with pytest.raises(AuditBroken, match="audit-head: Is a directory"):
        world.book.ready()
    world.book.head_file.rmdir()
    world.book.key_file.write_bytes(b"short")
    with pytest.raises(AuditBroken, match="is not a key of an audit"):
        world.book.ready()
    world.book.key_file.unlink()
    world.store.close()
    with pytest.raises(StoreError):
        world.book.ready()


def test_ready_sees_a_database_that_takes_no_writes(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("abbe.service.storage.engine.BUSY_TIMEOUT_MS", 50)
    with Store.open(world.url) as store, closing(sqlite3.connect(world.book.key_file.parent / "abbe.sqlite3")) as other:
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreError, match="locked"):
            AuditBook(store, world.url).ready()
        other.rollback()
        AuditBook(store, world.url).ready()


def test_a_command_that_could_not_be_recorded_does_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Store.open(URL).close()
    (folder / "abbe.sqlite3.audit-head").mkdir()
    assert run(["key", "new", "key.pem"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error AUD-001: abbe key new was not started, because it could not be recorded: ")
    assert said.count("\n") == 1
    assert not (folder / "key.pem").exists()


def test_a_database_that_cannot_be_opened_refuses_a_command(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (folder / "text.sqlite3").write_text("this is no database at all")
    monkeypatch.setenv("ABBE_DB", "sqlite:///text.sqlite3")
    assert run(["key", "new", "key.pem"]) == 2
    assert capsys.readouterr().err.startswith("error STO-001: ")
    assert not (folder / "key.pem").exists()


def test_a_change_without_a_database_is_said_to_be_unrecorded(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["key", "new", "key.pem"]) == 0
    assert "not recorded in an audit: there is no database abbe.sqlite3\n" in capsys.readouterr().err
    assert run(["user", "disable", "bob"]) == 2  # refused by itself: one line is enough
    assert capsys.readouterr().err.count("\n") == 1
    assert [p.name for p in folder.iterdir()] == ["key.pem"]


def test_a_database_that_goes_away_during_a_command_is_said(folder: Path) -> None:
    Store.open(URL).close()
    tree = typer.Typer()

    @tree.command("new")
    def new() -> None:
        Path("abbe.sqlite3").write_text("no database any more")

    @tree.command("other")
    def other() -> None:
        Path("abbe.sqlite3").write_text("no database any more")
        raise ZeroDivisionError

    record_all(tree)
    with pytest.raises(AuditBroken, match=r"abbe new ended \(done\), but it could not be recorded"):
        tree(["new"], standalone_mode=False)
    (folder / "abbe.sqlite3").unlink()
    Store.open(URL).close()
    with pytest.raises(ZeroDivisionError) as found:
        tree(["other"], standalone_mode=False)
    assert "could not be recorded" in found.value.__notes__[0]


def test_nothing_in_the_audit_commands_a_terminal(world: World, capsys: pytest.CaptureFixture[str]) -> None:
    """Neither what is written from now on, nor what an older version, or somebody with the file, has put there."""
    world.book.write(AuditEvent(who=EVIL, action=EVIL, target=EVIL, outcome=EVIL, doc={EVIL: [EVIL, {"k": EVIL}]}))
    raw = EVIL.replace("\udcff", "").replace("\0", "")
    key = world.book.key_file.read_bytes()
    world.store.audit.append(
        lambda last, utc: follow(last, utc, AuditEvent(who=raw, action=raw, target=raw, outcome=raw, doc={"k": raw}), key)
    )
    assert not set(EVIL) & set("\x1b\x9b\r\n\0") & set(str(world.store.audit.events()[0]))
    assert world.store.audit.events()[0].target.startswith(r"\x1b[2J\x9b1;31m\nrecord 99\r\u202e\udcff\x00")
    assert run(["audit", "show", "--db", world.url]) == 0
    shown = capsys.readouterr().out
    assert not set("\x1b\x9b\r\u202e") & set(shown)
    assert len(shown.strip().splitlines()) == 3  # headings, two records
    assert run(["audit", "show", "--json", "--db", world.url]) == 0
    told = capsys.readouterr().out
    assert not set("\x1b\x9b\r\u202e") & set(told)
    assert json.loads(told)[1]["target"] == raw


def test_nothing_in_a_table_commands_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(("name",), [[EVIL], ["two\nlines"]])
    shown = capsys.readouterr().out
    assert not set("\x1b\x9b\r\u202e\udcff") & set(shown)
    assert shown.splitlines()[-1] == "two; lines"  # a line is a row


def test_nothing_in_an_error_commands_a_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["user", "disable", EVIL.replace("\0", ""), "--db", "sqlite:///\x1b]0;title\x07"]) == 2
    said = capsys.readouterr().err
    assert r"\x1b]0;title\x07" in said
    assert said.count("\n") == 1


def test_a_file_name_that_is_no_text_is_recorded(folder: Path) -> None:
    Store.open(URL).close()
    assert run(["key", "new", os.fsdecode(b"k\xff.pem")]) == 0
    with Store.open(URL) as store:
        assert [r.target for r in store.audit.events()] == [r"k\udcff.pem"]
        assert AuditBook(store, URL).verify() == []


def test_an_audit_that_was_emptied_beside_its_key_is_named(world: World) -> None:
    assert world.book.verify() == []  # never begun
    world.book.ready()
    assert AuditBook(world.store, world.url).verify() == []
    world.book.write(event(1))
    world.store.commit(lambda connection: connection.exec_driver_sql("DROP TRIGGER audit_no_delete"))
    world.store.commit(lambda connection: connection.exec_driver_sql("DELETE FROM audit"))
    world.book.head_file.unlink()
    assert ["is empty, but its key is here" in text for text in world.book.verify()] == [True]


def test_a_torn_line_costs_no_other_head(world: World) -> None:
    world.book.write(event(1))
    with world.book.head_file.open("ab") as file:
        file.write(b"2 abc")
    world.book.write(event(2))
    with world.book.head_file.open("ab") as file:
        file.write(b"\0\0\0\xff")  # what some file systems leave of a line after a power cut
    world.book.ready()
    world.book.write(event(3))
    world.store.commit(lambda connection: connection.exec_driver_sql("DROP TRIGGER audit_no_delete"))
    world.store.commit(lambda connection: connection.exec_driver_sql("DELETE FROM audit WHERE id > 1"))
    assert [text.split(":")[0] for text in world.book.verify()] == [f"record {n} was written and is missing" for n in (2, 3)]


REPLACING = (
    "REPLACE INTO audit SELECT id, utc, 'user:other', action, target, outcome, doc, prev, digest, key, mac FROM audit WHERE id = 1",
    "INSERT OR REPLACE INTO audit SELECT 3, utc, 'user:x', action, target, outcome, doc, prev, digest, key, mac FROM audit WHERE id = 1",
    "UPDATE OR REPLACE audit SET id = 1 WHERE id = 2",
    "INSERT INTO audit SELECT * FROM audit WHERE id = 2 ON CONFLICT (id) DO UPDATE SET who = 'user:other'",
    "INSERT OR IGNORE INTO audit SELECT 9, utc, who, action, target, outcome, doc, 'x', digest, key, mac FROM audit WHERE id = 1",
)


@pytest.mark.parametrize("change", REPLACING)
def test_replacing_a_record_is_refused_by_sqlite(world: World, change: str) -> None:
    world.book.write(event(1))
    world.book.write(event(2))
    before = world.store.audit.events()
    with (
        closing(sqlite3.connect(world.book.key_file.parent / "abbe.sqlite3")) as file,
        pytest.raises(sqlite3.IntegrityError, match="the audit only grows"),
    ):
        file.execute(change)
    assert world.store.audit.events() == before
    world.book.write(event(3))
    assert world.book.verify() == []


def test_emptying_the_table_is_refused_by_postgresql(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = request.getfixturevalue("postgres")()
    monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path))
    with Store.open(url) as store:
        book = AuditBook(store, url)
        book.ready()
        book.write(event(1))
        for change in ("TRUNCATE audit", "TRUNCATE audit CASCADE", "TRUNCATE users, audit CASCADE"):
            with pytest.raises(StoreError, match="the audit only grows"):
                store.commit(lambda connection, change=change: connection.exec_driver_sql(change))
        assert book.verify() == []
        for change in ("DROP TRIGGER audit_not_emptied ON audit", "TRUNCATE audit"):
            store.commit(lambda connection, change=change: connection.exec_driver_sql(change))
        assert "record 1 was written and is missing" in book.verify()[0]
        read_only = f"ALTER DATABASE {url.rpartition('/')[2]} SET default_transaction_read_only = on"
        store.commit(lambda connection: connection.exec_driver_sql(read_only))
        store.engine.dispose()
        with pytest.raises(StoreError, match="is read-only"):
            book.ready()


def test_the_database_its_copy_and_its_journal_are_the_owners_only(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, old = tmp_path / "abbe.sqlite3", os.umask(0)
    try:
        with Store.open(f"sqlite:///{path}") as store:
            AuditBook(store, f"sqlite:///{path}").write(event(1))
        newest = next_revision.install(tmp_path_factory.mktemp("next"), monkeypatch)
        Store.open(f"sqlite:///{path}").close()
    finally:
        os.umask(old)
    rights = {p.name: stat.S_IMODE(p.stat().st_mode) for p in tmp_path.iterdir()}
    assert {"abbe.sqlite3", f"abbe.sqlite3.before-{newest}", "abbe.sqlite3.audit-key", "abbe.sqlite3.audit-head"} <= rights.keys()
    assert set(rights.values()) == {0o600}, rights
    assert any("journal" in name or "wal" in name for name in rights)
    assert readable_by_others(path) == ""
    path.chmod(0o644)
    assert "chmod 600" in readable_by_others(path)


def test_a_database_that_others_may_read_is_warned_of(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Store.open(URL).close()
    for words in (["user", "list"], ["audit", "verify"]):
        assert run(words) == 0
        assert "warning" not in capsys.readouterr().err
    (folder / "abbe.sqlite3").chmod(0o644)
    for words in (["user", "list"], ["audit", "verify"]):
        assert run(words) == 0
        said = capsys.readouterr().err
        assert said.startswith("warning: abbe.sqlite3 has rights 0644: others than its owner may use it")
        assert said.splitlines()[1].endswith(("may log in", "next: abbe backup backup"))


def test_what_root_makes_belongs_to_the_owner_of_the_folder(open_folder: Path) -> None:
    if os.geteuid() != 0:
        pytest.skip("only root can give files away")
    os.chown(open_folder, pwd.getpwnam("nobody").pw_uid, -1)
    url = f"sqlite:///{open_folder / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        AuditBook(store, url).write(event(1))
    assert {p.owner() for p in open_folder.iterdir()} == {"nobody"}
    with pytest.raises(FileExistsError):
        private_file(open_folder / "abbe.sqlite3")


def test_a_demonstration_in_a_file_is_refused_in_one_line(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "kept").write_text("something of mine")
    for words in (["--keep", "kept"], ["--keep", "kept/inside"], ["--keep", "kept", "--hidden", "3"]):
        assert run(["demo", *words]) == 2
        said = capsys.readouterr().err
        assert said.startswith("error CFG-001: kept")
        assert said.count("\n") == 1
    assert (folder / "kept").read_text() == "something of mine"
