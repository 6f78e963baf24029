"""What README, docs/ and the README of deploy/ tell people exists: commands and their options, targets of make, files, links, pictures."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote

import pytest

from abbe.service import cli
from abbe.service.config import load_machine
from tests.project import cli_page, decisions_page, device_file_page, machine_file_page, python_page

ROOT = Path(__file__).parents[2]
PAGES = ("README.md", "CHANGELOG.md", "deploy/README.md", *sorted(str(p.relative_to(ROOT)) for p in (ROOT / "docs").rglob("*.md")))
GENERATED = "docs/reference/cli.md"
"""Written from the command line itself: nothing in it can be missing there."""
PAST = tuple(f"docs/decisions/{name}.md" for name in ("README", "0001-folders-are-packages", "0031-one-import-package", "0032-rooms"))
"""Decisions that also name what stood there before them."""
MUTANTS = "docs/explanation/mutants.md"
"""Written by half an hour of tests, with the files of that day."""


def typed(name: str, program: str) -> Iterator[list[str]]:
    """Words of each line that begins with a program, or with it behind a folder or ``sudo``, and of each that stands between backticks."""
    text = (ROOT / name).read_text(encoding="utf-8")
    for line in text.splitlines():
        match = re.match(rf"\s*(?:sudo )?(?:-u abbe )?(?:\S*/)?{program} (.*)", line)
        if match and (line.startswith(("    ", "/", "sudo ")) or name.startswith("deploy")):
            yield shlex.split(match[1].replace("...", ""), comments=True)
    for inline in re.findall(rf"`{program} ([^`]+)`", text):
        yield shlex.split(inline.replace("'", ""))


COMMANDS = sorted(
    {tuple(words) for name in PAGES if name != GENERATED for words in typed(name, "abbe") if words[0][0].islower() and words[0] != "sim"}
)
"""``sim`` hands its options on to the simulators."""


def test_there_is_much_to_type() -> None:
    assert len([words for name in ("README.md", "deploy/README.md") for words in typed(name, "abbe")]) >= 12
    assert len(COMMANDS) >= 100


@cache
def help_of(*names: str) -> str:
    """Help of a command; nothing where there is no such command."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "200")
        from typer.testing import CliRunner

        from abbe.service.cli.app import app

        answer = CliRunner().invoke(app, [*names, "--help"], prog_name="abbe")
    return answer.output if answer.exit_code == 0 and re.search(rf"Usage: abbe {' '.join(names)}\b", answer.output) else ""


@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_a_command_exists_with_its_options(words: tuple[str, ...]) -> None:
    names = []
    for word in words:
        if not re.fullmatch(r"[a-z][a-z-]*", word):
            break
        names.append(word)
    found = (
        (names[:count], help_of(*names[:count])) for count in (3, 2, 1) if len(names) >= count
    )  # in `solve june` the second is a campaign
    name, text = next(((name, text) for name, text in found if text), ([], ""))
    assert text, f"no command abbe {' '.join(words)}"
    for option in (word.partition("=")[0] for word in words if re.match(r"--\w", word)):
        assert re.search(rf"(?<!\S){option}\b", text), f"{option} is not an option of abbe {' '.join(name)}"


def test_the_command_line_answers_as_the_tests_ask_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["solve", "--help"]) == 0
    assert "Usage: abbe solve" in capsys.readouterr().out


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"(?m)^([\w-]+):", (ROOT / "Makefile").read_text()))
    asked = {words[0] for name in PAGES for words in typed(name, "make") if re.fullmatch("[a-z-]+", words[0])}
    assert {"demo", "test", "docs"} <= asked
    assert asked <= targets


@pytest.mark.parametrize("name", PAGES)
def test_files_that_are_named_are_there(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    links = [unquote(link) for link in re.findall(r"\]\(([^)#\s]+)", text) if "://" not in link]
    assert [link for link in links if not ((ROOT / name).parent / link).exists()] == []
    if name in (*PAST, MUTANTS):
        return
    places = re.findall(r"(?<![\w/.-])(?:docs|deploy|service|drivers|models|simulators|tests|abbe)/[\w./-]*\w", text)
    assert [place for place in places if not (ROOT / place).exists()] == []
    modules = re.findall(r"python -m ((?:tests|abbe)\.[\w.]+\w)", text)
    assert [module for module in modules if not _module_is_there(module)] == []


def _module_is_there(module: str) -> bool:
    path = ROOT / module.replace(".", "/")
    return path.with_suffix(".py").exists() or (path / "__main__.py").exists()


@pytest.mark.parametrize("name", PAGES)
def test_a_link_leads_to_a_heading(name: str) -> None:
    for link, anchor in re.findall(r"\]\(([^)#\s]*)#([^)\s]+)\)", (ROOT / name).read_text(encoding="utf-8")):
        page = (ROOT / name).parent / link if link else ROOT / name
        heads = re.findall(r"(?m)^#+ (.+)$", page.read_text(encoding="utf-8"))
        assert anchor in {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}, f"{link}#{anchor}"


def test_the_index_leads_to_every_page() -> None:
    text = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("docs/index.md", "docs/decisions/README.md"))
    missing = [
        name for name in PAGES if name.startswith("docs/") and Path(name).name not in (*re.findall(r"([\w.-]+\.md)", text), "index.md")
    ]
    assert missing == []


def test_pictures_are_small_and_used() -> None:
    shown = set(re.findall(r"pictures/([\w-]+\.\w+)", "".join((ROOT / name).read_text(encoding="utf-8") for name in PAGES)))
    files = {p.name: p.stat().st_size for p in (ROOT / "docs" / "pictures").iterdir()}
    assert set(files) == shown
    assert max(files.values()) < 150_000


WRITTEN = [cli_page, machine_file_page, device_file_page, decisions_page, python_page]


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.PAGE.name)
def test_what_the_code_says_is_current(page: ModuleType) -> None:
    assert page.PAGE.read_text(encoding="utf-8") == page.page(), "run make docs"


def test_the_example_needs_only_addresses_for_a_first_check() -> None:
    """It has limits to be judged by, and a recipe that the README names."""
    machine = load_machine(ROOT / "deploy" / "machine.example.toml").machine
    assert machine.verify.body_diagonal_um is not None
    assert {"ballbar", "laser", "cnc", "fixture"} <= set(machine.devices.model_dump(exclude_none=True))


def test_every_reason_against_a_push_is_told() -> None:
    told = re.findall(r"^\| ([A-Z, ]+) \|", (ROOT / "docs" / "how-to" / "propose.md").read_text(encoding="utf-8"), re.MULTILINE)
    judges = ("push/validate.py", "compensation/gate.py")
    given = {word for one in judges for word in re.findall(r'"([A-Z]{3,}): ', (ROOT / "service" / one).read_text(encoding="utf-8"))}
    assert len(given) > 30
    assert given - set(", ".join(told).split(", ")) == set()
