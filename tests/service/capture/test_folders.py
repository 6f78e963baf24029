"""One database has one folder of segments, however its address is written; what older folders hold of it is found, the rest untouched."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from abbe.service.capture.recorder import recording
from abbe.service.capture.recovery import recover_segments
from abbe.service.capture.settings import CaptureSettings, folder_of, other_folders, segment_folder, segment_path
from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import abandon, batch, new_run

SMALL = CaptureSettings(reserve_bytes=65536)


def addresses(folder: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The same file: absolute, relative to where the command was started, with a detour, and by a link to the folder or to the file."""
    data = folder / "data"
    data.mkdir()
    (folder / "door").symlink_to(data)
    (folder / "other.db").symlink_to(data / "abbe.sqlite3")
    monkeypatch.chdir(folder)
    return [
        f"sqlite:///{data}/abbe.sqlite3",
        "sqlite:///data/abbe.sqlite3",
        f"sqlite:///{folder}/door/../data/abbe.sqlite3",
        f"sqlite:///{folder}/door/abbe.sqlite3",
        "sqlite:///other.db",
    ]


@pytest.mark.parametrize("spool", ["", "spool"])
def test_every_address_of_a_file_leads_to_one_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spool: str) -> None:
    settings = CaptureSettings(str(tmp_path / spool) if spool else "")
    written = addresses(tmp_path, monkeypatch)
    with Store.open(written[0]):
        found = {segment_folder(url, settings).resolve() for url in written}
    assert len(found) == 1
    assert segment_folder(f"sqlite:///{tmp_path}/elsewhere.sqlite3", settings) not in found


async def crashed(store: Store, settings: CaptureSettings, label: str) -> tuple[int, Path]:
    """A run with 50 samples in its segment, whose process is gone and of which the database has nothing but its beginning."""
    run_id = new_run(store, label)
    async with recording(store, run_id, settings, SystemClock(), {"label": label}) as recorder:
        recorder.tap().take(batch(0, 50))
    recorder.release()
    abandon(store, run_id)
    return run_id, recorder.log.segment.path


async def test_what_one_address_left_is_taken_over_by_another(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = addresses(tmp_path, monkeypatch)
    with Store.open(written[0]) as store:
        await crashed(store, SMALL, "r01")
    with Store.open(written[-1]) as store:
        (told,) = recover_segments(store, SMALL)
        assert told.name == "c1/r01"
        assert store.runs.find("r01").status == "interrupted"


@pytest.mark.parametrize("spool", ["", "spool"])
async def test_an_old_folder_is_emptied_of_what_is_ours(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spool: str) -> None:
    settings = CaptureSettings(str(tmp_path / spool) if spool else "", 65536)
    url = addresses(tmp_path, monkeypatch)[-1]
    old = tmp_path / "spool" / "other-12345678" if spool else tmp_path / "other.db-capture"
    old.mkdir(parents=True)
    with Store.open(url) as store:
        run_id, path = await crashed(store, settings, "r01")
        assert path.parent == folder_of(store, settings) != old
        path.rename(segment_path(old, run_id))
        (told,) = recover_segments(store, settings)
        assert (told.run, told.name) == (run_id, "c1/r01")
        assert not segment_path(old, run_id).exists()
        assert recover_segments(store, settings) == []


async def test_segments_of_another_database_in_the_same_place_are_left_alone(tmp_path: Path) -> None:
    settings = CaptureSettings(str(tmp_path / "spool"), 65536)
    with Store.open(f"sqlite:///{tmp_path / 'one.sqlite3'}") as one, Store.open(f"sqlite:///{tmp_path / 'two.sqlite3'}") as two:
        _, path = await crashed(one, settings, "r01")
        new_run(two, "r01")  # the same number and the same name, begun at another instant
        (path.parent / "run-00000009.seg").write_bytes(b"no segment")
        before = sorted(os.listdir(path.parent))
        assert path.parent in other_folders(two.url, settings, folder_of(two, settings))
        assert recover_segments(two, settings) == []
        assert sorted(os.listdir(path.parent)) == before


def test_a_database_calls_itself_by_one_name(tmp_path: Path) -> None:
    names = []
    for file in ("one", "one", "two"):
        with Store.open(f"sqlite:///{tmp_path / file}.sqlite3") as store:
            names.append(store.database_id())
    assert names[0] == names[1] != names[2]
    assert {len(name) for name in names} == {32}


async def test_a_database_on_a_server_has_one_folder_by_every_address(postgres, tmp_path: Path) -> None:
    url = postgres()
    settings = CaptureSettings(str(tmp_path))
    folders = set()
    for written in (url, url + ("&" if "?" in url else "?") + "application_name=other"):
        with Store.open(written) as store:
            folders.add(folder_of(store, settings))
    assert len(folders) == 1
