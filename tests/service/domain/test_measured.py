"""Whether a process is gone, also where /proc hides it: only a process that certainly does not run is."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.service.domain import measured
from abbe.service.domain.measured import UNKNOWN, Owner, process_start, this_process


@pytest.fixture
def hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """As under ProtectProc=invisible: what belongs to other accounts is not there."""
    honest = Path.read_text

    def read_text(path: Path, *args: str | None, **words: str | None) -> str:
        if path.parts[:2] == ("/", "proc") and path.name == "stat":
            raise FileNotFoundError(2, "No such file or directory", str(path))
        return honest(path, *args, **words)

    monkeypatch.setattr(Path, "read_text", read_text)


def _child() -> subprocess.Popen[bytes]:
    return subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE)


def test_a_live_process_that_is_hidden_is_not_gone_and_a_dead_one_is(hidden: None) -> None:
    child = _child()
    written = replace(this_process(), pid=child.pid, start="some-boot/4711")
    assert process_start(child.pid) == UNKNOWN
    assert not written.is_gone()
    child.communicate(b"\n")
    assert process_start(child.pid) == ""
    assert written.is_gone()


def test_a_process_of_another_account_that_is_hidden_is_not_gone(hidden: None, monkeypatch: pytest.MonkeyPatch) -> None:
    def not_yours(pid: int, number: int) -> None:
        assert number == 0
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "kill", not_yours)
    assert not replace(this_process(), pid=4711, start="some-boot/1").is_gone()


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can run a process as somebody else")
def test_the_kernel_s_own_answer_to_another_account() -> None:
    """The first process is root's: who may not signal it still learns that it lives."""
    words = "import os; from abbe.service.domain.measured import _without_proc; os.setuid(65534); print(repr(_without_proc(1)))"
    assert subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True).stdout.strip() == repr(UNKNOWN)


def test_a_killed_process_that_nobody_has_collected_is_gone() -> None:
    child = _child()
    written = Owner(this_process().host, child.pid, process_start(child.pid))
    assert not written.is_gone()
    child.kill()
    os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and is a zombie
    assert written.is_gone()
    child.communicate()


def test_windows_is_not_asked_by_a_signal_that_would_kill(hidden: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measured.os, "name", "nt")
    assert measured._without_proc(os.getpid()) == UNKNOWN
