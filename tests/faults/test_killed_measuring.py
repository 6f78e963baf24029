"""SIGKILL of the measuring process at random instants, and going on: the campaign becomes complete, no test twice, nothing lost."""

from __future__ import annotations

import hashlib
import json
import os
import random
import select
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from abbe.service.storage.store import Store
from tests.faults.measuring_child import plan
from tests.faults.on_sphere import words
from tests.patience import within
from tests.scenarios.conftest import Sims, simulated

LONG = os.environ.get("ABBE_TEST_LONG") == "1"
KILLS = 100 if LONG else 6
SPEED = "60"
LONGEST_S = 0.9
"""Kills fall into the first so many seconds of a process: long enough for a test or two, short enough for many kills in a campaign."""


class Zygote:
    """The process that forks measuring children."""

    def __init__(self, log: Path) -> None:
        self.log, self._log = log, log.open("w")
        command = [sys.executable, "-m", "tests.faults.measuring_child"]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log, text=True)
        assert self.line() == "ready"

    def line(self) -> str:
        assert self.process.stdout is not None
        return self.process.stdout.readline().strip()

    def start(self, **words: Any) -> int:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()
        return int(self.line())

    def ended_within(self, seconds: float) -> int | None:
        """Exit code of the child if it ends by itself in that time."""
        assert self.process.stdout is not None
        ready, _, _ = select.select([self.process.stdout], [], [], seconds)
        return int(self.line()) if ready else None

    def close(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.close()
        self.process.wait(timeout=within(20))
        self.process.stdout.close()
        self._log.close()


@pytest.fixture
def sims(tmp_path: Path) -> Iterator[Sims]:
    wrong = tmp_path / "off-the-sphere"
    with simulated(tmp_path, "--speed", SPEED, program=tuple(words(wrong))) as running:
        yield running
    assert not wrong.read_text(), wrong.read_text()


@pytest.fixture(scope="module")
def zygote(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Zygote]:
    made = Zygote(tmp_path_factory.mktemp("zygote") / "children.log")
    yield made
    made.close()


def complete_runs(folder: Path, name: str) -> dict[str, str]:
    """Fingerprint of every complete run with all its samples, by its number."""
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        record = next((c for c in store.campaigns.all() if c.name == name), None)
        if record is None:
            return {}
        found = {}
        for run in store.runs.all(record.id):
            if run.status == "complete":
                digest = hashlib.sha256(repr((run.label, run.start_doc, run.end_doc)).encode())
                for chunk in store.chunks.of_run(run.id):
                    digest.update(repr((chunk.channel, chunk.seq, chunk.n)).encode() + chunk.payload)
                found[f"{run.id} {run.label}"] = digest.hexdigest()
        return found


def measured_tests(folder: Path, name: str) -> list[str]:
    """Test of every complete run of a campaign, as its journal says."""
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        record = store.campaigns.find(name)
        complete = {r.id for r in store.runs.all(record.id) if r.status == "complete"}
        return [c.doc["test"] for c in store.checkpoints.of_campaign(record.id) if c.kind == "run" and c.doc["run"] in complete]


@pytest.mark.timeout(1200 if LONG else 150)
def test_a_campaign_that_is_killed_again_and_again_becomes_complete(tmp_path, sims, zygote, capsys):
    draw, killed, campaigns = random.Random(6), 0, 0
    urls = {k: sims.ready[k] for k in ("cnc", "ballbar", "laser", "fixture")}
    while killed < KILLS:
        name, known, done = f"june{campaigns}", dict[str, str](), False
        while not done:
            pid = zygote.start(folder=str(tmp_path), urls=urls, name=name, untouched=draw.random() < 0.5)
            code = zygote.ended_within(draw.uniform(0.05, LONGEST_S) if killed < KILLS else 60.0)
            if code is None:
                os.kill(pid, signal.SIGKILL)
                code = zygote.ended_within(30.0)
                killed += 1
            done = code == 0
            assert code in (0, -signal.SIGKILL), zygote.log.read_text()[-3000:]
            now = complete_runs(tmp_path, name)
            assert now.items() >= known.items(), "a complete run was changed"
            known = now
        assert sorted(measured_tests(tmp_path, name)) == sorted(t.label for t in plan(name).tests)
        campaigns += 1
    with capsys.disabled():
        print(f"\n{killed} kills in {campaigns} campaigns: all complete, every test once, complete runs unchanged")  # noqa: T201


def test_an_end_leaves_nothing_to_do(tmp_path, sims, zygote):
    """Going on with a complete campaign moves nothing and adds nothing."""
    urls = {k: sims.ready[k] for k in ("cnc", "ballbar", "laser", "fixture")}
    job = {"folder": str(tmp_path), "urls": urls, "name": "once", "untouched": False}
    zygote.start(**job)
    assert zygote.ended_within(60.0) == 0
    before, told = complete_runs(tmp_path, "once"), sims.ask("commands")["commands"]
    zygote.start(**job)
    assert zygote.ended_within(60.0) == 0
    assert complete_runs(tmp_path, "once") == before
    assert sims.ask("commands")["commands"] == told
