"""The form that all commands share: help in groups that is never cut, completion, ``--out``, tables that keep their numbers."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import typer

from abbe.service.cli import run
from abbe.service.cli.app import app
from abbe.service.cli.common import first_sentence, print_table

ROOT: Any = typer.main.get_command(app)
GROUPS = [("", ROOT), *((name, command) for name, command in ROOT.commands.items() if hasattr(command, "commands"))]


def helped(words: list[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("COLUMNS", "60")
    assert run([*words, "--help"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize(("name", "group"), GROUPS)
def test_the_help_of_a_group_is_whole(name: str, group: Any, capsys, monkeypatch) -> None:
    text = " ".join(helped(name.split(), capsys, monkeypatch).split())
    for one, command in group.commands.items():
        assert f" {one} {first_sentence(command.help)}" in text


def test_commands_come_in_groups(capsys, monkeypatch) -> None:
    lines = helped([], capsys, monkeypatch).splitlines()
    assert [line for line in lines if re.fullmatch(r"\w+:", line)] == [
        "Options:",
        "Measure:",
        "Understand:",
        "Correct:",
        "Watch:",
        "Manage:",
    ]


@pytest.mark.parametrize(
    ("typed", "offered"), [("abbe so", {"solve", "solve-all"}), ("abbe comp pr", {"propose"}), ("abbe solve --rep", {"--report"})]
)
def test_a_shell_completes(typed: str, offered: set[str], capsys, monkeypatch) -> None:
    monkeypatch.setenv("_ABBE_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(typed.count(" ")))
    with pytest.raises(SystemExit) as ended:
        run([])
    assert ended.value.code == 0
    assert set(capsys.readouterr().out.split()) == offered


def test_the_answer_goes_into_a_file_whole_or_not_at_all(tmp_path: Path, capsys) -> None:
    out = tmp_path / "effects.json"
    assert run(["effects", "--json", "--out", str(out)]) == 0
    assert capsys.readouterr().out == ""
    before = out.read_text(encoding="utf-8")
    assert len(json.loads(before)) > 20
    assert run(["effects", "nonsense", "--out", str(out)]) == 2
    assert out.read_text(encoding="utf-8") == before
    assert run(["effects", "--out", str(tmp_path)]) == 2
    assert "it is a folder" in capsys.readouterr().err


def test_a_piped_table_has_tabs_and_every_cell_on_its_line(capsys) -> None:
    print_table(("name", "µm"), [("a\tb", "1.25"), ("two\nlines", "−3 ± 1")], title="before")
    assert capsys.readouterr().out == "before\nname\tµm\na\\tb\t1.25\ntwo; lines\t−3 ± 1\n"


def test_a_terminal_breaks_words_but_no_number(capsys, monkeypatch) -> None:
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "20")
    numbers = ("-118.25 ± 0.04", "1234567.8")
    print_table(("what", "µm", "mm"), [("a name that is longer than the terminal", *numbers)])
    shown = capsys.readouterr().out
    assert all(number in shown for number in numbers)
    assert "…" not in shown
