"""S6, S7, S8: the box restarts, clocks go wrong, readings are not measurements."""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.api import LaserFlag
from abbe.drivers.ballbar.frames import BoxSettings
from abbe.drivers.errors import DeviceFault, Rebooted, SettingsChanged, on_behalf_of
from abbe.drivers.laser.driver import ModbusLaser
from abbe.drivers.links.modbus_link import ModbusLink
from abbe.drivers.links.urls import parse_url
from abbe.simulators.ballbar.device import NO_BAR, OUT_OF_RANGE
from abbe.simulators.faults.serial_box import Window
from abbe.simulators.laser.wire import LaserRegisters
from abbe.simulators.modbus_wire import ModbusTcp
from abbe.simulators.scenario import DEFAULT_PATH, load
from abbe.simulators.world import World
from tests.faults.contract import Observed, assert_fault_contract, told_of
from tests.faults.rows_serial import S6_AFTER, S6_MOMENTS, S7, S8_LASER, S8_LENGTHS, S8_MOMENTS
from tests.faults.serial_rig import be_patient, stage, together

RUN = 1000


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    be_patient(monkeypatch)


INSTANTS = {"start": 5, "mid": 500, "reversal": 700, "end": 990}
NO_FAULT = "not a fault of the link: samples come as they should, so there is nothing to detect"
HOUR_S, YEAR_S = 3600.0, 365.25 * 86400.0


async def reboot(folder: Path, moment: str, after: str) -> None:
    async with stage(folder, "S6", f"{moment} {after}") as on:
        if after == "range-changed":
            on.box.world.ballbar.switch(range_mm=0.5)
        if after == "zero-changed":
            on.box.world.ballbar.switch(zero_mm=-0.0025)
        await on.bar.identify()
        first = on.box.boot_id

        async def script() -> None:
            await on.box.run(INSTANTS[moment])
            on.box.reboot()
            if moment in ("mid", "end"):  # a box that was told to measure by itself as soon as it has power
                on.box.begin_anew()
                await on.box.run(RUN)

        await on.fault(script)
        assert isinstance(on.error, Rebooted)
        assert [batch.boot_id for batch in on.tap.batches] == [first] * len(on.tap.batches), "never spliced"
        assert len(on.tap.samples) == INSTANTS[moment], "what came before the restart is kept, all of it"
        # not identified anew: refused
        assert isinstance(await on.fails(entered(on.bar.stream(1000))), Rebooted)
        on.box.world.ballbar.stop()
        await on.judge(resumed=await on.again(restore=after != "config-same"))


async def entered(stream) -> None:
    async with stream:
        pass


async def test_restart_in_the_middle(tmp_path, monkeypatch):
    be_patient(monkeypatch, sample_s=3.0)  # a restarted box is found by its silence
    await together([reboot(tmp_path, moment, after) for moment in S6_MOMENTS for after in S6_AFTER])


@pytest.mark.parametrize("changed", [{"range_mm": 0.5}, {"zero_mm": -0.0025}, {"inch": True}])
async def test_a_box_that_lost_its_settings_is_refused_until_it_has_them_again(tmp_path, changed):
    async with stage(tmp_path, "S6", "settings") as on:
        assert on.bar.settings is None
        await on.bar.identify()
        assert on.bar.settings == BoxSettings(on.bar.settings.tag, number=1, unit=0, range_nm=1_000_000, zero_nm=0)
        on.box.world.ballbar.switch(**changed)
        refusal = await on.fails(entered(on.bar.stream(1000)))
        assert isinstance(refusal, SettingsChanged)
        assert "instead of unit nm, range 1 mm, zero 0 nm" in str(refusal)
        await on.bar.identify()
        assert isinstance(await on.fails(entered(on.bar.stream(1000))), SettingsChanged), "knowing who it is does not set it back"
        assert await on.again(restore=True)


# --- S7 ------------------------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [case for case in S7 if case.startswith("host")])
async def test_the_host_clock_jumps(tmp_path, monkeypatch, case):
    jump_s = float(case[5:-1]) * (HOUR_S if case.endswith("h") else YEAR_S)
    async with stage(tmp_path, "S7", case) as on:
        await on.bar.identify()

        async def script() -> None:
            await on.box.run(RUN)
            monkeypatch.setattr(time, "time", lambda: time.monotonic() + jump_s)
            monkeypatch.setattr(time, "time_ns", lambda: round((time.monotonic() + jump_s) * 1e9))
            await on.box.run(RUN)

        assert await on.fault(script) is None
        arrivals = [batch.host_s for batch in on.tap.batches]
        assert arrivals == sorted(arrivals)
        assert arrivals[-1] - arrivals[0] < 60.0
        await on.judge(resumed=await on.again(), left_out={"A": NO_FAULT})


@pytest.mark.parametrize("case", [case for case in S7 if case.startswith("device")])
async def test_the_device_clock_is_fast_or_slow(tmp_path, case):
    async with stage(tmp_path, "S7", case) as on:
        on.box.ppm = float(case[7:-3])
        await on.bar.identify()
        assert await on.fault(lambda: on.box.run(3 * RUN)) is None
        took_us = on.tap.samples[-1].device_us - on.tap.samples[0].device_us
        assert took_us == pytest.approx(3e6 * (1 + on.box.ppm * 1e-6), abs=2), "the device's time is handed on as it is"
        await on.judge(resumed=await on.again(), left_out={"A": NO_FAULT})


# --- S8 ------------------------------------------------------------------------------------------------------------------------------

SAMPLES = {"1ms": 1, "100ms": 100, "5s": 5000, "for-ever": 1 << 30}
BEGINS = {"start": 0, "mid": 500, "reversal": 700, "last": RUN - 1}


async def window(folder: Path, length: str, moment: str) -> None:
    async with stage(folder, "S8", f"{length} {moment}") as on:
        begin, count = BEGINS[moment], SAMPLES[length]
        total = RUN if moment == "last" or length == "for-ever" else max(RUN, begin + count + 100)
        bits = NO_BAR if moment in ("reversal", "last") else OUT_OF_RANGE
        on.box.windows = [Window(begin, begin + count, bits)]
        await on.bar.identify()
        assert await on.fault(lambda: on.box.run(total)) is None
        flagged = [sample.seq for sample in on.tap.samples if sample.status & bits]
        assert [sample.seq for sample in on.tap.samples] == list(range(total + 1))
        assert flagged == list(range(begin, min(begin + count, total + 1))), "flagged where it happened, and nowhere else"
        on.box.windows = []
        await on.judge(resumed=await on.again(), left_out={"A": "flagged samples are data; whoever measures decides on them"})


async def test_readings_that_are_no_measurements(tmp_path):
    await together([window(tmp_path, length, moment) for length in S8_LENGTHS for moment in S8_MOMENTS])


class Mirror:
    """The simulated laser with its mirror set up, on a real socket; time goes on by one sample with every request."""

    def __init__(self) -> None:
        self.world = World(load(DEFAULT_PATH))
        self.laser = self.world.laser
        self.laser.mount(np.array([1.0, 0.0, 0.0]), self.world.tool_position())

    def advance(self) -> None:
        self.world.advance(self.world.time_s + 0.05)


WHAT = {"beam-lost": "counts are lost", "never-zeroed": "not zeroed", "no-reflector": "no reflector"}


@pytest.mark.parametrize("case", S8_LASER)
async def test_a_laser_that_cannot_measure_says_so(case):
    what, mirror = case.split()[1], Mirror()
    server = ModbusTcp(LaserRegisters(mirror.laser, 7, mirror.advance, mirror.world.tool_position))
    url = f"modbus+tcp://127.0.0.1:{await server.start(0)}?unit=1"
    with on_behalf_of(f"S8 {case}"):
        laser = ModbusLaser(await ModbusLink.connect(parse_url(url)))
        error, wrong = None, 0
        try:
            await laser.identify()
            if what != "never-zeroed":
                await laser.zero()
                await laser.read()
            if what == "beam-lost":
                mirror.laser.block(blocked=True)
                mirror.laser.block(blocked=False)  # a hand for a moment: the beam is back, the counts are not
            elif what == "no-reflector":
                mirror.laser.unmount()
            elif what == "signal-low":
                mirror.laser.weaken(150)
            try:
                reading = await laser.read()
                wrong = not reading.status & LaserFlag.SIGNAL_LOW  # with too little light it still counts, and says so in every reading
            except DeviceFault as caught:
                error = caught
            if what == "no-reflector":
                mirror.laser.mount(np.array([1.0, 0.0, 0.0]), mirror.world.tool_position())
            await laser.clear_beam()
            await laser.zero()
            resumed = not (await laser.read()).status & 0b10001
        finally:
            await laser.close()
            await server.stop()
    assert WHAT.get(what, "") in str(error)
    told = None if error is None else told_of(error)
    left_out = {"A": "the status is data; whoever measures decides on it and notes it"}
    facts = {"told": told, "absorbed": told is None, "wrong_values": wrong, "state": "refused" if told else "flagged", "resumed": resumed}
    assert_fault_contract(Observed("S8", case, left_out=left_out, **facts))
