"""What the README, and the one of deploy/, tell people to type exists: commands, their options, targets of make, files."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from abbe.service import cli
from abbe.service.config import load_machine

ROOT = Path(__file__).parents[2]
READMES = ("README.md", "deploy/README.md")


def typed(name: str, program: str) -> list[list[str]]:
    """Words of each line that begins with a program, or with it behind a folder or ``sudo``."""
    found = []
    for line in (ROOT / name).read_text().splitlines():
        match = re.match(rf"\s*(?:sudo )?(?:\S*/)?{program} (.*)", line)
        if match and (line.startswith(("    ", "/", "sudo ")) or name.startswith("deploy")):
            found.append(shlex.split(match[1], comments=True))
    return found


COMMANDS = [words for name in READMES for words in typed(name, "abbe")]


def test_there_is_much_to_type() -> None:
    assert len(COMMANDS) >= 25


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_exists_with_its_options(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    names = []
    for word in words:
        if not re.fullmatch(r"[a-z][a-z-]*", word):
            break
        names.append(word)
    for count in (2, 1):  # `comp commission FILE` has two names; in `solve june` the second is a campaign
        if len(names) >= count and cli.run([*names[:count], "--help"]) == 0:
            text = capsys.readouterr().out
            if re.search(rf"Usage: abbe {' '.join(names[:count])}\b", text):
                break
    else:
        pytest.fail(f"no command abbe {' '.join(words)}")
    for option in (word.partition("=")[0] for word in words if word.startswith("--")):
        assert re.search(rf"(?<!\S){option}\b", text), f"{option} is no option of abbe {' '.join(names[:count])}"


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"(?m)^(\w+):", (ROOT / "Makefile").read_text()))
    asked = {words[0] for words in typed("README.md", "make")}
    assert asked
    assert asked <= targets


@pytest.mark.parametrize("name", READMES)
def test_files_that_are_named_are_there(name: str) -> None:
    text = (ROOT / name).read_text()
    links = [link for link in re.findall(r"\]\(([^)#]+)", text) if "://" not in link]
    places = re.findall(r"\b(?:docs|deploy)/[\w./-]+\.\w+", text)
    assert [link for link in links if not ((ROOT / name).parent / link).exists()] == []
    assert [place for place in places if not (ROOT / place).exists()] == []


def test_the_example_needs_only_addresses_for_a_first_check() -> None:
    """It has limits to be judged by, and a recipe that the README names."""
    machine = load_machine(ROOT / "deploy" / "machine.example.toml").machine
    assert machine.verify.body_diagonal_um is not None
    assert {"ballbar", "laser", "cnc", "fixture"} <= set(machine.devices.model_dump(exclude_none=True))
