"""`abbe correct` as a user runs it, on one identification: refused, killed in the middle, not better. Each time the old table is back."""

import asyncio
import json
import os
import re
import subprocess

import pytest

from service.config import load_machine
from service.site import site_of
from service.storage.store import Store
from tests.pretended import as_if_commissioned_at
from tests.scenarios.conftest import ABBE, Sims, simulated
from tests.scenarios.world import one_line, registers, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]


@pytest.fixture(scope="module")
def identified(tmp_path_factory):
    """A simulated machine and the campaigns `june` (identification) and `start` (verification), measured once for all tests here."""
    folder = tmp_path_factory.mktemp("identified")
    with simulated(folder, "--speed", "60") as sims:
        site = site_of(load_machine(sims.machine_file).machine)
        with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
            asyncio.run(as_if_commissioned_at(sims.ready["cnc"], store, site))
        for recipe, name in (("identification", "june"), ("verification", "start")):
            words = [*ABBE, "measure", str(sims.machine_file), "--recipe", recipe, "--name", name]
            subprocess.run(words, check=True, timeout=120, capture_output=True)
        yield sims


def table(sims: Sims) -> tuple[int, ...]:
    """Number of the active bank and its CRC, read by hand."""
    words = registers(sims, 208, 8)
    return words[0], *words[1 + 2 * words[0] :][:2]


def verifying(sims: Sims) -> bool:
    """A new table is active and the measurement that is to prove it has begun."""
    with Store.open(f"sqlite:///{sims.machine_file.parent / 'abbe.sqlite3'}") as store:
        entries = store.push_entries("sim")
    return bool(entries) and entries[-1].state == "PROBED" and runs_of(sims.machine_file.parent)[-1].campaign.startswith("verify-after")


def test_a_table_over_its_limit_is_refused_and_nothing_is_written(abbe, identified):
    """A real identification, a real solution, and a limit that no real machine keeps."""
    limited = identified.machine_file.with_name("limited.toml")
    limited.write_text(identified.machine_file.read_text() + "[limits]\ntable_value_um = 1\n")
    before = registers(identified, 7, 2), registers(identified, 208, 8)
    process = abbe("correct", str(limited), "june", "--before", "start")
    one_line(process, "CMP-001", "limit", "1.0 µm", "table_value_um", "othing was written")
    assert (registers(identified, 7, 2), registers(identified, 208, 8)) == before  # generation; active bank, CRC and state of both banks


def test_after_a_kill_during_the_verification_measuring_takes_the_table_back_first_and_says_so(abbe, identified):
    before = table(identified)
    process = abbe("correct", str(identified.machine_file), "june", "--before", "start")
    wait_for(lambda: verifying(identified), 90, "the verification of the new table")
    process.kill()
    process.communicate()
    assert table(identified) != before
    again = abbe("measure", str(identified.machine_file), "--helix", "300,250,100,60")
    _, err = again.communicate(timeout=60)
    assert again.returncode == 0, err
    assert re.search(r"(^|; )push \d+ was not verified .*; the old table was made active again(; |$)", err, re.MULTILINE), err
    assert table(identified) == before
    doc = runs_of(identified.machine_file.parent)[-1].start_doc
    assert doc["table"]["crc"] == before[1] << 16 | before[2]  # measured after the way back, not before


def test_commissioning_proves_what_the_control_does_with_a_correction_and_leaves_the_table(abbe, identified):
    before = table(identified)
    process = abbe("comp", "commission", str(identified.machine_file))
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert "proved: a positive correction moves its own axis in its positive sense" in out
    assert "the controller has level L3: unattended pushes" in out
    assert table(identified) == before


def test_levels_only_says_what_was_proved_and_how_and_mounts_nothing(abbe, identified):
    before = table(identified)
    process = abbe("comp", "commission", str(identified.machine_file), "--levels-only", "--json")
    out, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    doc = json.loads(out)
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
    process = abbe("correct", str(identified.machine_file), "june", "--before", "start")
    wait_for(lambda: verifying(identified), 90, "the verification of the new table")
    identified.ask("drift", axis="X", um_per_m=400.0)
    out, err = process.communicate(timeout=90)
    assert process.returncode == 1, err
    assert out.startswith("rolled back: ")
    with Store.open(f"sqlite:///{identified.machine_file.parent / 'abbe.sqlite3'}") as store:
        made = [s for s in store.solutions() if s.kind == "joint"][-1]
    assert made.doc["inputs"]["tables"] == [{"crc": before[1] << 16 | before[2], "acting": False}]
    assert not [line for line in err.splitlines() if line.startswith("error ")]
    assert table(identified) == before
