"""Every command: JSON on request, stable exit codes, completion, the next command on its last line, one line for a wrong input.

The commands run in the order of `CASES`, in one folder: a user is added before the others change it.
"""

from __future__ import annotations

import io
import json
import os
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
import typer

from abbe.service.cli import run
from abbe.service.cli.administration.audit import commands
from abbe.service.cli.app import app
from tests.conftest import ROOT as REPOSITORY
from tests.service.cli.every_command import CASES, Case, filled_folder

pytestmark = [pytest.mark.timeout(300), pytest.mark.usefixtures("solved_once")]
ROOT: Any = typer.main.get_command(app)
HERE = [name for name, case in CASES.items() if not case.proof]


@pytest.fixture(scope="module")
def world(tmp_path_factory) -> Path:
    return filled_folder(tmp_path_factory)


class Call:
    """Runs commands in the world, as a person types them."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
        for name in [name for name in os.environ if name.startswith("ABBE_")]:
            monkeypatch.delenv(name)
        monkeypatch.chdir(folder)
        self.names = json.loads((folder / "words.json").read_text())
        self.capsys, self.monkeypatch = capsys, monkeypatch

    def filled(self, text: str, number: int) -> str:
        for word, value in self.names.items():
            text = text.replace(word, str(value))
        return text.replace("#", str(number))

    def __call__(self, words: str, *more: str, number: int = 1, typed: str = "") -> tuple[int, str, str]:
        self.monkeypatch.setattr("sys.stdin", io.StringIO(typed))
        code = run([*shlex.split(self.filled(words, number)), *more])
        return code, *self.capsys.readouterr()


@pytest.fixture
def call(world: Path, capsys, monkeypatch) -> Call:
    return Call(world, capsys, monkeypatch)


def test_no_command_is_forgotten() -> None:
    assert {name for name, _ in commands(app)} == set(CASES)
    for case in CASES.values():
        assert case.wrong
        assert case.error
        assert case.then
        assert Path(case.proof or __file__).exists()


def parsed(words: list[str]) -> str:
    """The command that the words call; an error if they cannot be parsed."""
    command, name = ROOT, []
    while hasattr(command, "commands"):
        name.append(words[0])
        command, words = command.commands[words[0]], words[1:]
    command.make_context(" ".join(name), list(words))
    return " ".join(name)


def test_what_starts_abbe_says_it_as_a_person_would() -> None:
    """The image, the unit and the demonstration: words that no other test hands to the command line."""
    image = re.search(r"^CMD (\[.*\])$", (REPOSITORY / "deploy" / "Dockerfile").read_text(), re.MULTILINE)
    unit = re.search(r"^ExecStart=\S*/abbe (.*)$", (REPOSITORY / "deploy" / "abbe.service").read_text(), re.MULTILINE)
    demo = re.search(r'"abbe\.service\.cli", (.*)\),$', (REPOSITORY / "service" / "demo" / "demo_serve.py").read_text(), re.MULTILINE)
    assert image is not None
    assert unit is not None
    assert demo is not None
    for words in (json.loads(image[1]), shlex.split(unit[1]), [word.strip().strip('"') for word in demo[1].split(",")]):
        assert parsed(words) == "serve"


@pytest.mark.parametrize("name", HERE)
def test_an_answer_names_the_next_command_and_is_json_on_request(name: str, call: Call) -> None:
    case = CASES[name]
    code, out, err = call(case.words, typed=case.typed)
    assert code in case.codes, err
    last = err.splitlines()[-1]
    assert last.startswith(f"next: abbe {call.filled(case.then, 1)}"), last
    assert parsed(shlex.split(last.removeprefix("next: abbe "))) in CASES
    assert out.strip()
    code, out, err = call(case.words, "--json", number=2, typed=case.typed)
    assert code in case.codes, err
    assert "next:" not in err
    json.loads(out)


@pytest.mark.parametrize("name", CASES)
def test_a_wrong_input_is_one_line_with_its_code(name: str, call: Call) -> None:
    case: Case = CASES[name]
    code, out, err = call(case.wrong, typed=case.typed)
    assert (code, out) == (2, ""), err
    assert err.startswith(f"error {case.error}: "), err
    assert err.count("\n") == 1


@pytest.mark.parametrize("name", CASES)
def test_a_shell_completes_its_options(name: str, call: Call) -> None:
    words = f"abbe {name} --js"
    call.monkeypatch.setenv("_ABBE_COMPLETE", "complete_bash")
    call.monkeypatch.setenv("COMP_WORDS", words)
    call.monkeypatch.setenv("COMP_CWORD", str(len(words.split()) - 1))
    with pytest.raises(SystemExit) as ended:
        run([])
    assert (ended.value.code, call.capsys.readouterr().out.split()) == (0, ["--json"])
