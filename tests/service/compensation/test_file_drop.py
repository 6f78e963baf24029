"""Table files for a control without an interface: put there and read back, confirmed by the control's own files, taken back."""

from __future__ import annotations

import asyncio
import json
from datetime import UTC, datetime
from pathlib import Path

import pytest

from abbe.service.cli import run
from abbe.service.compensation import file_drop
from abbe.service.errors import FileFormatError
from tests.drivers.test_opcua_control import Plant
from tests.drivers.test_opcua_control import plant as plant
from tests.service.formats.test_choice import _document, _known

MACHINE = """
name = "mill"
chain = "w-X-b-Y-Z-t"
[stroke_mm]
X = [0, 500]
Y = [-200, 200]
Z = [-300, 0]
"""


@pytest.fixture
def share(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A control's folder with an old table in it; the exported tables are in `out`."""
    monkeypatch.chdir(tmp_path)
    Path("abbe.toml").write_text(MACHINE)
    Path("solution.json").write_text(json.dumps(_document(_known())))
    assert run(["comp", "export", "solution.json", "--format", "mach4", "--out", "out"]) == 0
    folder = tmp_path / "share"
    folder.mkdir()
    (folder / "mach4-x.csv").write_text("the old table")
    return folder


def _drop(*words: str) -> int:
    return run(["comp", "drop", "out", *words])


def test_files_are_put_there_and_read_back_and_the_old_one_is_kept(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _drop("--to", "share", "--format", "mach4") == 0
    assert "3 files lie in" in capsys.readouterr().out
    assert {f.name: f.read_bytes() for f in share.iterdir()} == {f.name: f.read_bytes() for f in Path("out").iterdir()}
    assert Path("out.dropped/before/mach4-x.csv").read_text() == "the old table"
    made = file_drop.receipt(Path("out"))
    assert (made.state, made.before["mach4-y.csv"]) == ("written", "")
    assert _drop("--to", "share", "--format", "mach4") == 2
    assert "were dropped already" in capsys.readouterr().err


def test_the_controls_own_files_confirm_it(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _drop("--to", "share", "--format", "mach4")
    back = Path("back")
    back.mkdir()
    for file in Path("out").iterdir():
        (back / file.name).write_text(file.read_text().replace("\n", "\r\n"))
    assert _drop("--back", "share") == 2
    assert "these are the dropped files" in capsys.readouterr().err
    assert _drop("--back", "back") == 0
    assert file_drop.receipt(Path("out")).state == "confirmed"


def test_other_tables_in_the_control_are_named(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _drop("--to", "share", "--format", "mach4")
    back = Path("back")
    back.mkdir()
    for file in Path("out").iterdir():
        head, rows = file.read_text().splitlines()[:5], [r.split(",") for r in file.read_text().splitlines()[5:]]
        turned = [",".join([r[0], r[1], *(f"{-float(v):.4f}" for v in r[2:])]) for r in rows]
        (back / file.name).write_text("\n".join([*head, *turned]) + "\n")
    assert _drop("--back", "back") == 2
    assert "TAB-003: the sign is wrong" in capsys.readouterr().err
    assert file_drop.receipt(Path("out")).state == "written"


def test_what_a_person_says_is_no_confirmation(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _drop("--seen") == 2
    assert "there is no receipt" in capsys.readouterr().err
    _drop("--to", "share", "--format", "mach4")
    assert _drop("--seen") == 0
    assert "not confirmed by the control's own files" in capsys.readouterr().out
    made = file_drop.receipt(Path("out"))
    assert (made.state, bool(made.seen_by)) == ("written", True)


def test_it_is_taken_back_also_after_an_interruption(
    share: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    real = file_drop.write_page

    def dies(text: str | bytes, target: Path) -> None:
        if target == Path("share/mach4-y.csv"):
            raise KeyboardInterrupt
        real(text, target)

    monkeypatch.setattr(file_drop, "write_page", dies)
    with pytest.raises(KeyboardInterrupt):
        file_drop.drop(Path("out"), file_drop.place_at("share"), machine="mill", form="mach4", now=datetime(2026, 1, 1, tzinfo=UTC))
    monkeypatch.setattr(file_drop, "write_page", real)
    assert file_drop.receipt(Path("out")).state == "writing"
    assert _drop("--back", "share") == 2  # nothing to confirm
    assert _drop("--take-back") == 0
    assert {f.name: f.read_text() for f in share.iterdir()} == {"mach4-x.csv": "the old table"}
    assert file_drop.receipt(Path("out")).state == "taken back"
    assert _drop("--to", "share", "--format", "mach4") == 0


def test_a_file_that_somebody_changed_is_left_alone(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _drop("--to", "share", "--format", "mach4")
    (share / "mach4-z.csv").write_text("a person's")
    assert _drop("--take-back") == 2
    assert "mach4-z.csv was changed since it was dropped" in capsys.readouterr().err
    assert (share / "mach4-z.csv").read_text() == "a person's"
    assert (share / "mach4-x.csv").read_text() != "the old table"


def test_one_thing_at_a_time(share: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _drop("--seen", "--take-back") == 2
    assert _drop("--to", "share") == 2
    assert _drop("--to", "nowhere", "--format", "mach4") == 2
    assert "nowhere: is not a folder" in capsys.readouterr().err


async def test_the_files_of_an_opc_ua_server_are_such_a_place(plant: Plant, tmp_path: Path) -> None:
    """Its one file object holds the table before, the dropped one, and the one before again; a server that spoils a byte is refused."""
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "x.tab").write_text("the new table")
    place = file_drop.place_at(f"{plant.url}?x.tab=ns%3D2%3Bs%3DTable")
    now = datetime(2026, 1, 1, tzinfo=UTC)
    made = await asyncio.to_thread(file_drop.drop, tmp_path / "out", place, machine="mill", form="centroid", now=now)
    assert (made.state, plant.content) == ("written", b"the new table")
    assert (await asyncio.to_thread(file_drop.take_back, tmp_path / "out")).state == "taken back"
    assert plant.content == b"old"
    plant.spoils = True
    with pytest.raises(FileFormatError, match=r"x\.tab holds other bytes than were written"):
        await asyncio.to_thread(file_drop.drop, tmp_path / "out", place, machine="mill", form="centroid", now=now)
    (tmp_path / "out" / "y.tab").write_text("a second")
    with pytest.raises(FileFormatError, match=r"names no node for y\.tab"):
        await asyncio.to_thread(place.get, "y.tab")
