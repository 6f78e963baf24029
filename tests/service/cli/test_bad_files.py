"""A missing, an empty, a binary file and a JSON list, wherever a command takes a file: one line in the words of Abbe, nothing written."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from abbe.service.cli import run
from abbe.service.storage.store import Store
from tests.service.cli.test_cli import MACHINE_FILE
from tests.service.conftest import ERRORS, write_json

KINDS: dict[str, bytes | None] = {"missing": None, "empty": b"", "list": b"[1, 2]", "binary": bytes(range(256))}
CALLS = (
    "check-config -m FILE",
    "measure --recipe FILE --dry-run",
    "listen --recipe FILE",
    "plan --instruments FILE",
    "plan --artefact FILE",
    "runs -m FILE",
    "solve FILE",
    "discover FILE",
    "simulate FILE",
    "errors --errors FILE --points p.csv",
    "errors --errors errors.json --points FILE",
    "report FILE",
    "device interferometer FILE",
    "device show FILE.toml",
    "comp export FILE --format fanuc --out x",
    "comp import FILE --format linuxcnc",
    "comp push FILE",
    "comp diff FILE",
    "alarm acknowledge FILE",
    "model show FILE",
    "import FILE.csv",
    "import FILE.rtl",
    "import p.csv --columns FILE",
    "restore FILE --db sqlite:///new.sqlite3",
    "vectors FILE",
)
FOREIGN = ("Input should", "Field required", "codec can't", "unable to parse", "Errno", "Traceback", "Error(", "object has no attribute")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "abbe.toml").write_text(MACHINE_FILE, encoding="utf-8")
    (tmp_path / "p.csv").write_text("x_mm,y_mm,z_mm\n100,200,50\n", encoding="utf-8")
    write_json(tmp_path / "errors.json", ERRORS)
    Store.open("sqlite:///abbe.sqlite3").close()
    return tmp_path


EMPTY_IS_RIGHT = "plan --instruments FILE"
"""Then all instruments are as usual."""


@pytest.mark.parametrize(("call", "kind"), [(call, kind) for call in CALLS for kind in KINDS if (call, kind) != (EMPTY_IS_RIGHT, "empty")])
def test_what_is_no_such_file_is_said_in_one_line(call: str, kind: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(call.replace("FILE", kind))
    content = KINDS[kind]
    for name in words:
        if name.partition(".")[0] == kind and content is not None:
            (folder / name).write_bytes(content)
    before = set(folder.iterdir())
    code = run(words)
    out, err = capsys.readouterr()
    assert (code, out) == (2, "")
    assert err.startswith("error ")
    assert err.count("\n") == 1
    assert " - " in err or err.rstrip().endswith(")")  # what to do
    assert [word for word in FOREIGN if word in err] == []
    assert kind in err
    assert {one for one in set(folder.iterdir()) - before if ".audit-" not in one.name} == set()
