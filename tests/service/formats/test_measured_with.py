"""Files for a control are made only of a machine that was measured without a correction in force."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.tables import TableImage, crc32, encode
from abbe.service.cli import run
from abbe.service.domain.push_entry import PushState
from abbe.service.domain.solution_file import TableInForce, distinct
from abbe.service.push.journal import GENESIS, follow
from abbe.service.storage.store import Store
from tests.service.formats.test_choice import _document, _known

ACTING = encode(TableImage(1, 5, 100, (0.0, 0.0, 0.0), (100.0, 100.0, 100.0), (2, 2, 2), tuple(range(18))))
NONE = encode(TableImage(0, 0, 100, (0.0, 0.0, 0.0), (1e-5, 1e-5, 1e-5), (0, 0, 0), ()))
Export = Callable[..., tuple[int, str]]


@pytest.fixture
def export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Export:
    def call(source: object, *more: str) -> tuple[int, str]:
        out = tmp_path / f"out{len(list(tmp_path.iterdir()))}"
        code = run(["comp", "export", str(source), "--format", "mach4", "--out", str(out), *more])
        assert out.exists() == (code == 0)
        said = capsys.readouterr()
        return code, said.out + said.err

    return call


def solution(*tables: dict[str, Any]) -> dict[str, Any]:
    return _document(_known()) | {"inputs": {"digest": "", "runs": {}, "tables": list(tables)}}


def file(folder: Path, *tables: dict[str, Any]) -> Path:
    path = folder / "solution.json"
    path.write_text(json.dumps(solution(*tables)))
    return path


def test_a_file_that_says_that_a_table_corrected_is_refused_whatever_is_said(export: Export, tmp_path: Path) -> None:
    source = file(tmp_path, {"crc": 7, "acting": False}, {"crc": 0xABCD, "acting": True})
    for more in ((), ("--without-table",)):
        code, said = export(source, *more)
        assert code == 2
        assert "while table 0000ABCD corrected the machine" in said


def test_a_file_that_says_that_nothing_corrected_needs_no_note(export: Export, tmp_path: Path) -> None:
    code, said = export(file(tmp_path, {"crc": 7, "acting": False}))
    assert code == 0
    assert "add its corrections to these tables" not in said


def test_where_nobody_knows_a_person_has_to_say_it(export: Export, tmp_path: Path) -> None:
    source = file(tmp_path, {"crc": 7, "acting": None})
    code, said = export(source)
    assert (code, "--without-table" in said) == (2, True)
    assert export(source, "--without-table")[0] == 0


def test_runs_that_name_no_table_get_the_note(export: Export, tmp_path: Path) -> None:
    code, said = export(file(tmp_path))
    assert (code, "add its corrections to these tables" in said) == (0, True)


@pytest.mark.parametrize(
    ("image", "known", "code", "words"),
    [
        (ACTING, "pushed", 2, "corrected the machine"),
        (ACTING, "in force before", 2, "corrected the machine"),
        (NONE, "in force before", 0, "wrote"),
        (NONE, "never met", 2, "not recorded whether"),
    ],
)
def test_of_older_runs_the_database_knows_what_their_table_was(
    export: Export, tmp_path: Path, image: bytes, known: str, code: int, words: str
) -> None:
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    with Store.open(url) as store:
        machine = store.machines.add("sim", {})
        campaign = store.campaigns.add(machine, "june", {})
        start = {"table": {"bank": 0, "crc": crc32(image), "gen": 1, "boot_id": 2}}
        run_id = store.runs.start(campaign, "r1", "ballbar_helix", "identify", start)
        number = store.solutions.add(campaign, "joint", [run_id], _document(_known()))  # of a version that named no tables
        if known == "pushed":
            store.tables.add(machine, None, image, crc32(image), {})
        if known == "in force before":
            other = encode(TableImage(0, 9, 100, (0.0, 0.0, 0.0), (1e-5, 1e-5, 1e-5), (0, 0, 0), ()))
            store.tables.add(machine, None, other, crc32(other), {})
            before = {"base_crc": crc32(image), "base_image": image.hex()}
            store.pushes.append(follow((), 1, PushState.SNAPSHOT, before, utc="2026-06-01T10:00:00Z", head=GENESIS, machine="sim"))
    found, said = export(number, "--db", url)
    assert (found, words in said) == (code, True), said


def test_what_one_run_knows_of_a_table_counts_for_all() -> None:
    assert distinct([{"crc": 5}, {"crc": 3, "acting": False}, {"crc": 5, "acting": True}]) == [
        TableInForce(crc=3, acting=False),
        TableInForce(crc=5, acting=True),
    ]
