"""Devices that answer and are of no use: found before anything moves, on real wires, by one line that names them."""

from __future__ import annotations

import struct
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.drivers.errors import DriverError, Refused, ReplyTimeout, SettingsChanged, WrongDevice
from abbe.service.campaigns.device_checks import needed_by
from abbe.service.campaigns.measure import measure
from abbe.service.compensation.correct import correct
from abbe.service.compensation.gate import PushContext, admit
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.recipe import HelixPoints
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.storage.store import Store
from abbe.simulators.ballbar import device
from abbe.simulators.ballbar.wire import WITH_SETTINGS_BCD
from tests.faults import modbus_rig
from tests.faults.sequencer_world import MACHINE, Bench, bench, small


@pytest.fixture
async def place(tmp_path: Path) -> AsyncIterator[tuple[Bench, Store]]:
    async with bench(tmp_path, speed=100.0) as made:
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            yield made, store


async def refused(b: Bench, store: Store, kind: str, error: type[Exception], match: str) -> None:
    """The measurement is refused, the controller was told of no motion, and nothing is stored."""
    with pytest.raises(error, match=match):
        await measure(b.session, store, b.site, CampaignPlan("c", (small(kind),)))
    assert b.sim.motions() == []
    assert store.campaigns.all() == []


def test_what_a_campaign_needs_is_read_off_its_steps() -> None:
    line, helix = small("Linear", label="line"), small("Helix", label="helix", rate_hz=200)
    points = HelixPoints("points", "S", "identify", (300.0, 250.0, 100.0), 30.0, points=5, samples=5).plan(MACHINE)
    assert needed_by(CampaignPlan("c", (line,))).first == {"cnc": "all motion", "laser": "test line", "fixture": "test line"}
    both = needed_by(CampaignPlan("c", (line, helix)))
    assert (both.first["ballbar"], both.first["laser"], both.rate_hz) == ("test helix", "test line", 200)
    assert needed_by(CampaignPlan("c", (points,))).rate_hz == 1000, "the mean of a place is read at full rate"
    assert needed_by(CampaignPlan("c", (helix,)), air=True).first["laser"] == "run_temperature_c"


async def of_firmware_1_1(b: Bench) -> None:
    """The same box with a firmware that tells how it reads, met anew."""
    b.sim.box._firmware, b.sim.world.ballbar.tells_settings = WITH_SETTINGS_BCD, True
    await b.session.need_ballbar().identify()


async def test_a_box_that_was_set_to_inches_since_it_was_opened(place: tuple[Bench, Store]) -> None:
    b, store = place
    await of_firmware_1_1(b)
    b.sim.world.ballbar.switch(inch=True, range_mm=1.0, zero_mm=0.0)
    await refused(b, store, "Helix", SettingsChanged, "the box is set to .*inch")


async def test_a_box_whose_range_is_set_to_nothing(place: tuple[Bench, Store]) -> None:
    b, store = place
    b.sim.world.ballbar.switch(inch=False, range_mm=0.02, zero_mm=0.0)
    await of_firmware_1_1(b)
    await refused(b, store, "Helix", Refused, r"range is set to \+-0\.02 mm, but \+-0\.1 mm are needed")


async def test_a_box_that_cannot_send_so_fast(place: tuple[Bench, Store], monkeypatch: pytest.MonkeyPatch) -> None:
    b, store = place
    monkeypatch.setattr("abbe.simulators.ballbar.wire.MAX_RATE_HZ", device.MAX_RATE_HZ // 20)
    await refused(b, store, "Helix", Refused, "100 Hz requested, but the box sends at most 50")


@pytest.mark.parametrize(
    ("shown", "error", "match"),
    [
        ({10: 0, 11: 7}, ReplyTimeout, "no new sample within 2 s"),
        ({23: 0, 24: 0}, WrongDevice, "air pressure reads 0 Pa"),
        ({22: struct.unpack(">H", struct.pack(">h", -27315))[0]}, WrongDevice, r"air temperature reads -273\.15 C"),
    ],
    ids=["frozen", "no pressure", "no temperature"],
)
async def test_a_laser_whose_reading_is_none(
    place: tuple[Bench, Store], shown: dict[int, int], error: type[DriverError], match: str
) -> None:
    b, store = place
    async with modbus_rig.opened("laser") as other:
        other.registers.shown |= shown
        await refused(replace(b, session=replace(b.session, laser=other.laser)), store, "Linear", error, match)


async def test_a_laser_that_is_not_aligned_yet_is_no_reason(place: tuple[Bench, Store]) -> None:
    b, store = place
    b.sim.pace(100.0)
    assert (await b.session.need_laser().peek()).status >> 4 & 1, "no reflector: nobody has mounted anything"
    (run,) = await measure(b.session, store, b.site, CampaignPlan("c", (small("Linear"),)))
    assert store.runs.find(run).status == "complete"


@pytest.mark.parametrize("missing", ["ballbar", "laser", "fixture"])
async def test_no_table_is_written_that_could_not_be_measured_afterwards(place: tuple[Bench, Store], missing: str) -> None:
    b, store = place
    session = replace(b.session, **{missing: None})
    with pytest.raises(ConfigError, match=f"add {missing} = "):
        await correct(PushContext(session, store, b.site), "june", [])
    with pytest.raises(ConfigError, match=f"add {missing} = "):
        await admit(PushContext(session, store, b.site), 1)
    assert b.sim.table_accesses() == []
