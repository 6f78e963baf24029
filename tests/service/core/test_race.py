"""Two real processes race for 200 slots (ABBE_TEST_LONG=1: 1,000); and what a killed one leaves open goes to exactly one other."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from datetime import timedelta
from pathlib import Path

from abbe.service.storage.store import Store
from tests.service.core import racing_child
from tests.service.core.racing_child import FIRST

COUNT = 1000 if os.environ.get("ABBE_TEST_LONG") else 200
ROOT = Path(__file__).resolve().parents[3]


def child(url: str) -> subprocess.Popen[str]:
    command = [sys.executable, racing_child.__file__, url, str(COUNT)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env={"PYTHONPATH": str(ROOT)})


def say(process: subprocess.Popen[str]) -> None:
    assert process.stdin is not None
    process.stdin.write("go\n")
    process.stdin.flush()


def hear(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


def test_slots_by_the_hundred_no_duplicate_and_none_left_open(url: str) -> None:
    Store.open(url).close()
    racers = [child(url), child(url)]
    try:
        assert [hear(one) for one in racers] == ["ready\n", "ready\n"]
        for one in racers:
            say(one)
        won = [json.loads(hear(one)) for one in racers]
        assert sorted(won[0] + won[1]) == list(range(COUNT))
        # Each tried all of them. On SQLite the one that is first once may be first always: it holds the file while the other waits.
        racers, won = zip(*sorted(zip(racers, won, strict=True), key=lambda pair: -len(pair[1])), strict=True)
        with Store.open(url) as store:
            assert len(store.slots.latest("mill-7/weekly", 5000)) == COUNT
            assert store.slots.adopt("mill-7/weekly") == [], "both live: nothing is nobody's"
            ran = won[0][0]
            store.slots.begin("mill-7/weekly", FIRST + timedelta(minutes=ran))
            racers[0].kill()
            racers[0].wait()
            adopted = _adopt_from_two(store, url)
        assert [len(one) for one in adopted].count(0) <= 1
        slots = [slot for one in adopted for slot, _ in one]
        assert len(slots) == len(set(slots)) == len(won[0]), "each to one of the two that came for it"
        assert [state for one in adopted for _, state in one].count("running") == 1, "and the one that ran is known as such"
    finally:
        for one in racers:
            one.kill()
            one.communicate()


def _adopt_from_two(store: Store, url: str) -> list[list[tuple[str, str]]]:
    taken: list[list[tuple[str, str]]] = [[], []]
    with Store.open(url) as other:
        threads = [
            threading.Thread(target=lambda s=s, t=t: t.extend((one.slot_utc, one.state) for one in s.slots.adopt("mill-7/weekly")))
            for s, t in zip((store, other), taken, strict=True)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    return taken


def test_a_slot_that_was_given_back_is_taken_again_and_keeps_its_reason(url: str) -> None:
    with Store.open(url) as store:
        assert store.slots.claim("m/s", FIRST)
        store.slots.release("m/s", FIRST)
        (one,) = store.slots.adopt("m/s")
        assert (one.state, one.finished_utc) == ("released", None)
        store.slots.finish("m/s", FIRST, "missed: maintenance", "it lies in the maintenance window 'cleaning'")
        (kept,) = store.slots.latest("m/s")
        assert (kept.state, kept.reason) == ("missed: maintenance", "it lies in the maintenance window 'cleaning'")
        assert store.slots.adopt("m/s") == []
