"""Shared backups: a second one writes only what is new, each stays complete, and a damaged piece is named."""

from __future__ import annotations

import json
import os
import shutil
import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from abbe.service.backup import backup as module
from abbe.service.backup.backup import BackupList, BackupSource, back_up, read_backup
from abbe.service.backup.pieces import PIECE_BYTES, PIECES
from abbe.service.capture.settings import CaptureSettings
from abbe.service.cli import run
from abbe.service.storage.copying import copy_online, rows_of
from abbe.service.storage.store import Store
from tests.experiments.bench.history_case import History, build
from tests.service.backup.conftest import Shop, new_machine_file
from tests.service.capture.capture_bench import new_run

NOW = datetime(2026, 11, 27, tzinfo=UTC)


@pytest.fixture(scope="module")
def month(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database of some megabytes, with runs like those of a real check."""
    path = tmp_path_factory.mktemp("month") / "abbe.sqlite3"
    build(f"sqlite:///{path}", History(machines=1, days=10, runs=200))
    return path


@pytest.fixture
def grown(month: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three folders: a first shared backup, a second after one more run, and the database."""
    monkeypatch.delenv("ABBE_AUDIT_FOLDER", raising=False)
    (tmp_path / "backups").mkdir()
    copy_online(month, tmp_path / "abbe.sqlite3")
    share(tmp_path, "first")
    with Store.open(url(tmp_path)) as store:
        new_run(store)
    share(tmp_path, "second", hours=24)
    return tmp_path


def url(folder: Path) -> str:
    return f"sqlite:///{folder / 'abbe.sqlite3'}"


def share(folder: Path, name: str, hours: int = 0) -> BackupList:
    source = BackupSource(url(folder), CaptureSettings())
    return back_up(source, folder / "backups" / name, lambda: NOW + timedelta(hours=hours), share=True)


def written(folder: Path) -> int:
    """Bytes of the files that only this backup holds."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file() and path.stat().st_nlink == 1)


def rows(folder: Path) -> list[tuple[object, ...]]:
    """Every run and every byte of its samples."""
    runs = rows_of(folder / "abbe.sqlite3", "SELECT id, label, start_doc, end_doc FROM runs ORDER BY id")
    return runs + rows_of(folder / "abbe.sqlite3", "SELECT run_id, seq, channel, payload FROM chunks ORDER BY run_id, channel, seq")


def test_a_second_one_writes_only_what_is_new(grown: Path) -> None:
    first, second = (read_backup(grown / "backups" / name) for name in ("first", "second"))
    assert first.listed.pieces is not None
    assert second.listed.pieces is not None
    assert first.listed.pieces.new_bytes == first.listed.pieces.bytes > 3_000_000
    assert 0 < second.listed.pieces.new_bytes <= 8 * PIECE_BYTES
    assert written(second.folder) <= 8 * PIECE_BYTES + 100_000
    assert second.listed.rows["runs"] == first.listed.rows["runs"] + 1
    assert list(grown.glob(".abbe.sqlite3*")) == []


@pytest.mark.parametrize("deleted", ["", "first"])
def test_each_restores_its_own_state_also_when_the_other_is_deleted(grown: Path, deleted: str) -> None:
    if deleted:
        shutil.rmtree(grown / "backups" / deleted)
    (grown / "new").mkdir()
    assert run(["restore", str(grown / "backups" / "second"), "--db", url(grown / "new")]) == 0
    assert rows(grown / "new") == rows(grown)
    if not deleted:
        (grown / "old").mkdir()
        assert run(["restore", str(grown / "backups" / "first"), "--db", url(grown / "old")]) == 0
        new = rows(grown / "new")
        assert rows(grown / "old") == new[:200] + new[201:]


@pytest.mark.parametrize("how", ["damaged", "missing", "additional", "linked elsewhere"])
def test_a_wrong_piece_is_named_in_one_line(grown: Path, how: str, capsys: pytest.CaptureFixture[str]) -> None:
    backup = grown / "backups" / "second"
    piece = sorted((backup / PIECES).iterdir())[3]
    if how == "damaged":
        data = bytearray(piece.read_bytes())
        data[100] ^= 1
        piece.write_bytes(data)
    elif how == "additional":
        piece = backup / PIECES / "more"
        piece.touch()
    else:
        piece.unlink()
    if how == "linked elsewhere":
        piece.symlink_to("/dev/zero")
    (grown / "new").mkdir()
    capsys.readouterr()
    assert run(["restore", str(backup), "--db", url(grown / "new")]) == 2
    said = capsys.readouterr().err
    told = {"damaged": "is changed since the backup", "missing": "is missing", "additional": "is not part of this backup"}
    assert f"{piece} {told.get(how, 'is changed since the backup')}" in said
    assert said.count("\n") == 1
    assert list((grown / "new").iterdir()) == []


def test_a_damaged_piece_of_the_last_one_is_written_anew(grown: Path) -> None:
    for piece in (grown / "backups" / "second" / PIECES).iterdir():
        piece.write_bytes(bytes(piece.stat().st_size))
    third = share(grown, "third", hours=48)
    assert third.pieces is not None
    assert third.pieces.new_bytes == third.pieces.bytes
    read_backup(grown / "backups" / "third")


@pytest.mark.parametrize("fault", ["for all", "of another account"])
def test_a_piece_that_is_not_private_is_written_anew(grown: Path, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if fault == "for all":
        for piece in (grown / "backups" / "second" / PIECES).iterdir():
            piece.chmod(0o666)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: os.getuid() + 1)
    third = share(grown, "third", hours=48)
    assert third.pieces is not None
    assert third.pieces.new_bytes == third.pieces.bytes
    made = [path.stat() for path in (grown / "backups" / "third" / PIECES).iterdir()]
    assert {(stat.S_IMODE(one.st_mode), one.st_nlink) for one in made} == {(0o600, 1)}


@pytest.mark.parametrize("which", ["more", "fewer"])
def test_a_list_of_another_size_is_refused_in_one_line(grown: Path, which: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Each piece of the list is there, but the database would have a piece twice, or end too early."""
    path = grown / "backups" / "second" / "backup.json"
    doc = json.loads(path.read_text())
    names = doc["pieces"]["names"]
    doc["pieces"]["names"] = [*names, names[0]] if which == "more" else names[:-1]
    if which == "fewer":
        (path.parent / PIECES / names[-1]).unlink()
    path.write_text(json.dumps(doc))
    (grown / "new").mkdir()
    capsys.readouterr()
    assert run(["restore", str(path.parent), "--db", url(grown / "new")]) == 2
    said = capsys.readouterr().err
    assert f"the pieces in {path.parent / PIECES} have " in said
    assert f" bytes, but their list says {doc['pieces']['bytes']} bytes" in said
    assert said.count("\n") == 1
    assert list((grown / "new").iterdir()) == []


def test_without_hard_links_it_writes_all(grown: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(*_: object) -> None:
        raise OSError(1, "Operation not permitted")

    monkeypatch.setattr(os, "link", refused)
    third = share(grown, "third", hours=48)
    assert third.pieces is not None
    assert third.pieces.new_bytes == third.pieces.bytes


def test_it_is_for_its_owner_only_and_says_what_is_new(
    shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "a"), "--share"]) == 0
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "b"), "--share"]) == 0
    assert "MB new), checked" in capsys.readouterr().out
    modes = {stat.S_IMODE(path.stat().st_mode) for path in (tmp_path / "b").rglob("*")}
    assert modes == {0o600, 0o700}
    elsewhere = new_machine_file(tmp_path / "elsewhere")
    assert run(["restore", "-m", str(elsewhere), str(tmp_path / "b")]) == 0
    assert run(["audit", "verify", "--machine", str(elsewhere)]) == 0
    monkeypatch.setattr(module, "ROOM_BYTES", 1 << 60)
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "c"), "--share"]) == 2
    assert "free disk space, or leave out --share" in capsys.readouterr().err
    assert not (tmp_path / "c").exists()
    assert not list(tmp_path.glob(".c*"))


def test_a_list_of_an_unknown_format_is_refused(grown: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = grown / "backups" / "first" / "backup.json"
    path.write_text(path.read_text().replace("abbe-backup/2", "abbe-backup/3"))
    assert run(["restore", str(path.parent), "--db", url(grown / "new")]) == 2
    assert "this version of Abbe reads abbe-backup/1 and abbe-backup/2" in capsys.readouterr().err
