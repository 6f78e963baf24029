"""Instruments with lines of text, made of a shell under socat: described by shipped files, tested, refused by name for what is wrong."""

from __future__ import annotations

import asyncio
import shutil
from collections.abc import Awaitable, Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from abbe.drivers.conformance.checks import Move
from abbe.drivers.conformance.device_test import Options, device_test, summary
from abbe.drivers.described.opening import described, open_meter, open_source
from abbe.drivers.described.tested import Ability
from abbe.drivers.device_file import BUILTIN
from abbe.drivers.errors import BadFrame, DeviceFault, NotProved, ReplyTimeout
from abbe.drivers.links.urls import parse_url
from abbe.drivers.registry import open_controller
from tests.drivers.described.foreign import HERE, free_port, listens, program, put, wait_for
from tests.drivers.described.test_device_test import UTC, kept, verdict

pytestmark = pytest.mark.timeout(120)
SENSOR = """
format = "abbe-device/1"
kind = "displacement"
name = "streaming sensor"
[line]
mode = "stream"
pattern = '(?P<displacement>[+-]?[0-9]+[.][0-9]{4}),(?P<state>[0-9])'
timeout_s = 1.0
[values.displacement]
unit = "mm"
[values.state]
[[flags]]
value = "state"
above = 0.5
means = "out of range"
[limits]
rate_hz = 100.0
"""


@pytest.fixture
def tools(require) -> None:
    require("socat", shutil.which("socat") is not None, "socat is not installed")
    require("bash", shutil.which("bash") is not None, "bash is not installed")


@contextmanager
def over_tcp(what: str, value: Path) -> Iterator[str]:
    port = free_port()
    with program("socat", f"TCP-LISTEN:{port},bind=127.0.0.1,reuseaddr,fork", f"EXEC:bash {HERE / 'foreign_gauge.sh'} {what} {value}"):
        wait_for(lambda: listens(port), "socat listens")
        yield f"socket://127.0.0.1:{port}"


@contextmanager
def over_pty(what: str, value: Path, folder: Path) -> Iterator[str]:
    link = folder / "line"
    with program("socat", f"PTY,raw,echo=0,link={link}", f"EXEC:bash {HERE / 'foreign_gauge.sh'} {what} {value}"):
        wait_for(link.exists, "the pty of socat")
        yield f"serial://{link}"


async def until_it_raises(ask: Callable[[], Awaitable[object]]) -> None:
    for _ in range(100):
        await ask()


def person(value: Path, rest: str, moved: dict[str, str], *, sent: Path | None = None) -> Callable[[str], Awaitable[None]]:
    """Somebody who changes what is measured when he is asked: the words of the question say what it is then.

    ``sent``: file in which an instrument notes what it has sent; the person answers only after it shows the change.
    """

    async def act(text: str) -> None:
        now = next((what for words, what in moved.items() if words in text), rest)
        put(value, now)
        if sent is not None:
            await asyncio.to_thread(wait_for, lambda: sent.exists() and sent.read_text().strip() == now, "the instrument sends the change")

    return act


def options(ask: Callable[[str], Awaitable[None]], faults: bool = True) -> Options:
    return Options(move=Move(5.0, 0.02), ask=ask, faults=faults)


@pytest.fixture
def value(tmp_path: Path, tools: None) -> Path:
    put(tmp_path / "value", "0.0")
    return tmp_path / "value"


async def test_a_polled_gauge_passes_with_its_shipped_file(value: Path) -> None:
    ask = person(value, "0.0", {"AWAY": "-5.0", "Block": "lifted"})
    with over_tcp("gauge", value) as url:
        report = await device_test(f"{url}?device=dial-gauge", options(ask), UTC)
    assert report.failed == ()
    assert (report.serial_no, report.abilities) == ("SN 7041", (Ability.WATCH, Ability.DWELL))
    assert verdict(report, "reply missing")[1].startswith("refused (ReplyTimeout: no line within 1 s), right again")
    assert verdict(report, "quality")[0] == "passed"


@pytest.mark.parametrize(
    ("away", "why"),
    [
        ("5.0", "sign: the reading grows the wrong way"),
        ("-0.19685", "scale: 5 mm is read as 0.1968 mm, 0.03936 times (it sends inches, the file says mm)"),
        ("0.0", "stuck: 5 mm is read as 0.0000 mm"),
    ],
    ids=["sign", "inches", "stuck"],
)
async def test_what_is_wrong_with_a_gauge_is_named(value: Path, away: str, why: str) -> None:
    with over_tcp("gauge", value) as url:
        report = await device_test(f"{url}?device=dial-gauge", options(person(value, "0.0", {"AWAY": away}), faults=False), UTC)
    assert report.abilities == ()
    assert why in verdict(report, "motion displacement")[1]


async def test_a_streaming_sensor_on_a_serial_line_passes(value: Path, tmp_path: Path) -> None:
    put(tmp_path / "sensor.toml", SENSOR)
    put(value, "100.0 0")
    ask = person(value, "100.0 0", {"AWAY": "105.0 0", "Block": "100.0 1"}, sent=tmp_path / "value.sent")
    with over_pty("sensor", value, tmp_path) as url:
        report = await device_test(f"{url}?device={tmp_path / 'sensor.toml'}&baud=9600", options(ask), UTC)
    assert report.failed == ()
    assert report.abilities == (Ability.WATCH, Ability.DWELL)
    assert verdict(report, "identity") == ("not proved", "streaming sensor: nothing in the device file identifies it")
    assert verdict(report, "connection cut")[0] == "not proved"


async def test_a_temperature_logger_is_only_shown(value: Path) -> None:
    put(value, "+20.43")
    with over_tcp("logger", value) as url:
        report = await device_test(f"{url}?device=temperature-logger", Options(faults=False), UTC)
        assert (report.failed, report.abilities) == ((), (Ability.WATCH,))
        assert summary(report).startswith("the device can be watched, but not used to measure")
        about = described(parse_url(f"{url}?device=temperature-logger"))
        source = await open_source(about.url, about.file)
        assert (await source.snapshot()).counts == {"temperature": 20.43}
        put(value, "OPEN")
        try:
            with pytest.raises(DeviceFault, match="reports 'OPEN'"):
                await until_it_raises(source.snapshot)
        finally:
            await source.close()


async def test_a_read_out_of_three_axes_is_a_control_that_is_listened_to(value: Path, tmp_path: Path) -> None:
    put(value, "1 2 3")
    ask = person(value, "1 2 3", {"axis X": "6 2 3", "axis Y": "1 7 3", "axis Z": "1 2 8"})
    with over_tcp("readout", value) as url:
        report = await device_test(f"{url}?device=digital-read-out", options(ask, faults=False), UTC)
        assert (report.failed, report.abilities) == ((), (Ability.WATCH, Ability.DWELL))
        control = await open_controller(f"{url}?device=digital-read-out&tested={kept(report, tmp_path)}")
        assert (await control.status()).position_mm == (1.0, 2.0, 3.0)
        with pytest.raises(NotProved, match="neither two banks nor read-back nor compare-and-swap"):
            await control.activate(1, expect_crc=0, expect_gen=0, owner=1)
        with pytest.raises(NotProved, match="takes no motion commands"):
            await control.move((0.0, 0.0, 0.0), feed_mm_min=100.0, timeout_s=1.0)
        await control.close()


async def test_another_instrument_is_told_by_its_lines(value: Path) -> None:
    put(value, "1 2 3")
    with over_tcp("readout", value) as url, pytest.raises((BadFrame, ReplyTimeout)):
        await open_meter(parse_url(f"{url}?device=dial-gauge"))


@pytest.mark.parametrize("path", sorted(BUILTIN.glob("*.toml")), ids=lambda path: path.stem)
def test_every_shipped_file_is_whole_and_says_where_it_is_from(path: Path) -> None:
    about = described(parse_url(f"socket://127.0.0.1:1?device={path.stem}"))
    assert about.file.source
    assert about.file.limits.rate_hz > 0
