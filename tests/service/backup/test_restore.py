"""A restored database answers as the one that was backed up; and nothing that is in use, damaged or forged is restored."""

from __future__ import annotations

import json
import os
import shutil
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import pytest

from abbe.service.backup.backup import file_list
from abbe.service.cli import run
from abbe.service.runs.exchange import import_folder
from abbe.service.storage.engine import head_revision
from abbe.service.storage.store import Store
from tests.scenarios.campaign_files import measured, write_folder
from tests.service.backup.conftest import Shop, new_machine_file

HOLDER = (
    "import sys; from abbe.service.storage.store import Store\n"
    "with Store.open(sys.argv[1]):\n    print('open', flush=True); sys.stdin.read()"
)


@pytest.fixture
def made(shop: Shop, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Path:
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "backup")]) == 0
    capsys.readouterr()
    return tmp_path / "backup"


@pytest.fixture
def elsewhere(tmp_path: Path) -> Path:
    return new_machine_file(tmp_path / "elsewhere")


def answers(machine: Path, capsys: pytest.CaptureFixture[str]) -> dict[str, object]:
    """Trend, solution, runs, and the state of the audit."""
    found: dict[str, object] = {}
    at = ["--machine", str(machine)]
    for name, words in {
        "trend": ["trend", "-m", str(machine)],
        "runs": ["runs", *at],
        "solve": ["solve", "c1-shop", "--model", "rigid6", *at],
    }.items():
        assert run([*words, "--json"]) == 0
        found[name] = json.loads(capsys.readouterr().out)
    assert run(["audit", "verify", *at]) == 0
    capsys.readouterr()
    return found


def test_a_restored_database_gives_identical_answers(
    shop: Shop, tmp_path: Path, elsewhere: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    site, runs = measured(7, "one_tool")
    folder = write_folder(tmp_path / "campaign", site.doc, runs)
    head = json.loads((folder / "campaign.json").read_text()) | {"campaign": "c1-shop"}
    (folder / "campaign.json").write_text(json.dumps(head))
    for entry in head["runs"]:
        one = json.loads((folder / entry["file"]).read_text()) | {"campaign": "c1-shop"}
        (folder / entry["file"]).write_text(json.dumps(one))
    with Store.open(shop.url) as store:
        import_folder(store, folder)
    assert run(["backup", "-m", str(shop.machine), str(tmp_path / "backup")]) == 0
    assert run(["restore", "-m", str(elsewhere), str(tmp_path / "backup")]) == 0
    assert "records: none missing, none changed" in capsys.readouterr().out
    assert answers(elsewhere, capsys) == answers(shop.machine, capsys)
    with Store.open(f"sqlite:///{elsewhere.parent / 'abbe.sqlite3'}") as store:
        assert [one.action for one in store.audit.events()][5:] == [
            "abbe restore",
            "abbe solve",
        ]  # the copy has not the record of its making


def test_a_database_in_use_is_left_alone_even_when_it_may_be_replaced(shop: Shop, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = shop.database.read_bytes()
    with subprocess.Popen([sys.executable, "-c", HOLDER, shop.url], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None
        assert child.stdin is not None
        assert child.stdout.readline() == b"open\n"
        assert run(["restore", "-m", str(shop.machine), str(made), "--replace"]) == 2
        assert f"is in use by process {child.pid}" in capsys.readouterr().err
        child.stdin.close()
    with closing(sqlite3.connect(shop.database, isolation_level=None)) as other:  # and one that writes in this very process
        other.execute("BEGIN IMMEDIATE")
        assert run(["restore", "-m", str(shop.machine), str(made), "--replace"]) == 2
        assert "is in use by another process" in capsys.readouterr().err
        other.execute("ROLLBACK")
    assert shop.database.read_bytes() == before


def test_an_existing_database_is_only_put_aside_when_asked(shop: Shop, made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with Store.open(shop.url) as store:
        store.verifications.add(1, None, "pass", {"late": True})
    assert run(["restore", "-m", str(shop.machine), str(made)]) == 2
    assert "exists - add --replace" in capsys.readouterr().err
    assert run(["restore", "-m", str(shop.machine), str(made), "--replace", "--json"]) == 0
    aside = [Path(name) for name in json.loads(capsys.readouterr().out)["aside"]]
    old = next(path for path in aside if path.name.startswith("abbe.sqlite3.replaced-") and not path.name.endswith("-journal"))
    with Store.open(f"sqlite:///{old}") as store:
        assert store.verifications.latest(limit=1)[0].doc == {"late": True}
    with Store.open(shop.url) as store:
        assert len(store.verifications.latest()) == 40
    assert (shop.folder / "abbe.sqlite3-capture" / "run-00000001.seg").exists()
    assert run(["audit", "verify", "--machine", str(shop.machine)]) == 0


@pytest.mark.parametrize("name", ["abbe.sqlite3", "audit-key", "audit-head", "capture/run-00000001.seg"])
def test_a_damaged_file_is_named_and_nothing_restored(made: Path, elsewhere: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    data = bytearray((made / name).read_bytes())
    data[len(data) // 2] ^= 1
    (made / name).write_bytes(data)
    assert run(["restore", "-m", str(elsewhere), str(made)]) == 2
    assert f"{name} is changed since the backup" in capsys.readouterr().err
    assert [path.name for path in elsewhere.parent.iterdir()] == ["machine.toml"]


def _edited(made: Path, *statements: str) -> None:
    """By somebody who makes the list anew as well."""
    with closing(sqlite3.connect(made / "abbe.sqlite3")) as database:
        database.execute("DROP TRIGGER audit_no_delete")
        for statement in statements:
            database.execute(statement)
        database.commit()
    doc = json.loads((made / "backup.json").read_text())
    (made / "backup.json").write_text(json.dumps(doc | {"files": {name: asdict(one) for name, one in file_list(made).items() if one}}))


@pytest.mark.parametrize(
    ("statement", "told"),
    [
        ("DELETE FROM audit WHERE id = 5", "is broken: record 5 was written and is missing: the audit holds 4"),
        ("DELETE FROM audit WHERE id = 2", "is broken: record 2 is missing"),
        ("UPDATE alembic_version SET version_num = '9999'", "has schema 9999, which this version of Abbe does not know"),
        ("DELETE FROM machines", "rows refer to missing rows"),
        ("DROP TABLE alembic_version", "is not a database of Abbe"),
    ],
)
def test_what_was_changed_on_purpose_is_refused(
    made: Path, elsewhere: Path, statement: str, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    _edited(made, statement)
    assert run(["restore", "-m", str(elsewhere), str(made)]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert told in err
    assert [path.name for path in elsewhere.parent.iterdir()] == ["machine.toml"]


def test_a_backup_of_the_first_schema_is_brought_up_to_date(made: Path, elsewhere: Path) -> None:
    first = "ALTER TABLE users DROP COLUMN pin", "ALTER TABLE users DROP COLUMN pin_failures"
    _edited(made, *first, "UPDATE alembic_version SET version_num = '0100'")
    assert run(["restore", "-m", str(elsewhere), str(made)]) == 0
    with Store.open(f"sqlite:///{elsewhere.parent / 'abbe.sqlite3'}") as store:
        assert store.health().revision == head_revision()
        assert store.people.all() == []


def test_without_its_key_it_is_asked_for(shop: Shop, tmp_path: Path, elsewhere: Path, capsys: pytest.CaptureFixture[str]) -> None:
    backup = str(tmp_path / "backup")
    assert run(["backup", "-m", str(shop.machine), backup, "--without-key"]) == 0
    assert "abbe restore needs it" in capsys.readouterr().out
    assert not (tmp_path / "backup" / "audit-key").exists()
    assert run(["restore", "-m", str(elsewhere), backup]) == 2
    assert "give --audit-key FILE" in capsys.readouterr().err
    other = tmp_path / "other-key"
    other.write_bytes(bytes(32))
    assert run(["restore", "-m", str(elsewhere), backup, "--audit-key", str(other)]) == 2
    assert "sealed with another key" in capsys.readouterr().err
    assert run(["restore", "-m", str(elsewhere), backup, "--audit-key", str(shop.folder / "abbe.sqlite3.audit-key")]) == 0
    assert run(["audit", "verify", "--machine", str(elsewhere)]) == 0


@pytest.mark.parametrize("step", range(1, 5))
def test_cut_off_at_any_step_there_is_the_old_database_or_none(shop: Shop, made: Path, step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk gives up while the parts are put into place; and a second try succeeds."""
    before, count, move = shop.database.read_bytes(), [0], shutil.move

    def moving(source: Path, target: Path) -> object:
        count[0] += 1
        if count[0] == step:
            raise OSError(28, "No space left on device")
        return move(source, target)

    monkeypatch.setattr(shutil, "move", moving)
    assert run(["restore", "-m", str(shop.machine), str(made), "--replace"]) == 2
    monkeypatch.undo()
    assert count[0] == step
    assert not shop.database.exists()
    (old,) = [
        path for path in shop.folder.glob("abbe.sqlite3.replaced-*") if path.suffix.startswith(".replaced") and "-journal" not in path.name
    ]
    assert old.read_bytes() == before
    assert not list(shop.folder.glob(".*restoring*"))
    monkeypatch.setattr("abbe.service.clock.SystemClock.utc", lambda _: _later())
    assert run(["restore", "-m", str(shop.machine), str(made), "--replace"]) == 0


def _later() -> object:
    from datetime import UTC, datetime

    return datetime(2031, 1, 1, tzinfo=UTC)


def test_in_a_folder_for_several_databases_the_audits_are_kept_apart(
    shop: Shop, made: Path, elsewhere: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two databases of one name under `ABBE_AUDIT_FOLDER`: before, the heads of one spoke against the other."""
    (tmp_path / "audit").mkdir()
    for ending in ("key", "head"):  # as an earlier version has named them there
        shutil.move(shop.folder / f"abbe.sqlite3.audit-{ending}", tmp_path / "audit" / f"abbe.sqlite3.audit-{ending}")
    monkeypatch.setenv("ABBE_AUDIT_FOLDER", str(tmp_path / "audit"))
    assert run(["restore", "-m", str(elsewhere), str(made)]) == 0
    for machine in (shop.machine, elsewhere):
        assert run(["backup", "-m", str(machine), str(tmp_path / f"again-{machine.parent.name}")]) == 0
        assert run(["audit", "verify", "--machine", str(machine)]) == 0
    assert len(list((tmp_path / "audit").glob("abbe.sqlite3*.audit-key"))) == 2


@pytest.mark.parametrize("odd", ["link to a device", "link to a folder", "pipe", "list"])
def test_what_no_backup_holds_is_not_followed(
    shop: Shop, made: Path, elsewhere: Path, odd: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """A copy would read the device for ever, wait at the pipe, or take a strange folder along."""
    if odd == "list":
        (made / "backup.json").unlink()
    path = made / ("backup.json" if odd == "list" else "more")
    if odd in {"pipe", "list"}:
        os.mkfifo(path)
    else:
        path.symlink_to("/dev/zero" if odd == "link to a device" else "/etc")
    assert run(["restore", "-m", str(elsewhere), str(made)]) == 2
    said = capsys.readouterr().err
    assert "it is a pipe" in said if odd == "list" else f"{path} is not part of this backup" in said
    assert not (elsewhere.parent / "abbe.sqlite3").exists()
