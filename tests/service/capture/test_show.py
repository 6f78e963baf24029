"""What a person is told about samples that are missing and runs that were cut off."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from abbe.service.capture.recorder import recording
from abbe.service.capture.recovery import recover_segments
from abbe.service.capture.settings import CaptureSettings
from abbe.service.cli.app import app
from abbe.service.clock import SystemClock
from abbe.service.storage.store import Store
from tests.service.capture.capture_bench import abandon, batch

SMALL = CaptureSettings(reserve_bytes=65536)
START = {
    "setup": {"setup_id": "B1", "t_set_s": 0.0, "centre_mm": [0.0, 0.0, 0.0], "radius_mm": 100.0},
    "machine": {"name": "VMC-1"},
    "ctrl0_us": 0,
    "path": {"feed_mm_min": 600.0, "direction": 1, "points_mm": [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]},
    "rate_hz": 1000,
}


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path / 'abbe.sqlite3'}"


def tell(*words: str) -> str:
    done = CliRunner().invoke(app, list(words), catch_exceptions=False)
    assert done.exit_code == 0
    return done.stdout


async def recorded(url: str, *, finish: bool) -> None:
    with Store.open(url) as store:
        campaign = store.campaigns.add(store.machines.add("VMC-1", {"name": "VMC-1"}), "c1", {})
        run_id = store.runs.start(campaign, "r01", "ballbar_helix", "identify", START)
        async with recording(store, run_id, SMALL, SystemClock(), {"label": "r01"}) as recorder:
            tap = recorder.tap()
            tap.take(batch(0, 50))
            tap.take(batch(60, 40, missing=10, status=8 | 1))
        if finish:
            store.runs.finish(run_id, "complete", "", recorder.doc())
            recorder.discard()
        else:
            recorder.release()
            abandon(store, run_id)


async def test_gaps_of_a_complete_run(url: str) -> None:
    await recorded(url, finish=True)
    assert "1 gaps, 10 samples missing" in tell("runs", "--db", url)
    shown = tell("show", "r01", "--db", url)
    assert "50 valid, 40 flagged (out of range 40)" in shown
    assert "samples 50 to 59: lost or damaged on the line" in shown
    assert "unaccounted" not in shown


async def test_a_run_that_was_cut_off_before_and_after_the_recovery(url: str) -> None:
    await recorded(url, finish=False)
    (told,) = json.loads(tell("runs", "--db", url, "--json"))
    assert told["status"] == "incomplete"
    assert "takes over what was saved" in told["reason"]
    with Store.open(url) as store:
        recover_segments(store, SMALL)
    (told,) = json.loads(tell("runs", "--db", url, "--json"))
    assert told["status"] == "interrupted"
    assert "recorded to its end (complete), but the process ended before the database was updated" in told["reason"]
    assert "samples 50 to 59" in tell("show", "r01", "--db", url)


async def two_streams(url: str, *, finish: bool, told: bool) -> None:
    """Two streams of which the second begins behind the first one's end, since its beginning was damaged: no number goes back."""
    with Store.open(url) as store:
        campaign = store.campaigns.add(store.machines.add("VMC-1", {"name": "VMC-1"}), "c1", {})
        run_id = store.runs.start(campaign, "r01", "ballbar_helix", "identify", START)
        async with recording(store, run_id, SMALL, SystemClock(), {"label": "r01"}) as recorder:
            recorder.tap().take(batch(0, 50))
            recorder.tap().take(batch(60, 40, missing=60))
        if not finish:
            recorder.release()
            abandon(store, run_id)
            recover_segments(store, SMALL)
            return
        doc = recorder.doc()
        if not told:
            del doc["capture"]["streams"]
        store.runs.finish(run_id, "complete", "", doc)
        recorder.discard()


@pytest.mark.parametrize("finish", [True, False])
async def test_which_streams_a_run_has_it_says_itself(url: str, finish: bool) -> None:
    await two_streams(url, finish=finish, told=True)
    with Store.open(url) as store:
        assert store.runs.find("r01").end_doc["capture"]["streams"] == [[0, 0, 0], [1, 1, 1]]
    shown = tell("show", "r01", "--db", url)
    assert re.search(r"streams\s+2 *\n", shown)
    assert "60 in 1 gaps" in shown
    assert "samples 0 to 59" in shown
    assert "unaccounted" not in shown


async def test_a_guess_is_called_one(url: str) -> None:
    await two_streams(url, finish=True, told=False)
    shown = tell("show", "r01", "--db", url)
    assert "2 (guessed: the run does not say)" in shown
    assert "unaccounted" in shown, "the guess takes the second stream for a part of the first one"
