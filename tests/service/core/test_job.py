"""A check ends in a document, also when it fails; a defect of ours or a stop does not."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Callable
from typing import Any

import pytest

from abbe.drivers.errors import LinkDown
from abbe.service.domain.schedule import Schedule
from abbe.service.errors import MeasurementFault
from abbe.service.scheduler.job import CheckJobs, carry_out
from abbe.service.sequences.control import Control
from tests.service.core.fakes import STEP, FakeClock, FakeShelf, FakeWatcher, Result, settle, utc

SCHEDULE = Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "verify")
SLOT = utc(2026, 6, 1, 4)


class Bench:
    def __init__(self, outcome: Result | BaseException) -> None:
        self.outcome = outcome
        self.shelf = FakeShelf()
        self.watcher = FakeWatcher()
        self.check = self.given

    async def job(self) -> str:
        """Run the check of the slot."""
        job = CheckJobs("mill-7", self.check, self.shelf, FakeClock(SLOT))(SCHEDULE, SLOT)
        return await carry_out(job, SLOT, Control(), [self.watcher])

    async def given(self, recipe: str, progress: Callable[[Any], None], control: Control) -> Result:
        assert recipe == "verify"
        progress(STEP)
        if isinstance(self.outcome, BaseException):
            raise self.outcome
        return self.outcome


async def test_a_result_is_kept_whole() -> None:
    bench = Bench(Result())
    assert await bench.job() == "done: pass"
    (doc,) = bench.shelf.docs
    assert json.loads(json.dumps(doc)) == doc
    assert doc["schema"] == 1
    assert doc["machine"] == "mill-7"
    assert doc["slot_utc"] == "2026-06-01T04:00:00+00:00"
    assert doc["values"]["body_diagonal_um"] == 11.8
    assert doc["limits"]["helix_rms_um"] == 3.0
    assert doc["runs"] == ["helix-1", "diagonal-1"]
    assert doc["cause"] is None
    assert bench.watcher.heard == ["started weekly", "progress 3/10", "ended pass"]


@pytest.mark.parametrize(
    ("error", "code", "device"),
    [
        (LinkDown("tcp://127.0.0.1:5021", "connect", "refused\r\n\x00by peer", "is the laser on?"), "DRV-002", "tcp://127.0.0.1:5021"),
        (MeasurementFault("the beam was lost at 312 mm", "realign"), "SEQ-003", ""),
        (ConnectionResetError(104, "reset"), "ABB-001", ""),
        (ValueError("array must not contain infs or NaNs"), "ABB-001", ""),
        (ExceptionGroup("check", [ExceptionGroup("inner", [OSError("x"), LinkDown("bar", "read", "gone")])]), "DRV-002", "bar"),
    ],
)
async def test_a_failure_is_cannot_tell_with_its_cause_in_one_line(error: Exception, code: str, device: str) -> None:
    bench = Bench(error)
    assert await bench.job() == "done: cannot tell"
    (doc,) = bench.shelf.docs
    assert doc["verdict"] == "cannot tell"
    assert doc["cause"]["code"] == code
    assert doc["cause"]["device"] == device
    assert doc["cause"]["what"].isprintable()
    assert doc["values"] == {}
    assert bench.watcher.heard[-1] == "ended cannot tell"


async def test_a_defect_is_not_hidden() -> None:
    bench = Bench(ExceptionGroup("check", [LinkDown("bar", "read", "gone"), KeyError("oops")]))
    with pytest.raises(ExceptionGroup):
        await bench.job()
    assert bench.shelf.docs == []
    assert bench.watcher.heard[-1] == "ended None"


async def test_a_stop_is_not_a_result() -> None:
    bench = Bench(Result())
    started = asyncio.Event()

    async def check(recipe: str, progress: Callable[[Any], None], control: Control) -> Result:
        started.set()
        await asyncio.Event().wait()
        raise AssertionError

    bench.check = check
    task = asyncio.create_task(bench.job())
    await started.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    await settle()
    assert bench.shelf.docs == []
    assert bench.watcher.heard == ["started weekly", "ended None"]


async def test_what_is_no_number_and_what_is_no_verdict() -> None:
    bench = Bench(Result(verdict="PASS!", values={"helix_rms_um": math.nan}))
    assert await bench.job() == "done: cannot tell"
    assert bench.shelf.docs[0]["values"] == {"helix_rms_um": None}
