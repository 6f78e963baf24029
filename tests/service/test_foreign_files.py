"""What others left in a folder is read only if it is a file: no pipe is waited for, no device is read, no size that is told believed."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable
from pathlib import Path

import pytest

from abbe.service.files import NotPlainError, is_plain, read_plain
from tests.service.cli.test_cli import Abbe, abbe

__all__ = ["abbe"]  # the fixture

pytestmark = [pytest.mark.usefixtures("clean_environment"), pytest.mark.timeout(60)]  # one that waits or reads for ever shall not


def sock(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as one:
        one.bind(path.name)  # relative: the path of a socket is short


ODD: dict[str, tuple[Callable[[Path], object], str]] = {
    "pipe": (os.mkfifo, "a pipe"),
    "endless device": (lambda path: path.symlink_to("/dev/zero"), "a device"),
    "terminal": (lambda path: path.symlink_to("/dev/ptmx"), "a device"),
    "socket": (sock, "a socket"),
    "folder": (os.mkdir, "a folder"),
    "pipe behind a link": (lambda path: (os.mkfifo(f"{path}.pipe"), path.symlink_to(f"{path}.pipe")), "a pipe"),
}


@pytest.mark.parametrize("name", ["campaign.json", "r01-x.json"])
@pytest.mark.parametrize("odd", ODD)
def test_no_command_reads_a_folder_s_odd_files(
    abbe: Abbe, campaign_folder: Path, monkeypatch: pytest.MonkeyPatch, odd: str, name: str
) -> None:
    path = campaign_folder / name
    path.unlink()
    make, kind = ODD[odd]
    monkeypatch.chdir(campaign_folder)
    make(path)
    monkeypatch.chdir(campaign_folder.parent)
    for command in ("import", "solve", "discover"):
        assert f"{path}: it is {kind}, expected a plain file" in abbe.fails(command, campaign_folder)
    assert not Path("abbe.sqlite3").exists()


def test_a_link_to_a_file_is_as_good_as_the_file(abbe: Abbe, campaign_folder: Path, tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere.json"
    shutil.move(campaign_folder / "r01-x.json", elsewhere)
    (campaign_folder / "r01-x.json").symlink_to(elsewhere)
    assert abbe("import", campaign_folder).code == 0


def test_a_file_in_place_of_a_folder_is_said_so(abbe: Abbe, campaign_folder: Path) -> None:
    said = abbe.fails("import", campaign_folder / "campaign.json")
    assert said.startswith("error FMT-001: campaign.json: files ")
    assert said.endswith(" can be imported, and folders with campaign.json - give one of these\n")


def test_bytes_are_counted_as_they_come(tmp_path: Path) -> None:
    """The files of /proc are plain ones, and all of them tell that they are empty."""
    told = Path("/proc/self/status")
    assert told.stat().st_size == 0
    assert read_plain(told, 1_000_000).startswith(b"Name:")
    with pytest.raises(NotPlainError, match="larger than 100 bytes"):
        read_plain(told, 100)
    exact = tmp_path / "exact"
    exact.write_bytes(b"x" * 100)
    assert read_plain(exact, 100) == b"x" * 100
    with pytest.raises(FileNotFoundError):
        read_plain(tmp_path / "none", 100)


def test_a_backup_holds_plain_files_only(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    (tmp_path / "link").symlink_to("plain")
    os.mkfifo(tmp_path / "pipe")
    assert [name for name in ("plain", "link", "pipe", ".") if is_plain(tmp_path / name)] == ["plain", "."]


@pytest.mark.parametrize("odd", ["pipe", "endless device"])
def test_no_table_is_read_from_an_odd_file(abbe: Abbe, tmp_path: Path, odd: str) -> None:
    make, kind = ODD[odd]
    make(tmp_path / "table.txt")
    assert f"it is {kind}" in abbe.fails("comp", "import", tmp_path / "table.txt", "--format", "siemens-cec")
