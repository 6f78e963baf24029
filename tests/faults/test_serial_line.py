"""S10, S11: other rates and pauses; a line that takes nothing, is taken, or is set wrong; a box that was switched over."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path

import pytest

from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.errors import BadFrame, DeviceFault, DriverError, LinkDown, ReplyTimeout, SettingsChanged
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import parse_url
from tests.faults.contract import Record
from tests.faults.patient import patience
from tests.faults.rows_serial import S10, S11
from tests.faults.serial_rig import Stage, be_patient, stage, together

NO_FAULT = "shorter than the watchdog: the samples come, only later, so there is nothing to detect"


@pytest.fixture(scope="module", autouse=True)
def _patient() -> Iterator[None]:
    with patience():
        yield


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    be_patient(monkeypatch, answer_s=1.0, sample_s=1.5)


# --- S10 -----------------------------------------------------------------------------------------------------------------------------


async def other_rate(on: Stage, factor: float) -> None:
    on.box.rate_factor = factor
    await on.fault(lambda: on.box.run(400))
    assert isinstance(on.error, DeviceFault)
    assert "took the device" in str(on.error)
    assert len(on.tap.samples) <= 1, "nothing at another rate is taken for what was asked"
    on.box.rate_factor = 1.0
    await on.judge(resumed=await on.again())


async def pause(on: Stage, seconds: float) -> None:
    async def script() -> None:
        await on.box.run(300)
        on.box.line.stall()
        await on.box.run(200)
        if seconds < 1.0:
            await asyncio.sleep(seconds)  # the fault itself: nothing is waited for
            on.box.line.resume()
            await on.box.run(100)

    noise = asyncio.create_task(_babble(on)) if seconds > 1.0 else None
    await on.fault(script)
    if noise is not None:
        noise.cancel()
        await asyncio.wait([noise])
        assert isinstance(on.error, ReplyTimeout | BadFrame), "bytes came all the time, samples did not"
        on.box.line.resume()  # what was held back comes now, into no stream
    else:
        assert on.error is None
        assert [sample.seq for sample in on.tap.samples] == list(range(601))
    await on.judge(resumed=await on.again(), left_out={} if noise else {"A": NO_FAULT})


async def _babble(on: Stage) -> None:
    while True:
        await asyncio.sleep(0.05)
        on.box.line.terminal.send(b"\xff\xa5" * 20)


async def pace(folder: Path, case: str) -> None:
    async with stage(folder, "S10", case) as on:
        await on.bar.identify()
        what, amount = case.split()
        await (other_rate(on, float(amount[1:])) if what == "rate" else pause(on, float(amount[:-2]) * 1e-3))


async def test_other_rates_and_pauses(tmp_path):
    await together([pace(tmp_path, case) for case in S10])


# --- S11 -----------------------------------------------------------------------------------------------------------------------------


async def tx_held(on: Stage, which: str) -> None:
    await on.bar.identify()
    terminal = on.box.line.terminal
    if which == "held":
        terminal.hold(True)
    else:
        assert terminal.stuff() > 0
    on.error = await on.fails(on.bar.identify())
    assert isinstance(on.error, ReplyTimeout)
    assert "accepted no bytes" in str(on.error)
    on.state = on.bar.state
    await on.bar._link.close()  # returns, though what was written cannot leave
    if which == "held":
        terminal.hold(False)
    else:
        terminal.unstuff()
    await on.judge(resumed=await on.again())


async def second_opener(on: Stage, which: str) -> None:
    await on.bar.identify()
    second = SerialBallBar(ByteLink(parse_url(on.box.url)))
    on.error = await on.fails(second.identify())
    assert isinstance(on.error, LinkDown)
    assert "another program holds the port" in on.error.remedy
    on.state = second.state
    first_goes_on = await on.again()
    await on.bar.close()
    await second.recover(within_s=5.0)
    await second.close()
    await on.judge(resumed=first_goes_on, records=records(second))


async def wrong_setting(on: Stage, what: str, value: str) -> None:
    on.box.begin_anew()  # left streaming by somebody: what is heard, but not understood, tells a wrong setting from a box that is off
    url = on.box.url if what == "parity" else on.box.url.replace("460800", value)
    if what == "parity":
        url, on.box.line.host_parity = f"{url}&parity={value}", value
    wrong = SerialBallBar(ByteLink(parse_url(url)))

    async def go_on() -> None:
        while True:
            on.box.advance(20)
            await asyncio.sleep(0.02)

    streaming = asyncio.create_task(go_on())
    on.error = await on.fails(wrong.identify())
    streaming.cancel()
    await asyncio.wait([streaming])
    assert isinstance(on.error, BadFrame)
    assert "baud rate and parity" in on.error.remedy
    on.state = wrong.state
    await wrong.close()
    on.box.line.host_parity = "none"
    await on.judge(resumed=await on.again(), records=records(wrong))


async def switched(on: Stage, what: str, when: str) -> None:
    await on.bar.identify()

    def switch() -> None:
        on.box.world.ballbar.switch(inch=True) if what == "unit" else on.box.world.ballbar.switch(range_mm=0.25)

    async def script() -> None:
        await on.box.run(300)
        switch()
        await on.box.run(300)

    if when == "between-runs":
        switch()
        on.error = await on.measure(lambda: on.box.run(1))
        on.state = on.bar.state
        assert on.box.starts == 0
    else:
        await on.fault(script)
        assert len(on.tap.samples) == 300, "all before the switch, none after it"
    assert isinstance(on.error, SettingsChanged)
    await on.judge(resumed=await on.again(restore=True))


def records(bar: SerialBallBar) -> list[Record]:
    return [Record(e.kind, e.code, e.device, e.run, e.state) for e in bar.incidents.entries]


PLAYS: dict[str, Callable[..., Awaitable[None]]] = {
    "tx": tx_held,
    "second": second_opener,
    "baud": lambda on, value: wrong_setting(on, "baud", value),
    "parity": lambda on, value: wrong_setting(on, "parity", value),
    "unit": lambda on, when: switched(on, "unit", when),
    "range": lambda on, when: switched(on, "range", when),
}


async def setting(folder: Path, case: str) -> None:
    async with stage(folder, "S11", case) as on:
        what, which = case.split()
        await PLAYS[what](on, which)


async def test_lines_that_are_held_taken_or_set_wrong(tmp_path):
    await together([setting(tmp_path, case) for case in S11])


async def test_a_mute_line_with_a_wrong_baud_rate_is_a_timeout_that_says_so(tmp_path):
    async with stage(tmp_path, "S11", "mute") as on:
        wrong = SerialBallBar(ByteLink(parse_url(on.box.url.replace("460800", "115200"))))
        error: DriverError = await on.fails(wrong.identify())
        await wrong.close()
        assert isinstance(error, ReplyTimeout)
        assert "baud rate" in error.remedy
