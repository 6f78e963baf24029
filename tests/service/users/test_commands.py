"""Every command is declared to the audit, and one that changes something leaves one record, however it ends."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
import typer

from abbe.service.cli import run
from abbe.service.cli.administration.audit import CHANGES, READS, RECORDS_ITSELF, commands, is_recorded, outcome_of, record_all
from abbe.service.cli.app import app
from abbe.service.storage.store import Store
from tests.service.users.conftest import PHRASE

URL = "sqlite:///abbe.sqlite3"


def test_every_command_is_declared_once() -> None:
    found = [words for words, _ in commands(app)]
    assert len(found) == len(set(found)) > 40
    assert set(found) == READS | RECORDS_ITSELF | set(CHANGES)
    assert not READS & set(CHANGES)
    assert is_recorded("a new command", {})  # until somebody says otherwise


def test_a_new_command_would_be_missed_by_no_test() -> None:
    tree = typer.Typer()
    tree.command("new")(lambda: None)
    record_all(tree)
    assert {words for words, _ in commands(tree)} - READS - RECORDS_ITSELF - set(CHANGES) == {"new"}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("ABBE_DB", raising=False)
    Store.open(URL).close()
    return tmp_path


def typed(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(text))


SAMPLES: dict[str, list[str]] = {
    "demo": ["demo", "--keep", "kept"],  # there is a database from before, which it does not touch
    "measure": ["measure", "-m", "m.toml", "--recipe", "none"],
    "listen": ["listen", "-m", "m.toml", "--recipe", "none.toml"],
    "solve": ["solve", "none"],
    "solve-all": ["solve-all", "none", "--keep"],
    "discover": ["discover", "none"],
    "correct": ["correct", "-m", "m.toml", "none"],
    "accept-table": ["accept-table", "-m", "m.toml"],
    "alarm acknowledge": ["alarm", "acknowledge", "-m", "m.toml", "7"],
    "import": ["import", "none"],
    "model revert": ["model", "revert", "--of", "none", "1"],
    "comp commission": ["comp", "commission", "-m", "m.toml"],
    "comp drop": ["comp", "drop", "-m", "m.toml", "7", "--to", "nowhere"],
    "comp export": ["comp", "export", "7", "--format", "fanuc", "--out", "x", "--sign", "none.pem"],
    "comp propose": ["comp", "propose", "-m", "m.toml", "none"],
    "comp approve": ["comp", "approve", "7"],
    "comp reject": ["comp", "reject", "7", "--reason", "none"],
    "comp push": ["comp", "push", "-m", "m.toml", "7"],
    "comp rollback": ["comp", "rollback", "-m", "m.toml"],
    "comp import": ["comp", "import", "none", "--format", "fanuc"],
    "key new": ["key", "new", "key.pem"],
    "user add": ["user", "add", "bob", "root"],
    "user role": ["user", "role", "bob", "admin"],
    "user password": ["user", "password", "bob"],
    "user disable": ["user", "disable", "bob"],
    "user enable": ["user", "enable", "bob"],
    "user token new": ["user", "token", "new", "bob", "ci", "--scope", "read"],
    "user token revoke": ["user", "token", "revoke", "bob", "ci"],
}


@pytest.mark.parametrize("words", sorted(CHANGES))
def test_each_changing_command_leaves_one_record(words: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Here with input that each refuses: a refusal is recorded as well as a success."""
    (folder / "m.toml").write_text('name = "mill-7"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 500]\nY = [0, 400]\nZ = [-300, 0]\n')
    (folder / "kept").mkdir()
    Store.open("sqlite:///kept/abbe.sqlite3").close()
    typed(monkeypatch, f"{PHRASE}\n")
    code = run(SAMPLES[words])
    with Store.open("sqlite:///kept/abbe.sqlite3" if words == "demo" else URL) as store:
        records = store.audit.events()
    assert len(records) == 1
    assert records[0].action == f"abbe {words}"
    assert records[0].who.startswith("os:")
    assert (records[0].outcome == "done") == (code == 0), records[0].outcome


def test_users_by_the_commands(folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def abbe(*words: str, stdin: str = "") -> tuple[int, str]:
        typed(monkeypatch, stdin)
        code = run(list(words))
        out, err = capsys.readouterr()
        return code, out if code == 0 else out + err  # what comes next is told beside it

    assert abbe("user", "add", "ana", "admin", stdin=PHRASE + "\n") == (0, "user 'ana' is admin\n")
    assert abbe("user", "add", "met", "metrologist", stdin=PHRASE)[0] == 0
    assert abbe("user", "add", "bob", "viewer", stdin="short\n")[1].startswith("error USR-001: a password needs 12 to 256 characters")
    assert abbe("user", "add", "bob", "viewer", PHRASE)[1].startswith("error USE-001")  # a password is not an argument
    assert abbe("user", "disable", "ana")[1].startswith("error USR-002: 'ana' is the only admin")
    assert abbe("user", "password", "met", stdin=PHRASE + " 2\n")[0] == 0
    token = abbe("user", "token", "new", "met", "ci", "--scope", "read", "--scope", "solve", "--days", "2")[1].strip()
    assert token.startswith("abbe_")
    assert json.loads(abbe("user", "token", "list", "--json")[1])[0]["scopes"] == ["read", "solve"]
    assert abbe("user", "token", "revoke", "met", "ci")[0] == 0
    assert abbe("user", "role", "met", "viewer")[0] == abbe("user", "disable", "met")[0] == abbe("user", "enable", "met")[0] == 0
    assert [u["role"] for u in json.loads(abbe("user", "list", "--json")[1])] == ["admin", "viewer"]
    assert abbe("audit", "verify")[0] == 0
    shown = abbe("audit", "show", "--json")[1]
    outcomes = [(r["action"], r["outcome"]) for r in json.loads(shown)]
    assert outcomes[:4] == [
        ("abbe user add", "done"),
        ("abbe user add", "done"),
        ("abbe user add", "USR-001"),
        ("abbe user disable", "USR-002"),
    ]
    assert token not in shown
    assert PHRASE not in shown
    with Store.open(URL) as store:
        assert store.people.active_admins() == 1
    (folder / "abbe.sqlite3.audit-head").write_text("")
    code, out = abbe("audit", "verify")
    assert code == 1
    assert "no checksums are kept" in out


def test_how_a_command_ended() -> None:
    endings = [typer.Exit(0), typer.Exit(1), typer.Exit(2), SystemExit(130), KeyboardInterrupt(), typer.Abort(), ValueError()]
    assert [outcome_of(e) for e in endings] == ["done", "no", "exit 2", "exit 130", "interrupted", "interrupted", "ValueError"]


def test_a_rehearsal_leaves_no_record() -> None:
    assert not is_recorded("measure", {"dry_run": True})
    assert not is_recorded("measure", {"nc": "fanuc"})
    assert is_recorded("measure", {"dry_run": False})
    assert not is_recorded("comp export", {"sign": None})
