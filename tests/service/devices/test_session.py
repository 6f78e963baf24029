"""The lock of a machine between real processes, also of two accounts, with nothing to see of each other but the lock's folder."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from contextlib import AbstractContextManager
from pathlib import Path

import pytest

from abbe.service.devices import session as module
from abbe.service.devices.session import lock_folder, lock_machine
from abbe.service.errors import MachineInUse, UnsafeToMove
from tests.patience import within

URL = "modbus+tcp://127.0.0.1:1"
NOBODY = 65534
HOLDER = """
import os, sys
from abbe.service.devices.session import lock_machine
uid, gid, url = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
if uid:  # after the imports: what this account may read of the installation is not what is tried here
    os.setgroups([gid] if gid else [])
    os.setgid(uid)
    os.setuid(uid)
os.umask(0o077)
try:
    with lock_machine(url):
        print("has it", os.getuid(), flush=True)
        sys.stdin.readline()
except Exception as error:
    print(type(error).__name__, error, getattr(error, "remedy", ""), flush=True)
"""
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can run a process as somebody else")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that other accounts can get at: pytest's own are closed to them."""
    for parent in (tmp_path, *(p for p in tmp_path.parents[:3] if p.name.startswith(("pytest-", "popen-")))):
        parent.chmod(parent.stat().st_mode | 0o011)
    made = tmp_path / "locks"
    made.mkdir()
    monkeypatch.setenv(module.ENVIRONMENT, str(made))
    return made


def _started(uid: int = 0, gid: int = 0) -> subprocess.Popen[str]:
    words = [sys.executable, "-c", HOLDER, str(uid), str(gid), URL]
    return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _said(child: subprocess.Popen[str]) -> str:
    assert child.stdout is not None
    return child.stdout.readline().strip()


def _holder(uid: int = 0, gid: int = 0) -> tuple[subprocess.Popen[str], str]:
    child = _started(uid, gid)
    return child, _said(child)


def _over(child: subprocess.Popen[str]) -> None:
    child.communicate("\n", timeout=20)


@as_root
def test_two_accounts_are_kept_apart_by_a_folder_for_their_group(folder: Path) -> None:
    """As deploy/abbe-tmpfiles.conf makes it: root's, for a group, closed to others."""
    group = 54321
    os.chown(folder, 0, group)
    folder.chmod(0o3770)
    theirs, said = _holder(NOBODY, group)
    assert said == f"has it {NOBODY}"
    with pytest.raises(MachineInUse, match=rf"in use by process {theirs.pid} \(-c"), lock_machine(URL):
        pass
    with lock_machine("modbus+tcp://127.0.0.1:2"):  # another machine is free
        pass
    _over(theirs)
    (lock,) = [file for file in folder.iterdir() if file.stat().st_uid == NOBODY]
    thief = [sys.executable, "-c", "import os, sys; os.setgroups([54321]); os.setuid(65533); os.unlink(sys.argv[1])", str(lock)]
    assert b"PermissionError" in subprocess.run(thief, check=False, capture_output=True).stderr  # also who is in the group
    assert (lock.stat().st_gid, oct(lock.stat().st_mode & 0o777)) == (group, "0o660")
    with lock_machine(URL):
        mine, said = _holder(NOBODY - 1, group)
        assert said.startswith(f"MachineInUse the machine at {URL} is in use by process {os.getpid()} ")
        _over(mine)
    stranger, said = _holder(NOBODY)
    assert said.startswith(f"UnsafeToMove it is unknown whether the machine at {URL} is in use: {folder}/")
    assert "(Permission denied) " in said
    assert f"{folder} is for a group: become a member of it" in said
    _over(stranger)


@as_root
def test_without_an_installation_too(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(module.ENVIRONMENT)
    monkeypatch.setattr(module, "INSTALLED", folder / "none")
    monkeypatch.setattr(module, "WITHOUT_INSTALLATION", folder / "open")
    with lock_machine(URL):
        monkeypatch.setenv(module.ENVIRONMENT, str(folder / "open"))  # for the child, which knows the usual places only
        other, said = _holder(NOBODY)
        assert said.startswith("MachineInUse")
        _over(other)
    other, said = _holder(NOBODY)
    assert said == f"has it {NOBODY}"
    with pytest.raises(MachineInUse), lock_machine(URL):
        pass
    _over(other)


def test_a_killed_process_gives_it_back_and_a_removed_file_keeps_nobody_out_or_in(folder: Path) -> None:
    child, said = _holder()
    assert said.startswith("has it")
    child.kill()
    child.communicate(timeout=within(20))
    with lock_machine(URL):
        (lock,) = folder.iterdir()
    lock.unlink()
    with lock_machine(URL):
        again: AbstractContextManager[None] = lock_machine(URL)
        with pytest.raises(MachineInUse):
            again.__enter__()
        assert [file.name for file in folder.iterdir()] == [lock.name]


def test_a_folder_that_is_not_there_is_told(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(module.ENVIRONMENT, str(folder / "none"))
    with pytest.raises(UnsafeToMove, match=r"none/\w+\.lock cannot be used \(No such file") as told, lock_machine(URL):
        pass
    assert type(told.value) is UnsafeToMove  # nobody has it: waiting would not help
    monkeypatch.delenv(module.ENVIRONMENT)
    monkeypatch.setattr(module, "INSTALLED", folder)
    assert lock_folder() == folder
    monkeypatch.setattr(module, "INSTALLED", folder / "none")
    (folder / "file").touch()
    monkeypatch.setattr(module, "WITHOUT_INSTALLATION", folder / "file")
    with pytest.raises(UnsafeToMove, match="is not a folder"):
        lock_folder()


def test_of_four_at_once_one_has_it(folder: Path) -> None:
    """Every one of them makes the file, or finds it whole."""
    racers = [_started() for _ in range(4)]
    said = [_said(racer) for racer in racers]
    assert sum(line.startswith("has it") for line in said) == 1, said
    assert all(line.startswith(("has it", "MachineInUse")) for line in said)
    for racer in racers:
        _over(racer)


def _without(monkeypatch: pytest.MonkeyPatch, folder: Path) -> Path:
    monkeypatch.delenv(module.ENVIRONMENT)
    monkeypatch.setattr(module, "INSTALLED", folder / "none")
    monkeypatch.setattr(module, "WITHOUT_INSTALLATION", folder / "open")
    return folder / "open"


def test_a_folder_for_all_accounts_has_to_keep_them_from_each_others_files(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shared = _without(monkeypatch, folder)
    shared.mkdir(0o700)
    assert lock_folder() == shared  # it is ours: put right
    assert shared.stat().st_mode & 0o7777 == 0o1777
    shared.chmod(0o777)
    monkeypatch.setattr(os, "geteuid", lambda: shared.stat().st_uid + 1)
    with (
        pytest.raises(UnsafeToMove, match="open has the mode 777: with it, other accounts cannot make a lock, or can remove one") as told,
        lock_machine(URL),
    ):
        pass
    assert told.value.remedy == f"as its owner or root, run: chmod 1777 {shared}"
    shared.chmod(0o1777)
    with lock_machine(URL):
        pass


def _full(*_: object) -> int:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_and_what_is_no_file_are_told_in_a_line(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with lock_machine(URL):
        (lock,) = folder.iterdir()
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", _full)
        with lock_machine(URL), pytest.raises(MachineInUse, match="by another process"), lock_machine(URL):
            pass  # nobody hears the holder's name, and it is held
    lock.unlink()
    os.mkfifo(lock)
    with pytest.raises(UnsafeToMove, match="it is not a plain file"), lock_machine(URL):
        pass
    lock.unlink()
    lock.symlink_to(folder / "elsewhere")
    with pytest.raises(UnsafeToMove, match="symbolic links"), lock_machine(URL):
        pass
    assert not (folder / "elsewhere").exists()
    _without(monkeypatch, folder)
    monkeypatch.setattr(Path, "mkdir", _full)
    with pytest.raises(UnsafeToMove, match=r"open cannot be used \(No space left"), lock_machine(URL):
        pass
