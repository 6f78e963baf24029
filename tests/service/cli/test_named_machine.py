"""The machine of a command has one name: ``-m``, else the environment's, else ``abbe.toml`` in the folder. It brings its database."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from abbe.service.cli import run
from tests.service.cli.test_cli import MACHINE_FILE

pytestmark = pytest.mark.usefixtures("clean_environment")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Three machine files: one to name, one for the environment, one that lies in the folder."""
    monkeypatch.chdir(tmp_path)
    for name in ("named", "environment", "abbe"):
        (tmp_path / f"{name}.toml").write_text(MACHINE_FILE + f'[store]\nurl = "sqlite:///{name}.sqlite3"\n', encoding="utf-8")
    return tmp_path


def database(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert run(["check-config", "--json", *words]) == 0
    return str(json.loads(capsys.readouterr().out)["database"]).rpartition("/")[2]


def test_the_option_comes_before_the_environment_and_that_before_the_folder(folder, capsys, clean_environment) -> None:
    assert database(capsys) == "abbe.sqlite3"
    clean_environment.setenv("ABBE_MACHINE", "environment.toml")
    assert database(capsys) == "environment.sqlite3"
    assert database(capsys, "-m", "named.toml") == database(capsys, "--machine", "named.toml") == "named.sqlite3"


def test_a_command_of_the_database_takes_that_of_the_machine(folder, capsys, clean_environment, campaign_folder) -> None:
    clean_environment.setenv("ABBE_DB", "sqlite:///other.sqlite3")
    assert run(["import", str(campaign_folder)]) == 0
    assert (folder / "abbe.sqlite3").exists()
    assert run(["import", str(campaign_folder), "-m", "named.toml"]) == 0
    (folder / "abbe.toml").unlink()
    assert run(["import", str(campaign_folder)]) == 0  # no machine at all: that of the environment
    assert {path.name for path in folder.glob("*.sqlite3")} == {"abbe.sqlite3", "named.sqlite3", "other.sqlite3"}


@pytest.mark.parametrize("words", [["measure"], ["trend"], ["comp", "push", "1"], ["alarm", "list"], ["serve"]])
def test_without_a_machine_nothing_begins(words: list[str], tmp_path, monkeypatch, capsys) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(words) == 2
    assert capsys.readouterr().err.startswith("error CFG-001: no machine is named - give -m FILE, set ABBE_MACHINE, or go to the folder of")
    assert not list(tmp_path.iterdir())


def test_a_model_is_of_the_only_machine_or_of_a_named_one(folder, capsys, campaign_folder) -> None:
    (folder / "abbe.toml").unlink()
    assert run(["import", str(campaign_folder)]) == 0
    assert run(["model", "show"]) == 2
    assert "has no version 0" in capsys.readouterr().err
    assert run(["model", "show", "--db", "sqlite://"]) == 2
    assert "which machine? sqlite:// holds none - add --of NAME" in capsys.readouterr().err
