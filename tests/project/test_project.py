"""Promises of the project about itself: names, locks, walls between packages, file sizes, start-up time."""

from __future__ import annotations

import importlib.metadata
import importlib.util
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from setuptools.discovery import PEP420PackageFinder

from abbe.service.audit.book import AuditBook, files_of, sqlite_base
from abbe.service.backup.restore import SQLITE_SUFFIXES
from abbe.service.capture.settings import CaptureSettings, segment_folder
from abbe.service.domain.service_records import AuditEvent
from abbe.service.storage.engine import known_revisions
from abbe.service.storage.store import Store
from tests.conftest import LONG

ROOT = Path(__file__).resolve().parents[2]
PARTS = ("service", "drivers", "models", "simulators")
"""Of the package ``abbe``, and folders of the repository."""
LOCKS = ("requirements.lock", "requirements-dev.lock", "requirements-bench.lock")
SOURCES = sorted(p for part in PARTS for p in (ROOT / part).rglob("*.py"))

# In two parts, so that this file does not itself hold what it forbids.
HOSTS = [
    ("pypi", "org"),
    ("python" + "hosted", "org"),
    ("npmjs", "org"),
    ("npmjs", "com"),
    ("yarnpkg", "com"),
    ("crates", "io"),
    ("golang", "org"),
    ("debian", "org"),
    ("anaconda", "org"),
    ("docker", "io"),
    ("ghcr", "io"),
    ("quay", "io"),
    ("jsdelivr", "net"),
    ("unpkg", "com"),
    ("cdnjs", "cloudflare"),
    ("googleapis", "com"),
]
ADDRESS = re.compile("|".join(rf"\b{name}\.{end}\b" for name, end in HOSTS) + r"|--(?:extra-)?index-url|--find-(?:links)", re.IGNORECASE)
MACHINE_PATH = re.compile(r"(?<![\w.~$}])/(?:work|home|root|Users|mnt|media)/\w|\b[A-Z]:\\Users\\")
ONE_OF_THEM = (
    "-url",
    "find-link",
    ":\\users",
    *(name for name, _ in HOSTS),
    *(f"/{one}/" for one in ["work", "home", "root", "users", "mnt", "media"]),
)
"""Without any of these words in it, in small letters, a file cannot hold what the two expressions look for."""


def tracked_files() -> list[Path]:
    listing = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=True, text=True).stdout
    return [ROOT / name for name in listing.split("\0") if name]


def tool(name: str) -> str:
    return str(Path(sys.executable).parent / name)


def test_no_file_keeps_the_marks_of_a_merge() -> None:
    marks = re.compile(rb"^(<{7}|>{7}) ", re.MULTILINE)
    assert [str(path) for path in tracked_files() if path.is_file() and marks.search(path.read_bytes())] == []


def test_what_lies_beside_a_database_is_not_committed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """README lets Abbe work in the clone: a `git add .` must not take the key of the audit along. The names are those that are made."""
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git repository")
    monkeypatch.delenv("ABBE_AUDIT_FOLDER", raising=False)
    names = set()
    for stem in ("abbe", "my shop"):
        file = tmp_path / f"{stem}.sqlite3"
        key, heads = files_of(sqlite_base(file))
        beside = [Path(f"{file}{ending}") for ending in (*SQLITE_SUFFIXES, *(f".before-{revision}" for revision in known_revisions()))]
        names |= {one.name for one in (*beside, key, heads)} | {f"{segment_folder(f'sqlite:///{file}', CaptureSettings()).name}/run-1"}
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        AuditBook(store, f"sqlite:///{tmp_path / 'abbe.sqlite3'}").write(AuditEvent(who="a", action="b", target="c", outcome="done"))
        names |= {one.name for one in tmp_path.iterdir()}
    assert len(names) > 12
    done = subprocess.run(["git", "check-ignore", "--no-index", *names], cwd=ROOT, capture_output=True, text=True, check=False)
    assert names - set(done.stdout.replace('"', "").splitlines()) == set()


def test_one_place_says_how_a_python_is_started() -> None:
    """All others would have to remember that a child must not look for modules in the working directory."""
    starts = {p.relative_to(ROOT).as_posix() for p in SOURCES if "sys.executable" in p.read_text()}
    assert starts == {"service/children.py"}


def test_one_package_is_installed_and_its_parts_are_links_to_the_folders() -> None:
    assert [name for name, whose in importlib.metadata.packages_distributions().items() if "abbe" in whose] == ["abbe"]
    links = {path.name: path.readlink().as_posix() for path in (ROOT / "abbe").iterdir() if path.is_symlink()}
    assert links == {part: f"../{part}" for part in PARTS}
    spec = importlib.util.find_spec("abbe")
    assert spec is not None
    assert spec.origin == str(ROOT / "abbe" / "__init__.py")


def test_folders_that_the_demonstration_leaves_are_not_packages(tmp_path: Path) -> None:
    include = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]["packages"]["find"]["include"]
    for name in ("abbe/service", "abbe-demo", "abbe_notes", "service"):
        (tmp_path / name).mkdir(parents=True)
    assert sorted(PEP420PackageFinder.find(str(tmp_path), include=include)) == ["abbe", "abbe.service"]


def test_nothing_is_imported_but_through_abbe() -> None:
    """A module imported both as ``models.x`` and as ``abbe.models.x`` would be two, with classes of its own each."""
    bare = re.compile(rf"^\s*(?:from|import) (?:{'|'.join(PARTS)})\b", re.MULTILINE)
    assert [p for p in (*SOURCES, *(ROOT / "tests").rglob("*.py")) if bare.search(p.read_text())] == []


@pytest.mark.parametrize("name", [*LOCKS, "requirements-release.lock", "requirements-site.lock"])
def test_lock_file_pins_by_hash_and_names_no_address(name: str) -> None:
    text = (ROOT / name).read_text()
    assert "://" not in text
    assert not ADDRESS.search(text)
    requirements = re.split(r"\n(?=\S)", text.strip().replace("\\\n", " "))
    assert len(requirements) > 20
    for requirement in requirements:
        assert re.match(r"[A-Za-z0-9._\[\],-]+==\S+( ; [^#]+?)?\s+--hash=sha256:[0-9a-f]{64}", requirement), requirement[:80]


def test_the_developers_lock_holds_the_users_lock() -> None:
    user, developer, bench = (set(re.findall(r"^\S+==\S+", (ROOT / name).read_text(), re.MULTILINE)) for name in LOCKS)
    assert user <= developer
    assert user <= bench


def test_the_repository_names_no_machine_and_no_registry() -> None:
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        pytest.skip("not a git repository")
    found = []
    for path in tracked_files():
        if not path.is_file():
            continue
        text = path.read_bytes().decode(errors="replace")
        small = text.lower()
        if not any(word in small for word in ONE_OF_THEM):
            continue
        for match in (*ADDRESS.finditer(text), *MACHINE_PATH.finditer(text)):
            found.append(f"{path.relative_to(ROOT)}:{text.count(chr(10), 0, match.start()) + 1}: {match.group()}")
    assert found == []


def test_import_contracts_hold() -> None:
    done = subprocess.run([tool("lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_no_source_file_is_longer_than_600_lines() -> None:
    assert len(SOURCES) > 20
    long = {str(p.relative_to(ROOT)): n for p in SOURCES if (n := len(p.read_text().splitlines())) > 600}
    assert long == {}


HEAVY = {"numpy", "scipy", "sqlalchemy", "alembic", "fastapi", "pymodbus", "serial", "aiomqtt", "structlog"}
STARTS = {"--help": HEAVY | {"pydantic"}, "version": HEAVY, "device list": HEAVY, "effects backlash": HEAVY - {"numpy", "scipy"}}
"""What a command must not import."""
OPENED = HEAVY - {"sqlalchemy"} | {"rich"}
LISTS = ("runs", "user list", "audit show", "trend", "fleet", "alarm list", "model list")
OPENS = (
    dict.fromkeys(LISTS, OPENED)
    | dict.fromkeys(("show x", "comp show", "backup copy"), OPENED - {"numpy"})
    | {"model show": OPENED - {"numpy", "scipy"}}
    | {"check-config": {"fastapi", "alembic", "aiomqtt", "structlog", "rich"}}
)
"""The same of commands that only read; a list needs no arrays, but a trend of stored checks needs them and `scipy.special`."""
EVERY = 1 if LONG else 3
"""Each of these is a Python of its own: in every run a third of them."""
MACHINE = 'name = "m"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 500]\nY = [0, 400]\nZ = [-300, 0]\n'
SOLVING = {"abbe.service.identification.solve", "abbe.service.discovery.discover", "scipy.linalg", "scipy.optimize", "scipy.stats"}
"""What only computing commands import."""


def modules(*words: str, folder: Path = ROOT, fails: bool = False) -> set[str]:
    """What a Python imports in whole, as `-X importtime` says; ``fails``: the command may end with an error."""
    run = subprocess.run([sys.executable, "-X", "importtime", *words], cwd=folder, check=not fails, capture_output=True, text=True)
    return {line.rpartition("|")[2].strip() for line in run.stderr.splitlines() if line.startswith("import time:")}


@pytest.mark.parametrize("words", STARTS)
def test_a_command_that_computes_nothing_comes_at_once(words: str) -> None:
    """What costs time at the start are the large libraries. Seconds would be those of a loaded computer."""
    loaded = {name.partition(".")[0] for name in modules(tool("abbe"), *words.split())}
    assert "typer" in loaded
    assert not loaded & STARTS[words]


@pytest.mark.parametrize("words", list(OPENS)[::EVERY])
def test_a_command_that_only_reads_the_database_comes_soon(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ABBE_DB", raising=False)
    (tmp_path / "abbe.toml").write_text(MACHINE)
    Store.open(f"sqlite:///{tmp_path}/abbe.sqlite3").close()
    loaded = modules(tool("abbe"), *words.split(), folder=tmp_path, fails=True)
    assert "abbe.service.config" in loaded
    assert not {name.partition(".")[0] for name in loaded} & OPENS[words]
    assert not loaded & SOLVING


READS_NO_DATABASE = {"numpy", "scipy", "sqlalchemy", "pymodbus", "fastapi"}
REFUSES = (
    dict.fromkeys(
        ("serve -m none.toml", "check-config -m none.toml", "plan --out none/x.toml", "errors --errors none --points none"),
        READS_NO_DATABASE,
    )
    | dict.fromkeys(
        ("solve none", "discover none", "simulate none", "report none", "export none x", "comp show 99"), READS_NO_DATABASE - {"sqlalchemy"}
    )
    | dict.fromkeys(
        ("comp propose none", "comp export 99 --format linuxcnc --out x", "accept-table", "backup x"), READS_NO_DATABASE - {"sqlalchemy"}
    )
    | {"correct june": {"pymodbus", "abbe.models.solvers", "abbe.service.identification"}}
)
"""What a command must not import for an input that it refuses. Those of the last two lines write the refusal into the audit."""


@pytest.mark.parametrize("words", list(REFUSES)[::EVERY])
def test_a_refused_input_loads_nothing_of_the_work(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ABBE_DB", raising=False)
    (tmp_path / "abbe.toml").write_text(MACHINE)
    (tmp_path / "x").mkdir()
    Store.open(f"sqlite:///{tmp_path}/abbe.sqlite3").close()
    loaded = modules(tool("abbe"), *words.split(), folder=tmp_path, fails=True)
    assert "typer" in loaded
    assert not loaded & REFUSES[words]


def test_an_idle_service_holds_no_library_of_mathematics() -> None:
    """Core and page import parts of scipy when they compute: 16 MB less in each."""
    loaded = modules("-c", "import abbe.service.serve, abbe.service.web.app")
    assert "abbe.service.web.app" in loaded
    assert not {"scipy.linalg", "scipy.optimize", "scipy.sparse", "scipy.spatial", "scipy.special", "scipy.stats"} & loaded


def test_an_idle_core_holds_nothing_that_answers_alarms() -> None:
    """What solves, searches, proposes and draws comes with the first campaign: 5 MB less."""
    loaded = modules("-c", "import abbe.service.serve")
    assert "abbe.service.core.orders" in loaded
    seldom = {"abbe.service.jobs.investigate", "abbe.service.jobs.guided_campaign", "abbe.service.discovery.discover"}
    solving = {"abbe.service.identification.solve", "abbe.service.compensation.push_approved", "abbe.models.solvers.joint"}
    solving.add("abbe.models.uncertainty.monte_carlo")
    assert not {*seldom, *solving, "abbe.models.effects.catalogue", "abbe.service.report.report"} & loaded


def test_every_row_of_what_you_own_names_a_test_that_exists() -> None:
    lines = (ROOT / "docs" / "how-to" / "what-you-own.md").read_text(encoding="utf-8").splitlines()
    rows = [line for line in lines if line.startswith("| ") and not line.startswith("| you own")]
    named = [re.search(r"`(tests/[\w/]+\.py)` \|$", row) for row in rows]
    assert len(rows) > 15
    assert [row for row, found in zip(rows, named, strict=True) if found is None or not (ROOT / found.group(1)).is_file()] == []
