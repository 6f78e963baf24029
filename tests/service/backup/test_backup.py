"""A backup holds everything that was on the disk when it began, while others write; and it is there as a whole or not at all."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from abbe.service.backup.backup import read_backup
from abbe.service.capture.recovery import recover_segments
from abbe.service.capture.settings import CaptureSettings
from abbe.service.cli import run
from abbe.service.errors import BackupRefused, StoreError
from abbe.service.runs.chunks import decode_bar
from abbe.service.storage.copying import copy_online, prove_copy, rows_of
from abbe.service.storage.store import Store
from tests.service.backup.conftest import SAMPLES, Shop, new_machine_file
from tests.service.capture.capture_bench import assert_true

HERE = Path(__file__).parent
ABBE = (sys.executable, "-c", "from abbe.service.cli import main; main()")


class Writer:
    """A process that writes all the time."""

    def __init__(self, url: str) -> None:
        self.child = subprocess.Popen([sys.executable, HERE / "writing_child.py", url, "1"], stdout=subprocess.PIPE, text=True)
        self.on_disk = self.next()

    def next(self) -> int:
        assert self.child.stdout is not None
        return int(self.child.stdout.readline())

    def drain(self, count: int) -> None:
        for _ in range(count):
            self.on_disk = self.next()

    def close(self) -> None:
        self.child.kill()
        self.child.communicate()


@pytest.fixture
def writer(shop: Shop) -> Iterator[Writer]:
    with closing(Writer(shop.url)) as one:
        yield one


def test_while_another_process_writes_nothing_acknowledged_is_missing(shop: Shop, writer: Writer, tmp_path: Path) -> None:
    for k in range(4):
        writer.drain(10)
        target = tmp_path / f"backup-{k}"
        assert run(["backup", "-m", str(shop.machine), str(target)]) == 0
        assert prove_copy(target / "abbe.sqlite3") == read_backup(target).listed.schema
        numbers = [row[0] for row in rows_of(target / "abbe.sqlite3", "SELECT id FROM verifications ORDER BY id")]
        assert numbers == list(range(1, len(numbers) + 1))  # one instant: a prefix of what was written
        assert len(numbers) >= writer.on_disk
    writer.drain(10)  # and the writer was not hurt
    assert writer.child.poll() is None


def test_a_database_that_is_written_between_all_steps_is_copied_in_one(shop: Shop, writer: Writer, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("abbe.service.storage.copying.PAGES", 1)
    monkeypatch.setattr("abbe.service.storage.copying.RESTARTS", 1)
    copy_online(shop.database, tmp_path / "copy")
    prove_copy(tmp_path / "copy")


def test_what_the_database_does_not_have_yet_is_in_it(shop: Shop, tmp_path: Path) -> None:
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "backup")]) == 0
    elsewhere = new_machine_file(tmp_path / "elsewhere")
    assert run(["restore", "-m", str(elsewhere), str(tmp_path / "backup")]) == 0
    with Store.open(f"sqlite:///{elsewhere.parent / 'abbe.sqlite3'}") as store:
        assert len(store.chunks.of_run(shop.run_id, "bar")) == 4
        (done,) = recover_segments(store, CaptureSettings())
        assert done.new_chunks == 8
        found = [sample for chunk in store.chunks.of_run(shop.run_id, "bar") for sample in decode_bar(chunk.payload)]
        assert_true(found)
        assert [one.seq for one in found] == list(range(SAMPLES))


def test_only_its_owner_can_read_it_and_nothing_is_overwritten(shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    target = tmp_path / "backup"
    assert run(["backup", "-m", str(shop.machine), str(target)]) == 0
    capsys.readouterr()
    modes = {path.relative_to(target).as_posix(): stat.S_IMODE(path.stat().st_mode) for path in [target, *target.rglob("*")]}
    assert modes.pop(".") == modes.pop("capture") == 0o700
    assert set(modes) == {"abbe.sqlite3", "audit-head", "audit-key", "backup.json", "machine.toml", "capture/run-00000001.seg"}
    assert set(modes.values()) == {0o600}
    before = (target / "backup.json").read_bytes()
    assert run(["backup", "-m", str(shop.machine), str(target)]) == 2
    assert "error STO-004" in capsys.readouterr().err
    assert (target / "backup.json").read_bytes() == before
    with Store.open(shop.url) as store:
        assert store.audit.events(1)[0].action == "abbe backup"


def test_killed_at_any_moment_it_is_whole_or_not_there(shop: Shop, tmp_path: Path) -> None:
    with closing(sqlite3.connect(shop.database)) as database:  # large enough to be hit in the middle
        database.execute("CREATE TABLE ballast (b)")
        database.executemany("INSERT INTO ballast VALUES (randomblob(100000))", [()] * 200)
        database.commit()
    outcomes = set()
    for k in (1, 2, 5):
        target = tmp_path / f"backup-{k}"
        with subprocess.Popen([*ABBE, "backup", "-m", str(shop.machine), str(target)], stdout=subprocess.DEVNULL) as child:
            _wait_for_part(tmp_path, target, child, k)
            child.send_signal(signal.SIGKILL)
        outcomes.add(target.exists())
        if target.exists():
            read_backup(target)
    assert False in outcomes  # some were hit in the middle
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "whole")]) == 0


def _wait_for_part(folder: Path, target: Path, child: subprocess.Popen[bytes], step: int) -> None:
    """Until the k-th thing is there: the folder, the segments, the copied database, then the list."""
    wanted = ("", "capture/run-00000001.seg", "abbe.sqlite3", "audit-head", "machine.toml", "backup.json")[step]
    while child.poll() is None and not target.exists():
        if any((part / wanted).exists() for part in folder.glob(f".{target.name}.part-*")):
            return


def test_a_locked_or_damaged_database_leaves_nothing_behind(shop: Shop, tmp_path: Path) -> None:
    with closing(sqlite3.connect(shop.database, isolation_level=None)) as other:
        other.execute("BEGIN EXCLUSIVE")
        with pytest.raises(StoreError, match=r"locked for 0\.3 s"):
            copy_online(shop.database, tmp_path / "copy", locked_s=0.3)
        other.execute("ROLLBACK")
    data = bytearray(shop.database.read_bytes())
    for at in range(8192, len(data), 4096):
        data[at : at + 64] = bytes(64)
    shop.database.write_bytes(data)
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "backup")]) == 2
    assert not [path for path in tmp_path.iterdir() if "backup" in path.name]


def test_a_changed_audit_is_copied_and_told(shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with closing(sqlite3.connect(shop.database)) as database:
        database.execute("DROP TRIGGER audit_no_update")
        database.execute("UPDATE audit SET who = 'user:eve' WHERE id = 3")
        database.commit()
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "backup")]) == 1
    assert "record 3 was changed" in capsys.readouterr().out
    assert run(["restore", "-m", str(new_machine_file(tmp_path / "elsewhere")), str(tmp_path / "backup")]) == 2
    assert "is broken: record 3 was changed after it was written" in capsys.readouterr().err
    assert not (tmp_path / "elsewhere" / "abbe.sqlite3").exists()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (
            ["--db", "postgresql://me:topsecret@127.0.0.1/abbe", "x"],
            "postgresql://me:***@127.0.0.1/abbe is on a PostgreSQL server - copy it with pg_dump",
        ),
        (["--db", "sqlite://", "x"], "in memory only"),
        (["--db", "sqlite:///none.sqlite3", "x"], "there is no database none.sqlite3"),
        (["x", "-m", "m.toml", "--db", "sqlite://"], "--db and -m both name a database"),
        (["--db", "sqlite:///abbe.sqlite3", "a", "b"], "unexpected extra argument"),
        (["--db", "sqlite:///abbe.sqlite3", "nowhere/x"], "nowhere/x cannot be made: No such file or directory"),
    ],
)
def test_bad_input_is_one_line(shop: Shop, words: list[str], told: str, capsys: pytest.CaptureFixture[str], monkeypatch) -> None:
    monkeypatch.chdir(shop.folder)
    assert run(["backup", *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert told in err
    assert sorted(path.name for path in shop.folder.iterdir() if not path.name.endswith("-journal"))[0] == "abbe.sqlite3"


def test_a_backup_is_read_only_as_it_was_written(shop: Shop, tmp_path: Path) -> None:
    target = tmp_path / "backup"
    assert run(["backup", "-m", str(shop.machine), str(target), "--json"]) == 0
    for name in json.loads((target / "backup.json").read_text())["files"]:
        good = (target / name).read_bytes()
        (target / name).write_bytes(good[:-1] + bytes([good[-1] ^ 1]))
        with pytest.raises(BackupRefused, match=f"{name} is changed since the backup"):
            read_backup(target)
        os.unlink(target / name)
        with pytest.raises(BackupRefused, match=f"{name} is missing"):
            read_backup(target)
        (target / name).write_bytes(good)
    (target / "more").write_text("")
    with pytest.raises(BackupRefused, match="more is not part of this backup"):
        read_backup(target)
