"""`abbe demo` as a user runs it: it corrects the machine, cleans up after itself, and loses nothing when it is killed."""

import json
import os
import signal
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

from abbe.service.storage.store import Store
from tests import hardware
from tests.scenarios.world import interrupt, simulators_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(300)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
LOST_S = 0.100 if LONG else 0.400
"""The promise holds on a computer at rest, as in the long run. Beside other tests the writer itself may wait for a core."""


def bar_run_under_way(folder: Path, chunks: int = 1, name: str = "identify") -> str | None:
    """Label of the running ball-bar run of a campaign, once it has stored so many chunks. Reads beside the writer."""
    path = folder / "abbe.sqlite3"
    if not path.exists():
        return None
    query = """SELECT runs.label FROM runs JOIN campaigns ON campaigns.id = runs.campaign_id JOIN chunks ON chunks.run_id = runs.id
               WHERE campaigns.name = ? AND runs.status = 'running' AND chunks.channel = 'bar'
               GROUP BY runs.label HAVING COUNT(*) >= ?"""
    try:
        with closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as connection:
            row = connection.execute(query, (name, chunks)).fetchone()
    except sqlite3.OperationalError:  # tables not yet made, or locked for an instant
        return None
    return row[0] if row else None


def test_the_machine_becomes_better_and_the_archive_is_loss_free(abbe, command, tmp_path):
    """On five machines: test_five_seeds.py, in the long run."""
    folder = tmp_path / "kept"
    process = abbe("demo", "--seed", "2", "--speed", "120", "--json", "--keep", str(folder))
    for pid in wait_for(lambda: simulators_of(folder), 60, "the simulated machine"):
        hardware.first(pid)
    out, err = process.communicate(timeout=200)
    assert process.returncode == 0, err
    found = json.loads(out)
    for key in ("max_body_diagonal_um", "volumetric_rms_um", "volumetric_max_um"):
        assert found[key]["after"] < found[key]["before"] / 2
    assert found["volumetric_factor"]["share"] > 0.6
    assert found["best_nine_tables_rms_um"] < found["volumetric_rms_um"]["after"]
    assert found["kept"] is True
    assert found["measured"]["body_diagonal_um"]["u_after"] > 0
    # the measurement says what the sealed truth says, on positions that were not used to identify
    for state in ("before", "after"):
        m = found["measured"]["body_diagonal_um"]
        assert m[state] == pytest.approx(found["max_body_diagonal_um"][state], abs=6 * m[f"u_{state}"] + 2.0)
    report = (folder / "report.html").read_text()
    assert "<svg" in report
    assert "http://" not in report.replace("http://www.w3.org", "")
    assert simulators_of(folder) == []
    archive_round_trip(command, tmp_path, folder)


def archive_round_trip(command, tmp_path: Path, folder: Path) -> None:
    """Export a campaign, import it into another store, export again: the same bytes."""
    db, other = f"sqlite:///{folder / 'abbe.sqlite3'}", f"sqlite:///{tmp_path / 'other.sqlite3'}"
    for words in (["export", "identify", "a", "--db", db], ["import", "a", "--db", other], ["export", "identify", "b", "--db", other]):
        code, _, err = command(*words)
        assert code == 0, err
    first = {p.name: p.read_bytes() for p in (tmp_path / "a").iterdir()}
    second = {p.name: p.read_bytes() for p in (tmp_path / "b").iterdir()}
    assert len(first) == 22  # 21 runs, two of which only judge, and campaign.json
    assert first == second


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130)] + [(signal.SIGTERM, 143)] * LONG)
def test_stopping_the_demo_leaves_no_simulator_and_says_which_run_was_cut(abbe, tmp_path, number, code):
    folder = tmp_path / "kept"
    process = abbe("demo", "--speed", "20", "--keep", str(folder))
    wait_for(lambda: bar_run_under_way(folder), 60, "a ball-bar run of the identification")
    assert simulators_of(folder)
    _, err = interrupt(process, number)
    assert process.returncode == code, err
    assert "Traceback" not in err
    assert simulators_of(folder) == []
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        cut = [r for r in store.runs.all("identify") if r.status == "aborted"]
        assert len(cut) == 1
        assert store.chunks.of_run(cut[0].id, "bar")


def test_sigkill_loses_the_last_instant_only_and_damages_nothing_else(abbe, command, tmp_path):
    folder = tmp_path / "kept"
    process = abbe("demo", "--speed", "1", "--keep", str(folder))
    label = wait_for(lambda: bar_run_under_way(folder, chunks=20), 90, "a ball-bar run of the identification at speed 1")
    killed_at = time.monotonic()
    process.kill()
    process.communicate()
    wait_for(lambda: simulators_of(folder) == [], 5, "the simulators notice that nobody is left")
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        run = next(r for r in store.runs.all("identify") if r.label == label)
        assert run.visible_status == "incomplete"
        chunks = store.chunks.of_run(run.id, "bar")
        assert killed_at - chunks[-1].last_host_s <= LOST_S
        # 1 kHz without a gap, from the first chunk to the last
        assert chunks[-1].last_device_us - chunks[0].first_device_us == (sum(c.n for c in chunks) - 1) * 1000
    code, out, err = command("runs", "--db", f"sqlite:///{folder / 'abbe.sqlite3'}", "--json")
    assert code == 0, err
    row = next(r for r in json.loads(out) if r["run_id"] == label)
    assert row["status"] == "incomplete"


def test_a_folder_that_holds_a_demonstration_is_not_overwritten(command, tmp_path):
    (tmp_path / "kept").mkdir()
    kept = tmp_path / "kept" / "abbe.sqlite3"
    with Store.open(f"sqlite:///{kept}") as store:
        store.machines.add("precious", {"name": "precious"})
    code, _, err = command("demo", "--keep", tmp_path / "kept")
    assert code == 2
    assert len(err.strip().splitlines()) == 1
    assert "already holds a demonstration" in err
    with Store.open(f"sqlite:///{kept}") as store:
        assert [machine.name for machine in store.machines.all()] == ["precious"]
