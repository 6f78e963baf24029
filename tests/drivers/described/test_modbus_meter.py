"""A Modbus meter of libmodbus with a foreign map and word order is opened by its file alone; what does not fit is refused by name."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from abbe.drivers.api import DisplacementMeter, air_is_compensated, beam_is_good
from abbe.drivers.described.opening import open_meter
from abbe.drivers.errors import BadDeviceFile, BadUrl, DeviceFault, Rebooted, ReplyTimeout, WrongDevice
from abbe.drivers.links.urls import parse_url
from tests.drivers.described.foreign import FILE, World


@pytest.fixture
async def meter(url: str) -> AsyncIterator[DisplacementMeter]:
    opened = await open_meter(parse_url(url))
    yield opened
    await opened.close()


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    """The device file with some text replaced."""
    text = FILE.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "changed.toml").write_text(text)
    return folder / "changed.toml"


async def displacement_mm(meter: DisplacementMeter) -> float:
    before = await meter.read()
    return (await meter.read(after_count=before.sample_count)).displacement_tenth_nm * 1e-7


async def test_it_measures_in_millimetres_away_from_it(meter: DisplacementMeter, world: World) -> None:
    world.set(ms=1000)
    world.move_to(3.0)
    await meter.zero()
    world.move_to(13.25)
    assert await displacement_mm(meter) == pytest.approx(10.25)
    world.set(ms=1234)
    reading = await meter.read()
    assert (reading.device_us, round(reading.air_temp_c, 2)) == (1_234_000, 20.5)
    assert air_is_compensated(reading.status)


async def test_its_identity_and_serial_number_come_from_its_registers(meter: DisplacementMeter) -> None:
    info = await meter.identify()
    assert (info.kind, info.model, info.serial_no, info.boot_id) == ("displacement", "foreign pulse counter", "40175", 77)


async def test_a_lost_beam_needs_a_new_zero(meter: DisplacementMeter, world: World) -> None:
    await meter.zero()
    world.set(state=1 << 2)
    with pytest.raises(DeviceFault, match="beam lost"):
        await displacement_mm(meter)
    world.set(state=0)
    with pytest.raises(DeviceFault, match="not zeroed"):
        await displacement_mm(meter)
    await meter.zero()
    world.set(state=1 << 3)
    assert not beam_is_good((await meter.read()).status)


async def test_a_stuck_counter_is_named(meter: DisplacementMeter, world: World) -> None:
    await meter.zero()
    first = await meter.read()
    world.set(stuck=1)
    latest = await meter.peek()
    with pytest.raises(ReplyTimeout, match=r"counter is stuck at \d+ .* repeats an old reading"):
        await meter.read(after_count=latest.sample_count)
    assert latest.sample_count > first.sample_count


async def test_a_counter_that_goes_back_is_a_restart_or_an_old_reply(meter: DisplacementMeter, world: World) -> None:
    await meter.zero()
    await meter.read()
    world.set(stuck=2)
    with pytest.raises(Rebooted, match=r"its counter went back from \d+ to \d+"):
        await meter.peek()
    with pytest.raises(DeviceFault, match="not zeroed"):
        await meter.read()


async def test_a_device_that_takes_single_registers_only(url: str, tmp_path: Path, world: World) -> None:
    other = changed(tmp_path, ("function = 4\n", "function = 4\nwrite_function = 6\n"))
    meter = await open_meter(parse_url(url.replace(str(FILE), str(other))))
    world.move_to(7.0)
    await meter.zero()
    assert await displacement_mm(meter) == pytest.approx(0.0)
    await meter.close()


@pytest.mark.parametrize("order", ["ABCD", "BADC", "DCBA"])
async def test_a_wrong_byte_order_in_the_file_is_named(url: str, tmp_path: Path, order: str) -> None:
    other = changed(tmp_path, ('order = "CDAB"', f'order = "{order}"'))
    with pytest.raises(WrongDevice, match=rf"byte order is CDAB \(low register first\), not {order}.*write order = \"CDAB\""):
        await open_meter(parse_url(url.replace(str(FILE), str(other))))


async def test_a_meter_with_the_other_byte_order_is_not_this_one(url: str, world: World) -> None:
    world.set(high_first=1)
    with pytest.raises(WrongDevice, match="byte order is ABCD"):
        await open_meter(parse_url(url))


async def test_another_device_is_refused(url: str, tmp_path: Path) -> None:
    other = changed(tmp_path, ("0x12345678", "0x11111111"))
    with pytest.raises(WrongDevice, match="register 100 holds 305419896"):
        await open_meter(parse_url(url.replace(str(FILE), str(other))))


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ((('unit = "nm"', 'unit = "ms"'),), "values.displacement.unit is 'ms', expected one of nm, um, mm, in"),
        ((("scale = 10.0", "scale = 0.0"),), "values.displacement.scale: Input should be greater than 0"),
        ((("sign = -1 ", "sgn = -1 "),), "values.displacement.sgn: unknown key"),
        ((("bit = 2", "bit = 2\nabove = 1.0"),), "expected bit, or below and/or above"),
        ((("address = 110", "address = 300"),), "more than 125 registers apart"),
        ((('kind = "displacement"', 'kind = "position"'),), r"needs \[values.x\]"),
        ((("[modbus]", "[modbus"),), "Expected"),
        ((("holds = 0x12345678", "holds = 0x112345678"),), "4600387192 is no u32"),
    ],
)
async def test_a_file_that_cannot_be_right_is_one_line(url: str, tmp_path: Path, changes: tuple[tuple[str, str], ...], why: str) -> None:
    with pytest.raises(BadDeviceFile, match=why) as refusal:
        await open_meter(parse_url(url.replace(str(FILE), str(changed(tmp_path, *changes)))))
    assert "\n" not in str(refusal.value)


async def test_a_missing_file_names_the_shipped_ones(url: str) -> None:
    with pytest.raises(BadDeviceFile, match="does not exist"):
        await open_meter(parse_url(url.replace(str(FILE), "no-such-device")))
    with pytest.raises(BadUrl, match="another kind of line"):
        await open_meter(parse_url(f"socket://127.0.0.1:1?device={FILE}"))


async def test_on_rtu_the_known_registers_prove_every_reply(rtu_url: str, world: World) -> None:
    meter = await open_meter(parse_url(rtu_url))
    try:
        await meter.zero()
        world.move_to(-2.5)
        assert await displacement_mm(meter) == pytest.approx(-2.5)
    finally:
        await meter.close()
