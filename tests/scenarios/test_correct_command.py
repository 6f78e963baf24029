"""`abbe correct` as a user runs it, on one identification: refused, killed in the middle, not better. Each time the old table is back.

What a killed push has left belongs to the control: it is found under another name of the machine, under another address, and from another
database, which cannot know whose table it is and says so.
"""

import asyncio
import json
import os
import re
import sqlite3
import subprocess
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest

from abbe.drivers.registry import open_controller
from abbe.service.sequences.control import Watching
from abbe.service.storage.store import Store
from tests.faults.sequencer_world import PATIENT
from tests.scenarios.conftest import ABBE, Sims, simulated
from tests.scenarios.identified import MACHINE, copy_identified
from tests.scenarios.world import axes_at_rest, position_and_counters, refused, registers, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """A simulated machine and the campaigns `june` (identification) and `start` (verification), measured once for all tests."""
    folder = tmp_path_factory.mktemp("identified")
    copy_identified(tmp_path_factory, folder)
    with simulated(folder, *MACHINE, "--speed", "60") as sims:
        yield sims


def table(sims: Sims) -> tuple[int, ...]:
    """Number of the active bank and its CRC, read by hand."""
    words = registers(sims, 208, 8)
    return words[0], *words[1 + 2 * words[0] :][:2]


def verifying(sims: Sims) -> bool:
    """A new table is active and the measurement that is to prove it has begun."""
    with Store.open(f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}") as store:
        entries = store.pushes.entries("sim")
    return bool(entries) and entries[-1].state == "PROBED" and runs_of(sims.machine_file.parent)[-1].campaign.startswith("verify-after")


def test_a_table_over_its_limit_is_refused_and_nothing_is_written(command, identified):
    """A real identification, a real solution, and a limit that no real machine keeps."""
    limited = identified.machine_file.with_name("limited.toml")
    limited.write_text(identified.machine_file.read_text() + "[limits]\ntable_value_um = 1\n")
    before = registers(identified, 7, 2), registers(identified, 208, 8)
    ended = command("correct", "-m", limited, "june", "--before", "start")
    refused(ended, "CMP-001", "limit", "1.0 µm", "table_value_um", "othing was written")
    assert (registers(identified, 7, 2), registers(identified, 208, 8)) == before  # generation; active bank, CRC and state of both banks


@dataclass
class Killed:
    """What `kill -9` of `abbe correct` has left while the new table was being verified: the control, and a copy of the database."""

    sims: Sims
    before: tuple[int, ...]
    after: tuple[int, ...]
    database: Path

    @property
    def crc(self) -> str:
        return f"{self.after[1] << 16 | self.after[2]:08X}"

    def machine(self, folder: Path, name: str, database: Path | None = None, *, host: str = "127.0.0.1", more: str = "") -> str:
        """A machine file of another name; its database is as it was left, or the given one. The unverified table is in force again."""
        if database is None:
            database = folder / "abbe.sqlite3"
            copied(self.database, database)
        text = self.sims.machine_file.read_text().replace('name = "sim"', f'name = "{name}"').replace("tcp://127.0.0.1", f"tcp://{host}", 1)
        path = folder / f"{name}.toml"
        path.write_text(f'{text}[store]\nurl = "sqlite:///{database}"\n{more}')
        asyncio.run(self._in_force_again())
        assert table(self.sims) == self.after
        return str(path)

    async def _in_force_again(self) -> None:
        controller = await open_controller(self.sims.ready["cnc"])
        try:
            now = await controller.comp_status()
            if now.active_bank != self.after[0]:
                await controller.lease(1, 5000)
                await controller.activate(self.after[0], expect_crc=int(self.crc, 16), expect_gen=now.gen, owner=1)
                await controller.release(1)
        finally:
            await controller.close()


def copied(source: Path, target: Path) -> None:
    with closing(sqlite3.connect(source)) as old, closing(sqlite3.connect(target)) as new:
        old.backup(new)


@pytest.fixture(scope="module")
def killed(identified, tmp_path_factory) -> Killed:
    before, folder = table(identified), identified.machine_file.parent
    process = subprocess.Popen(
        [*ABBE, "correct", "-m", str(identified.machine_file), "june", "--before", "start"], stderr=subprocess.DEVNULL
    )
    wait_for(lambda: verifying(identified), 90, "the verification of the new table")
    process.kill()
    process.wait()
    wait_for(lambda: axes_at_rest(identified), 60, "the end of the motion that was under way")
    left = tmp_path_factory.mktemp("left") / "abbe.sqlite3"
    copied(folder / "abbe.sqlite3", left)
    return Killed(identified, before, table(identified), left)


def done(ended: tuple[int, str, str]) -> tuple[str, str]:
    """What a command that ended well has said: stdout, stderr."""
    assert ended[0] == 0, ended[2]
    if not ended[1].startswith("{"):
        assert ended[2].splitlines()[-1].startswith("next: abbe ")
    return ended[1:]


HELIX = ("--helix", "300,250,100,60")


def test_after_a_kill_during_the_verification_measuring_takes_the_table_back_first_and_says_so(command, identified, killed):
    before = killed.before
    assert table(identified) == killed.after != before
    _, err = done(command("measure", "-m", identified.machine_file, *HELIX))
    assert re.search(r"(^|; )push \d+ was not verified .*; the old table was made active again(; |$)", err, re.MULTILINE), err
    assert table(identified) == before
    doc = runs_of(identified.machine_file.parent)[-1].start_doc
    assert doc["table"]["crc"] == before[1] << 16 | before[2]  # measured after the way back, not before


def test_another_database_says_before_it_moves_that_it_did_not_push_the_table(command, killed, tmp_path):
    """It goes on where a person vouches for the table, remembers who did, and says so in every report."""
    machine = killed.machine(tmp_path, "elsewhere", tmp_path / "other.sqlite3")
    helix = ("measure", "-m", machine, *HELIX, "--name", "h")
    still = position_and_counters(killed.sims)
    for words in (helix, ("comp", "commission", "-m", machine)):
        refused(command(*words), "CMP-002", f"a table that this database did not push (CRC {killed.crc})", "--accept-table")
    assert (position_and_counters(killed.sims), table(killed.sims)) == (still, killed.after)
    assert f"(CRC {killed.crc}) is accepted by " in done(command(*helix, "--accept-table"))[1]
    done(command("measure", "-m", machine, *HELIX, "--name", "again"))  # it is remembered
    done(command("report", "h", "--machine", machine, "--out", "r.html"))
    page = (tmp_path / "r.html").read_text()
    assert f"a table that this database did not push (CRC {killed.crc}): accepted by " in page
    assert table(killed.sims) == killed.after


def test_a_rehearsal_says_from_the_journal_what_stands_open_under_the_old_name(command, killed, tmp_path):
    _, err = done(command("measure", "-m", killed.machine(tmp_path, "mill-A"), "--dry-run"))
    assert re.search(
        r"warning: push 1 is in state PROBED: an unverified table may be in force; it is rolled back before anything else", err
    )
    assert table(killed.sims) == killed.after


def test_a_report_of_runs_on_an_unverified_table_says_so_and_does_not_pass(command, killed, tmp_path):
    machine = killed.machine(tmp_path, "mill-A")
    run = runs_of(tmp_path)[-1]
    out, _ = done(command("report", f"{run.campaign}/{run.label}", "--machine", machine, "--out", "r.csv"))
    assert f"Unverified table. Measured with the table of push 1 of machine 'sim' (CRC {killed.crc}), which was never verified" in out


def test_another_name_at_another_address_is_refused_and_told_whose_table_it_is_until_a_person_accepts_it(command, killed, tmp_path):
    machine = killed.machine(tmp_path, "mill-A", host="localhost")
    still = position_and_counters(killed.sims)
    for words in (("measure", "-m", machine, *HELIX), ("correct", "-m", machine, "june")):
        refused(command(*words), "CMP-002", f"(CRC {killed.crc}) is that of push 1 of machine 'sim'", "never verified", "accept-table")
    assert (position_and_counters(killed.sims), table(killed.sims)) == (still, killed.after)
    out, _ = done(command("accept-table", "-m", machine, "--yes", "--json"))
    assert "it is the table of push 1 of machine 'sim', which no measurement has verified" in out
    old = tmp_path / "old.toml"  # under the old name it is closed, too: an accepted table is not taken back
    old.write_text(Path(machine).read_text().replace("mill-A", "sim").replace("localhost", "127.0.0.1"))
    done(command("measure", "-m", old, *HELIX))
    assert table(killed.sims) == killed.after


SCHEDULE = """[[schedule]]
name = "daily"
recipe = "quick-check at 10 Hz"
cron = "0 3 * * *"
[web]
port = 0
[verify]
helix_rms_um = 500
body_diagonal_um = 500
"""


RENAMED = {
    "measure": (("measure", "-m", "MACHINE", *HELIX), (0,)),
    "push": (("comp", "push", "-m", "MACHINE", "1"), (1,)),
}
if os.environ.get("ABBE_TEST_LONG"):
    RENAMED |= {
        "serve": (("serve", "-m", "MACHINE", "--once"), (0,)),
        "quick-check": (("measure", "-m", "MACHINE", "--recipe", "quick-check"), (0,)),
        "correct": (("correct", "-m", "MACHINE", "june"), (2,)),  # the new name's control was never commissioned
        "propose": (("comp", "propose", "-m", "MACHINE", "june"), (2,)),  # the campaign is the old name's
        "commission": (("comp", "commission", "-m", "MACHINE", "--levels-only"), (0, 1)),  # last: it writes into the bank at rest
    }
"""Commands that open the controller, and how they may end. All go through one helper (tests/service/devices/test_every_session.py), so
every run plays two of them."""


@pytest.fixture
def patient(monkeypatch):
    """A simulated controller that waits for a core is not silent. How long a real one may be: tests/faults/test_interlocks.py."""
    monkeypatch.setattr("abbe.service.site.Watching", partial(Watching, unknown_s=PATIENT.unknown_s))


@pytest.mark.usefixtures("patient")
@pytest.mark.parametrize(("words", "codes"), RENAMED.values(), ids=RENAMED)
def test_a_machine_that_was_renamed_takes_the_table_back_first_with_every_command(command, killed, tmp_path, words, codes):
    machine = killed.machine(tmp_path, "mill-A", more=SCHEDULE)
    code, out, err = command(*(machine if word == "MACHINE" else word for word in words))
    assert code in codes, f"exit code {code}\nstdout:\n{out}\nstderr:\n{err}"
    assert table(killed.sims) == killed.before
    if words[0] != "serve":
        assert "push 1 was not verified (interrupted before it was verified); the old table was made active again" in err
    with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
        assert store.pushes.entries("sim")[-1].state == "ROLLED_BACK"
        later = [r for r in store.runs.all() if store.machines.get(store.campaigns.find(r.campaign).machine_id).name == "mill-A"]
    assert bool(later) == (words[0] in ("measure", "serve"))
    assert all(r.start_doc["table"]["crc"] == killed.before[1] << 16 | killed.before[2] for r in later)


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="as tests/faults/test_commission.py does: ABBE_TEST_LONG=1 runs it")
def test_commissioning_proves_what_the_control_does_with_a_correction_and_leaves_the_table(command, identified):
    before = table(identified)
    out, _ = done(command("comp", "commission", "-m", identified.machine_file))
    assert "proved: a positive correction moves its own axis in its positive sense" in out
    assert "the controller has level L3: unattended pushes" in out
    assert table(identified) == before


def test_levels_only_says_what_was_proved_and_how_and_mounts_nothing(command, identified):
    before = table(identified)
    doc = json.loads(done(command("comp", "commission", "-m", identified.machine_file, "--levels-only", "--json"))[0])
    assert doc["levels"]["level"] == 3
    assert all(flag["proved"] and flag["how"] for flag in doc["levels"]["flags"].values())
    assert set(doc["levels"]["flags"]) == {"two_banks", "swap_compares", "generation", "boot_id", "interlocks", "lease"}
    assert doc["levels"]["not_shown"]
    assert "step_um" not in doc
    assert table(identified) == before


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="a whole correction beside that of test_worse: ABBE_TEST_LONG=1 runs it")
def test_a_correction_that_makes_nothing_better_goes_back_and_ends_with_1(abbe, identified):
    """The machine itself changes while the new table is being verified: last in this file, because it stays so."""
    before = table(identified)
    process = abbe("correct", "-m", str(identified.machine_file), "june", "--before", "start")
    wait_for(lambda: verifying(identified), 90, "the verification of the new table")
    identified.ask("drift", axis="X", um_per_m=400.0)
    out, err = process.communicate(timeout=90)
    assert process.returncode == 1, err
    assert out.startswith("rolled back: ")
    with Store.open(f"sqlite:///{identified.machine_file.parent / 'abbe.sqlite3'}") as store:
        made = [s for s in store.solutions.all() if s.kind == "joint"][-1]
    assert made.doc["inputs"]["tables"] == [{"crc": before[1] << 16 | before[2], "acting": False}]
    assert not [line for line in err.splitlines() if line.startswith("error ")]
    assert table(identified) == before
