"""Whole measurements whose process is killed or whose disk hangs: the machine stops, and what was measured is there."""

import json
import os
import signal
import threading
from pathlib import Path

import pytest

from abbe.drivers.ballbar import driver
from abbe.drivers.errors import Backpressure
from abbe.service.campaigns.measure import measure
from abbe.service.capture.recovery import ledger_of
from abbe.service.capture.segment import RealFileIO
from abbe.service.cli import run
from abbe.service.config import load_machine
from abbe.service.devices.session import open_session
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from tests.patience import within
from tests.scenarios.world import axes_at_rest, bar_chunks, interrupt, runs_of, wait_for

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(120)]
HELIX = ("--helix", "300,250,100,150")


@pytest.mark.skipif(not os.environ.get("ABBE_TEST_LONG"), reason="beside tests/faults/test_killed_measuring.py: ABBE_TEST_LONG=1 runs it")
def test_a_killed_measurement_is_taken_over_by_the_next_command(abbe, start_sims):
    sims = start_sims("--speed", "20")
    folder = sims.machine_file.parent
    process = abbe("measure", "-m", str(sims.machine_file), *HELIX)
    wait_for(lambda: bar_chunks(folder) > 20, 60, "samples of the helix")
    process.kill()
    process.communicate()
    (segment,) = (folder / "abbe.sqlite3-capture").glob("*.seg")
    (run,) = runs_of(folder)
    assert (run.visible_status, run.end_doc) == ("incomplete", None)
    known = bar_chunks(folder)
    again = abbe("measure", "-m", str(sims.machine_file), *HELIX, "--name", "again")
    wait_for(lambda: runs_of(folder)[0].status != "running", 60, "the recovery")
    _, err = interrupt(again, signal.SIGINT)
    assert f"run {run.campaign}/{run.label}: interrupted" in err
    recovered = runs_of(folder)[0]
    assert recovered.status == "interrupted"
    assert recovered.end_doc["capture"]["unaccounted"] == 0
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        chunks = store.chunks.of_run(run.id)
    assert len([one for one in chunks if one.channel == "bar"]) >= known
    ledger = ledger_of(chunks)
    assert (ledger.unaccounted(), ledger.duplicates()) == ([], 0)
    assert ledger.stored > 20
    assert not segment.exists()


def test_a_whole_measurement_accounts_for_every_sample_of_the_box(start_sims, capsys):
    sims = start_sims("--speed", "20")
    code = run(["measure", "-m", str(sims.machine_file), "--helix", "300,250,100,50", "--rate-hz", "1000"])
    assert code == 0, capsys.readouterr().err
    fates = sims.ask("ledger")["fates"]
    folder = sims.machine_file.parent
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        (record,) = store.runs.all()
        ledger = ledger_of(store.chunks.of_run(record.id))
    assert {stream for stream, *_ in fates} == {0}
    lost = {seq for _, first, last, fate in fates if fate != "sent" for seq in range(first, last + 1)}
    assert {seq for gap in ledger.gaps for seq in range(gap.first, gap.last + 1)} == lost
    assert ledger.unaccounted() == []
    assert ledger.stored + len(lost) == max(last for _, _, last, _ in fates) + 1 > 1000
    assert record.end_doc["capture"]["stored_valid"] + record.end_doc["capture"]["stored_flagged"] == ledger.stored
    assert list((folder / "abbe.sqlite3-capture").iterdir()) == [folder / "abbe.sqlite3-capture" / "reserve"]


class HangingDisk(RealFileIO):
    """A disk that stops answering in the middle of the run."""

    def __init__(self) -> None:
        self.hang, self.again = threading.Event(), threading.Event()
        self.syncs = 0

    def sync(self, handle: int) -> None:
        self.syncs += 1
        if self.hang.is_set():
            self.again.wait(within(60.0))
        super().sync(handle)


async def test_a_hanging_disk_stops_the_axes_before_a_sample_is_lost(start_sims, monkeypatch):
    disk = HangingDisk()
    monkeypatch.setattr("abbe.service.capture.recorder.RealFileIO", lambda: disk)
    monkeypatch.setattr("abbe.service.capture.recorder.MAX_PENDING", 200)
    monkeypatch.setattr(driver, "_MAX_RATE_HZ", 40)  # the ring is 28,800 bytes: 1,200 samples
    sims = start_sims("--speed", "2")
    loaded = load_machine(Path(sims.machine_file))
    site = site_of(loaded.machine)
    plan = CampaignPlan("c", (Helix("h", "B1", "identify", (300.0, 250.0, 100.0), 150.0, rate_hz=500).plan(site.machine),))
    at_rest: list[bool] = []

    def watch() -> None:
        """The disk hangs while the path runs, and answers again once the axes stand still, so that the run can be closed."""
        try:
            wait_for(lambda: disk.syncs > 5 and not axes_at_rest(sims), 60, "the path")
            disk.hang.set()
            at_rest.append(wait_for(lambda: axes_at_rest(sims), 60, "the stop"))
        finally:
            disk.again.set()

    watching = threading.Thread(target=watch)
    with Store.open(loaded.database_url) as store:
        async with open_session(site.urls) as session:
            watching.start()
            with pytest.raises(Backpressure, match="80% full"):
                await measure(session, store, site, plan)
        watching.join(60)
        (run,) = store.runs.all()
        ledger = ledger_of(store.chunks.of_run(run.id))
    assert at_rest
    assert (run.status, run.reason[:7]) == ("failed", "DRV-009")
    assert ledger.unaccounted() == []
    assert ledger.stored > 1000
    # nothing is missing between samples; the one gap says that the stream was ended on purpose
    assert [(gap.last, gap.first) for gap in ledger.gaps] == [(None, ledger.stored)]
    assert json.dumps(run.end_doc["capture"]["warnings"]).count("50% full") == 1
