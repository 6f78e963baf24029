"""`abbe comp commission` with somebody at the console: an e-stop leaves a test table active; the command waits and takes it back."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.service.storage.store import Store
from tests.patience import within
from tests.scenarios.conftest import ABBE, Sims
from tests.scenarios.test_correct_command import table
from tests.scenarios.world import wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


class AtTheConsole:
    """A command whose standard input is a terminal; what it says goes into files, to be read while it runs."""

    def __init__(self, folder: Path, *words: str) -> None:
        self._folder = folder
        self._master, slave = pty.openpty()
        with (folder / "out").open("w") as out, (folder / "err").open("w") as err:
            self.process = subprocess.Popen([*ABBE, *words], cwd=folder, stdin=slave, stdout=out, stderr=err)
        os.close(slave)

    def said(self, where: str) -> str:
        return (self._folder / where).read_text()

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        os.close(self._master)


@pytest.fixture
def stopped(start_sims, tmp_path) -> Iterator[tuple[AtTheConsole, Sims]]:
    """A commissioning that an e-stop has ended while a test table is active: the command waits."""
    sims = start_sims("--speed", "60")
    command = AtTheConsole(tmp_path, "comp", "commission", "-m", str(sims.machine_file))
    try:
        wait_for(lambda: last_state(tmp_path) == "PROBATION", 90, "a test table in force")
        sims.ask("estop", on=True)
        wait_for(lambda: "AN UNVERIFIED TABLE IS ACTIVE" in command.said("err"), 30, "the command says so")
        yield command, sims
    finally:
        command.close()


def last_state(folder: Path) -> str:
    database = folder / "abbe.sqlite3"
    if not database.exists():
        return ""
    with Store.open(f"sqlite:///{database}") as store:
        entries = store.pushes.entries("sim")
    return entries[-1].state if entries else ""


def test_the_command_waits_for_the_machine_and_takes_the_table_back(stopped, tmp_path):
    command, sims = stopped
    active = table(sims)
    assert last_state(tmp_path) == "ROLLBACK_PENDING"
    assert "STILL ACTIVE" in command.said("err")
    sims.ask("estop", on=False)  # released, but nobody has reset the alarm yet
    wait_for(lambda: "the controller has an alarm" in command.said("err"), 10, "what is waited for now")
    assert table(sims) == active
    sims.ask("reset")
    assert command.process.wait(timeout=within(10)) == 1
    assert "rolled back: push" in command.said("err")
    assert "the old table was made active again" in command.said("err")
    assert (last_state(tmp_path), table(sims) == active) == ("ROLLED_BACK", False)


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="another start of everything: ABBE_TEST_LONG=1 runs it")
def test_ctrl_c_ends_the_waiting_and_the_table_waits_for_the_next_command(stopped, tmp_path):
    command, _ = stopped
    command.process.send_signal(signal.SIGINT)
    assert command.process.wait(timeout=within(10)) == 130
    assert "STILL ACTIVE; the next abbe command rolls it back" in command.said("err")
    assert last_state(tmp_path) == "ROLLBACK_PENDING"
