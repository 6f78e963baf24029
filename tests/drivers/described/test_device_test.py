"""`abbe device test`: the foreign meter passes, and its report opens it for measurements; what is wrong with it is refused by name."""

from __future__ import annotations

import json
from collections.abc import Awaitable, Callable
from dataclasses import replace
from pathlib import Path

import pytest

from abbe.drivers.conformance.checks import Move
from abbe.drivers.conformance.device_test import Options, device_test, summary
from abbe.drivers.described.tested import Ability, CheckVerdict, TestReport
from abbe.drivers.errors import NotProved
from abbe.drivers.registry import open_laser
from tests.drivers.described.foreign import FILE, World
from tests.drivers.described.test_modbus_meter import changed

UTC = "2026-11-26T00:00:00+00:00"
MOVE = Move(10.0, 0.05)


def person(world: World) -> Callable[[str], Awaitable[None]]:
    """Somebody beside the meter, who does what he is asked."""

    async def act(text: str) -> None:
        if text.startswith("Move it back"):
            world.move_to(0.0)
        elif text.startswith("Move the target 10 +- 0.05 mm AWAY"):
            world.move_to(10.0)
        elif text.startswith("Block the beam"):
            world.set(state=1 << 2)
        else:
            assert text == "Clear the beam again, or let the plunger back into its range."
            world.set(state=0)

    return act


async def report_of(url: str, world: World, **changes: object) -> TestReport:
    return await device_test(url, replace(Options(move=MOVE, ask=person(world), faults=False), **changes), UTC)  # type: ignore[arg-type]


def kept(report: TestReport, folder: Path) -> Path:
    (folder / "report.json").write_text(json.dumps(report.to_document()))
    return folder / "report.json"


def verdict(report: TestReport, check: str) -> tuple[str, str]:
    return next((str(one.verdict), one.text) for one in report.findings if one.check == check)


async def test_the_foreign_meter_passes_and_measures(url: str, world: World, tmp_path: Path) -> None:
    report = await report_of(url, world, faults=True)
    assert report.failed == ()
    assert (report.model, report.serial_no, report.abilities) == ("foreign pulse counter", "40175", (Ability.WATCH, Ability.DWELL))
    assert verdict(report, "byte order") == ("passed", "CDAB, by the identity registers")
    assert verdict(report, "motion displacement")[1].startswith(
        "10 mm read as 10.0000 mm and +0.0000 mm back: sign right, scale right to 0.5 %"
    )
    assert verdict(report, "quality") == ("passed", "an invalid reading is refused: beam lost")
    played = [one for one in report.findings if one.check.startswith(("reply", "connection"))]
    assert [one.check for one in played] == ["reply late", "reply doubled", "reply spoilt", "reply missing", "connection cut"]
    assert summary(report).startswith("the device can measure")
    meter = await open_laser(f"{url}&tested={kept(report, tmp_path)}")
    await meter.close()


async def test_no_job_opens_a_device_that_was_not_tested(url: str, world: World, tmp_path: Path) -> None:
    with pytest.raises(NotProved, match=r"sign, scale and freshness are not proved.*abbe device test"):
        await open_laser(url)
    report = kept(await report_of(url, world, move=None), tmp_path)
    with pytest.raises(NotProved, match="motion displacement: no known motion was made"):
        await open_laser(f"{url}&tested={report}")
    report.write_text(report.read_text().replace("40175", "40176"))
    with pytest.raises(NotProved, match="device 40175 answers, but device 40176 was tested"):
        await open_laser(f"{url}&tested={report}")
    other = changed(tmp_path, ("resolution = 10.0", "resolution = 20.0"))
    with pytest.raises(NotProved, match="the device file has changed since its test"):
        await open_laser(f"{url.replace(str(FILE), str(other))}&tested={report}")
    report.write_text("{}")
    with pytest.raises(NotProved, match="no report of a device test"):
        await open_laser(f"{url}&tested={report}")


@pytest.mark.parametrize(
    ("changes", "check", "why"),
    [
        ((("sign = -1 ", "sign = 1 "),), "motion displacement", "sign: the reading grows the wrong way, change sign in the device file"),
        ((("scale = 10.0", "scale = 20.0"),), "motion displacement", "scale: 10 mm is read as 20.0000 mm, 2 times (an interferometer"),
        ((("scale = 10.0", "scale = 13.7"),), "motion displacement", "1.37 times; divide scale in the device file by 1.37"),
        ((('unit = "nm"', 'unit = "um"'),), "motion displacement", "1000 times (the unit is 1000 times too large)"),
        (
            (('type = "i32"\nunit = "nm"', 'type = "i32"\norder = "ABCD"\nunit = "nm"'),),
            "motion displacement",
            "byte order: in order CDAB the registers read 10.0000 mm, in ABCD they do not",
        ),
        ((("address = 110", "address = 108"),), "motion displacement", "stuck: 10 mm is read as 0.0000 mm: the reading does not follow"),
        ((("bit = 2", "bit = 9"),), "quality", "a blocked or lifted sensor still reads as valid"),
        ((("address = 114", "address = 104"),), "readings", "its counter is stuck at 77"),
    ],
    ids=["sign", "twice", "odd scale", "unit", "byte order", "wrong register", "quality bit", "stuck counter"],
)
async def test_what_is_wrong_is_named(
    url: str, world: World, tmp_path: Path, changes: tuple[tuple[str, str], ...], check: str, why: str
) -> None:
    limits = ("range_mm = [-1000.0, 1000.0]\n", "")
    wrong = url.replace(str(FILE), str(changed(tmp_path, *changes, limits)))
    report = await report_of(wrong, world)
    found = verdict(report, check)
    assert found[0] == CheckVerdict.FAILED
    assert why in found[1]
    assert report.abilities == ()
    with pytest.raises(NotProved, match="its device test did not prove this"):
        await open_laser(f"{wrong}&tested={kept(report, tmp_path)}")
