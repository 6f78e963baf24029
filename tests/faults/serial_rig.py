"""A faulty box on a pty, the real driver on it, and what both saw: judged the same way in every case."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import astuple
from pathlib import Path
from typing import Any

import pytest

from abbe.drivers.api import BarBatch, BarSample
from abbe.drivers.ballbar import driver as module
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.errors import DriverError, on_behalf_of
from abbe.drivers.links.serial_link import Adapter, ByteLink
from abbe.drivers.links.urls import parse_url
from abbe.simulators.faults.serial_box import FaultyBox
from abbe.simulators.faults.serial_bytes import Sample
from tests.faults.contract import Observed, Record, assert_fault_contract, told_of

Script = Callable[[], Awaitable[None]]


def be_patient(monkeypatch: pytest.MonkeyPatch, *, answer_s: float = 10.0, sample_s: float = 30.0) -> None:
    """A busy computer is not a mute box: long silences pass, except in a case that waits for one (``sample_s``)."""
    monkeypatch.setattr(module, "_ANSWER_S", answer_s)
    monkeypatch.setattr(module, "_SAMPLE_TIMEOUT_S", sample_s)


class Tap:
    """Keeps every batch of one stream."""

    def __init__(self) -> None:
        self.batches: list[BarBatch] = []

    def take(self, batch: BarBatch) -> None:
        self.batches.append(batch)

    def warn(self, text: str) -> None:
        raise AssertionError(text)

    @property
    def samples(self) -> list[BarSample]:
        return [sample for batch in self.batches for sample in batch.samples]


def accounted(batches: Sequence[Any], sent: Sequence[Sample], *, whole: bool) -> tuple[int, int]:
    """Wrong values, and numbers that are neither there nor in a gap; ``whole``: the stream ended as it should, so all of it counts.

    ``batches``: anything with ``missing`` and ``samples``.
    """
    true = {sample.seq: astuple(sample) for sample in sent}
    wrong = unaccounted = expected = 0
    for batch in batches:
        expected += batch.missing
        for sample in batch.samples:
            wrong += (sample.seq, sample.device_us, sample.reading_nm, sample.status) != true.get(sample.seq)
            unaccounted += sample.seq != expected
            expected = sample.seq + 1
    return wrong, unaccounted + (abs(len(sent) - expected) if whole else 0)


class Stage:
    """One case on its stage."""

    def __init__(self, row: str, case: str, box: FaultyBox, adapters: Callable[[], list[Adapter]] | None) -> None:
        self.row, self.case, self.box = row, case, box
        self.bar = SerialBallBar(ByteLink(parse_url(f"{box.url}&serial_no={box.serial_no}"), adapters))
        self.error: DriverError | None = None
        self.wrong = self.unaccounted = self.commands_after = 0
        self.tap = Tap()
        self.state = ""

    async def measure(self, script: Script) -> DriverError | None:
        """One stream: the script is played as soon as it runs; it ends when everything has arrived, or with the error that ended it."""
        tasks: list[asyncio.Task[None]] = []
        self.tap = tap = Tap()
        last_seq = 1 << 62

        async def play() -> None:
            nonlocal last_seq
            await script()
            self.box.line.spoil = None
            if self.box.stream == stream:
                last_seq = self.box.sent[stream][-1].seq + 1
            await self.box.run(1)

        stream = (0, 0)

        def begin() -> None:
            nonlocal stream
            stream = self.box.stream
            tasks.append(asyncio.get_running_loop().create_task(play()))

        self.box.on_start = begin
        error: DriverError | None = None
        try:
            async with self.bar.stream(1000, tap) as batches:
                async for batch in batches:
                    if batch.samples[-1].seq >= last_seq:
                        break
        except DriverError as caught:
            error = caught
        for task in tasks:
            await task
        wrong, unaccounted = accounted(tap.batches, self.box.sent.get(stream, []), whole=error is None)
        self.wrong, self.unaccounted = self.wrong + wrong, self.unaccounted + unaccounted
        return error

    async def fails(self, attempt: Awaitable[object]) -> DriverError:
        """The error that an attempt ends with."""
        try:
            await attempt
        except DriverError as error:
            return error
        raise AssertionError(f"{self.row} [{self.case}]: nothing was refused")

    async def fault(self, script: Script) -> DriverError | None:
        """Measure while the script injects the fault; notes what was told and in what state it left the driver."""
        self.error = await self.measure(script)
        starts = self.box.starts
        await asyncio.sleep(0)
        self.state = self.bar.state
        self.commands_after += self.box.starts - starts
        return self.error

    async def again(self, *, within_s: float = 5.0, restore: bool = False) -> bool:
        """Find the box again and measure 60 samples: whether all of them came, and are right."""
        await self.bar.recover(within_s=within_s)
        if restore:
            await self.bar.restore_settings()
        before = self.wrong + self.unaccounted

        async def quiet() -> None:
            await self.box.run(60)

        error = await self.measure(quiet)
        if error is not None:
            error.add_note(f"{self.row} [{self.case}]: in the attempt to go on")
            raise error
        return self.wrong + self.unaccounted == before and len(self.tap.samples) == 61

    async def judge(self, **known: Any) -> None:
        """Close the driver and put the case before the checker."""
        await self.bar.close()
        records = [Record(e.kind, e.code, e.device, e.run, e.state) for e in self.bar.incidents.entries]
        told = None if self.error is None else told_of(self.error)
        facts: dict[str, Any] = {
            "told": told,
            "absorbed": told is None,
            "wrong_values": self.wrong,
            "unaccounted": self.unaccounted,
            "commands_after": self.commands_after,
            "state": self.state,
            "records": records,
        }
        assert_fault_contract(Observed(self.row, self.case, **(facts | known)))


@asynccontextmanager
async def stage(
    folder: Path, row: str, case: str, *, adapters: Callable[[], list[Adapter]] | None = None, **box: Any
) -> AsyncIterator[Stage]:
    """A plugged-in box and a driver that has identified nothing yet, both gone afterwards."""
    place = folder / f"{row} {case}".replace(" ", "-").replace("/", "-")
    place.mkdir()
    with on_behalf_of(f"{row} {case}"):
        made = FaultyBox(place / "ballbar", **box)
        await made.plug()
        on = Stage(row, case, made, adapters)
        try:
            yield on
        finally:
            await on.bar.close()
            made.line.pull()


async def together(cases: Sequence[Awaitable[None]]) -> None:
    """Play cases side by side (most of them wait for a deadline), six at a time, and name all that failed."""
    places = asyncio.Semaphore(6)

    async def placed(case: Awaitable[None]) -> None:
        async with places:
            await case

    found = await asyncio.gather(*map(placed, cases), return_exceptions=True)
    failed = [result for result in found if result is not None]
    if failed:
        raise ExceptionGroup(f"{len(failed)} of {len(cases)} cases", [e for e in failed if isinstance(e, Exception)])
