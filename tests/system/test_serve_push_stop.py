"""A service that is stopped in the middle of a push that nobody attends: within five seconds the axes stand; it says what is in force."""

from __future__ import annotations

import json
import os
import sys
from contextlib import closing
from datetime import datetime
from pathlib import Path

import pytest

from abbe.service.push.journal import check_chain
from abbe.service.storage.store import Store
from tests.scenarios.conftest import Sims, simulated
from tests.scenarios.world import axes_at_rest, registers, wait_for
from tests.system.serve_bench import Process

pytestmark = [pytest.mark.scenario, pytest.mark.timeout(240)]
LONG = os.environ.get("ABBE_TEST_LONG") == "1"
CHILD = Path(__file__).parent / "serve_push.py"


def start(folder: Path, sims: Sims, last: str = "") -> Process:
    path = folder / "service.json"
    path.write_text(json.dumps({"ready": sims.ready, "store": f"sqlite:///{folder / 'abbe.sqlite3'}", "last": last}))
    return Process(sys.executable, CHILD, path, env={"ABBE_LOCK_FOLDER": str(folder), "PYTHONPATH": str(CHILD.parents[2])})


def span_s(running: Process) -> float:
    """From hearing the signal to having closed everything, by the service's own log: a busy computer takes its time to end a process."""
    stamps = {doc["event"]: doc["timestamp"] for line in running.lines if line.startswith("{") for doc in [json.loads(line)]}
    return (datetime.fromisoformat(stamps["stopped"]) - datetime.fromisoformat(stamps["stopping"])).total_seconds()


def in_force(sims: Sims) -> tuple[int, ...]:
    """Active bank, and the CRC of both, read by hand."""
    active, *crcs = registers(sims, 208, 5)
    return (active, *crcs[2 * active : 2 * active + 2])


def told(folder: Path) -> tuple[str, list[str], list[str]]:
    """The push's last state, and the words and sentences that the alarm desk wrote of it."""
    with Store.open(f"sqlite:///{folder / 'abbe.sqlite3'}") as store:
        entries = store.pushes.entries("sim")
        check_chain(entries)
        lines = [e.facts for e in store.alarms.entries("sim") if e.kind == "pushed"]
        return str(entries[-1].state), [one.word for one in lines], [one.text for one in lines]


closed = pytest.param(True, id="the way back is not open", marks=pytest.mark.skipif(not LONG, reason="only with ABBE_TEST_LONG=1"))


@pytest.mark.parametrize("open_", [pytest.param(False, id="the old table is back"), closed])
def test_a_stop_in_the_middle_of_a_push(tmp_path: Path, open_: bool) -> None:
    with simulated(tmp_path, "--speed", "30", "--seed", "2") as sims:
        before = in_force(sims)
        with closing(start(tmp_path, sims, json.dumps({"id": 1, "op": "estop", "on": True}) if open_ else "")) as running:
            running.expect("on its way")
            assert in_force(sims) != before  # a table that nobody has verified
            wait_for(lambda: not axes_at_rest(sims), 10, "the axes on their way")
            code, took_s = running.terminate()
        print(f"ended {took_s:.2f} s after the signal")  # noqa: T201
        assert (code, span_s(running) < 5.0) == (0, True), running.lines
        assert axes_at_rest(sims)
        (said,) = [json.loads(line) for line in running.lines if "the push was interrupted by the end of the service" in line]
        state, words, texts = told(tmp_path)
        if not open_:
            assert (state, said["word"], words) == ("ROLLED_BACK", "rolled back", ["rolled back"])
            assert in_force(sims) == before
            assert "the old table is in force again" in texts[0]
        else:
            assert (state, said["word"], words) == ("ROLLBACK_PENDING", "open", ["open"])
            assert in_force(sims) != before
            assert "an unverified table may be in force; it is rolled back before anything else" in texts[0]
            sims.ask("reset")
        with closing(start(tmp_path, sims)) as again:
            if open_:
                assert "the old table was made active again" in again.expect("open pushes are closed")
                # the desk's next look: half a minute
                again.expect("proposal 4 rolled back")
            if not open_:
                again.expect("planned")
            assert again.terminate()[0] == 0
        assert in_force(sims) == before
        state, words, _ = told(tmp_path)
        assert (state, words[-1]) == ("ROLLED_BACK", "rolled back")
