"""S1: the cable is pulled at any moment, and what is plugged in afterwards is the same box, somewhere else, another one, or nothing."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from abbe.drivers.errors import LinkDown, WrongDevice
from abbe.drivers.links.serial_link import Adapter
from abbe.simulators.ballbar.wire import IDENTIFY, START, STOP
from abbe.simulators.faults.serial_box import FaultyBox
from tests.faults.rows_serial import S1_MOMENTS, S1_REPLUG
from tests.faults.serial_rig import Stage, be_patient, stage, together
from tests.patience import within

NOT_DETECTED = "the line was being closed: nobody misses it, so there is nothing to detect"


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    be_patient(monkeypatch)  # a cable that is pulled is not found by waiting


def pull_at(box: FaultyBox, kind: int, *, nth: int = 1) -> None:
    """Pull the cable when the n-th command of this type arrives; the box goes on with its battery, but does not hear it."""
    left = nth

    def before(seen: int) -> bool:
        nonlocal left
        left -= seen == kind
        if seen != kind or left:
            return False
        box.line.pull()
        return True

    box.before = before


async def opening(on: Stage) -> None:
    pull_at(on.box, IDENTIFY)
    on.error = await on.fails(on.bar.identify())


async def idle(on: Stage) -> None:
    await on.bar.identify()
    on.box.line.pull()
    async with asyncio.timeout(within(1.0)):  # noticed by itself within a second, though nobody asks for anything
        while on.bar.incidents.open is None:  # noqa: ASYNC110 - the account is what is tested
            await asyncio.sleep(0.001)
    on.error = on.bar.incidents.open


async def arming(on: Stage) -> None:
    await on.bar.identify()
    pull_at(on.box, START)
    on.error = await on.measure(lambda: on.box.run(1))


async def mid_frame(on: Stage) -> None:
    await on.bar.identify()

    async def script() -> None:
        await on.box.run(300)
        on.box.line.spoil = lambda data: [data[:-13]]
        await on.box.run(1)
        on.box.line.pull()

    await on.fault(script)


async def stopping(on: Stage) -> None:
    await on.bar.identify()
    pull_at(on.box, STOP, nth=2)  # the first one comes before START
    on.error = await on.measure(lambda: on.box.run(300))
    assert on.error is None, "the samples were all there: the run is good"
    on.error = on.bar.incidents.open


async def closing(on: Stage) -> None:
    await on.bar.identify()
    assert await on.measure(lambda: on.box.run(300)) is None
    on.box.line.pull()
    await on.bar.close()


MOMENTS = dict(zip(S1_MOMENTS, (opening, idle, arming, mid_frame, stopping, closing), strict=True))


async def play(folder: Path, moment: str, replug: str) -> None:
    async with stage(folder, "S1", f"{moment} {replug}") as on:
        sockets = [on.box.line.link, on.box.line.link.with_name("another-socket")]
        # what the system lists: the adapter, wherever it is plugged in
        on.bar._link._adapters = lambda: [Adapter(str(at), "0403:6001", "A5XK3RJT") for at in sockets if at.is_symlink()]
        await MOMENTS[moment](on)
        on.box.before = lambda kind: False
        on.state = on.bar.state
        assert moment == "closing" or isinstance(on.error, LinkDown)
        resumed = await REPLUG[replug](on)
        left_out = {"A": NOT_DETECTED} if moment == "closing" and replug != "other-serial" and replug != "never" else {}
        await on.judge(resumable=resumed is not None, resumed=resumed, left_out=left_out)


async def same_node(on: Stage) -> bool:
    await on.box.plug()
    return await on.again()


async def new_node(on: Stage) -> bool:
    on.box.line.link = on.box.line.link.with_name("another-socket")
    return await same_node(on)


async def other_serial(on: Stage) -> bool:
    other = FaultyBox(on.box.line.link, serial_no=4712)
    await other.plug()
    refusal = await on.fails(on.bar.recover(within_s=5.0))
    assert isinstance(refusal, WrongDevice)
    assert "4712" in str(refusal)
    assert "4711" in str(refusal)
    on.error, on.commands_after = refusal, sum(kind != IDENTIFY for kind in other.commands)
    other.line.pull()
    return await same_node(on)


async def never(on: Stage) -> None:
    error = await on.fails(on.bar.recover(within_s=0.3))
    assert isinstance(error, LinkDown)
    on.error = on.error or error


REPLUG = dict(zip(S1_REPLUG, (same_node, new_node, other_serial, never), strict=True))


async def test_pulled_and_plugged(tmp_path):
    await together([play(tmp_path, moment, replug) for moment in S1_MOMENTS for replug in S1_REPLUG])
