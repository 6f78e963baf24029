"""A meter with a protocol of its own: a module of some hundred lines and one entry point, and it is opened, tested and refused like all."""

from __future__ import annotations

import asyncio
import importlib
import json
import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from zlib import crc32

import pytest

from abbe.drivers.api import LaserReading
from abbe.drivers.conformance import probe
from abbe.drivers.conformance.checks import Move
from abbe.drivers.conformance.device_test import Options, device_test
from abbe.drivers.described.tested import Ability
from abbe.drivers.errors import BadUrl, NotProved
from abbe.drivers.links.urls import beside
from abbe.drivers.registry import open_controller, open_laser
from abbe.service.config import load_machine
from abbe.service.jobs.doctor import examine
from tests.drivers.acme import meter as driver

LONGEST = 150


class Device:
    """The device: what it stands at, um; ``sign`` turns it round."""

    def __init__(self) -> None:
        self.um, self.sign, self.number, self.status = 0.0, 1.0, 0, 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while request := await reader.read(1):
            self.number += 1
            body = b"ACME0007" if request == b"i" else struct.pack("<Iid", self.number, self.status, self.sign * self.um)
            answer = request + body
            writer.write(answer + crc32(answer).to_bytes(4, "little"))
        writer.close()

    async def person(self, text: str) -> None:
        self.um = 10_000.0 if "AWAY" in text else 0.0
        self.status = int(text.startswith("Block"))


@pytest.fixture
async def device(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[tuple[Device, str]]:
    info = tmp_path / "acme_meter-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: acme-meter\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[abbe.drivers]\nacme-meter = tests.drivers.acme.meter:DRIVER\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    importlib.invalidate_caches()
    made = Device()
    server = await asyncio.start_server(made.serve, "127.0.0.1", 0)
    yield made, f"acme-meter://127.0.0.1:{server.sockets[0].getsockname()[1]}"
    server.close()


def test_a_driver_is_short() -> None:
    assert driver.__file__ is not None
    assert len(Path(driver.__file__).read_text().splitlines()) <= LONGEST


async def test_it_passes_the_test_of_devices(device: tuple[Device, str]) -> None:
    acme, url = device
    report = await device_test(url, Options(move=Move(10.0, 0.01), ask=acme.person), "2026-11-26T00:00:00+00:00")
    assert report.failed == ()
    assert (report.model, report.serial_no, report.abilities) == ("acme meter", "ACME0007", (Ability.WATCH, Ability.DWELL))
    acme.sign = -1.0
    report = await device_test(url, Options(move=Move(10.0, 0.01), ask=acme.person, faults=False), "2026-11-26T00:00:00+00:00")
    assert [one.check for one in report.failed] == ["motion displacement"]
    assert report.failed[0].text.startswith("sign: the reading grows the wrong way")


async def test_the_doctor_says_which_driver_is_not_tested(device: tuple[Device, str], tmp_path: Path) -> None:
    acme, url = device
    report = await device_test(url, Options(move=Move(10.0, 0.01), ask=acme.person), "2026-11-26T00:00:00+00:00")
    (tmp_path / "report.json").write_text(json.dumps(report.to_document()))
    file = tmp_path / "abbe.toml"
    for tested, state in (("", "look"), ("?tested=report.json", "good")):
        file.write_text(
            'name = "m"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 600]\nY = [0, 500]\nZ = [0, 450]\n'
            f'[devices]\nlaser = "{url}{tested}"\n'
        )
        (laser,) = [one async for one in examine(load_machine(file), datetime.now(UTC)) if one.what == "laser"]
        assert (laser.state, "abbe device test" in laser.remedy) == (state, state == "look"), laser


Read = Callable[..., Awaitable[LaserReading]]


async def _again(read: Read, meter: driver.AcmeMeter, after_count: int | None = None) -> LaserReading:
    """A meter that is read faster than it measures."""
    reading = await read(meter)
    return replace(reading, sample_count=reading.sample_count // 4)


async def _by_the_wall(read: Read, meter: driver.AcmeMeter, after_count: int | None = None) -> LaserReading:
    reading = await read(meter, after_count=after_count)
    return replace(reading, host_s=reading.host_s + 1.7e9)


async def _careless(read: Read, meter: driver.AcmeMeter, after_count: int | None = None) -> LaserReading:
    raise ValueError("invalid literal for int()")


async def _patient(read: Read, meter: driver.AcmeMeter, after_count: int | None = None) -> LaserReading:
    await asyncio.Event().wait()
    raise AssertionError


@pytest.mark.parametrize(
    ("wrong", "check", "words"),
    [
        (_again, "freshness", "again"),
        (_by_the_wall, "clock", "is it time.monotonic"),
        (_careless, "driver", "read raised ValueError: invalid literal for int(); only errors of abbe.drivers.errors are allowed"),
        (_patient, "driver", "read had not ended after 0.3 s: the driver needs a time-out"),
    ],
    ids=["old samples", "another clock", "raw errors", "no time-out"],
)
async def test_what_a_driver_does_wrong_is_named(
    device: tuple[Device, str], monkeypatch: pytest.MonkeyPatch, wrong: Callable[..., Awaitable[LaserReading]], check: str, words: str
) -> None:
    right = driver.AcmeMeter.read

    async def read(meter: driver.AcmeMeter, *, after_count: int | None = None) -> LaserReading:
        return await wrong(right, meter, after_count)

    monkeypatch.setattr(driver.AcmeMeter, "read", read)
    if wrong is _patient:
        monkeypatch.setattr(probe, "CALL_S", 0.3)
    report = await device_test(device[1], Options(faults=False), "2026-11-26T00:00:00+00:00")
    assert [one.check for one in report.failed] == [check]
    assert words in report.failed[0].text
    assert report.abilities == ()


async def test_a_report_in_the_url_is_honoured(device: tuple[Device, str], tmp_path: Path) -> None:
    acme, url = device
    report = await device_test(url, Options(move=Move(10.0, 0.01), ask=acme.person, faults=False), "2026-11-26T00:00:00+00:00")
    (tmp_path / "right.json").write_text(json.dumps(report.to_document()))
    acme.sign = -1.0
    report = await device_test(url, Options(move=Move(10.0, 0.01), ask=acme.person, faults=False), "2026-11-26T00:00:00+00:00")
    (tmp_path / "wrong.json").write_text(json.dumps(report.to_document()))
    await (await open_laser(beside(f"{url}?tested=right.json", tmp_path))).close()
    with pytest.raises(NotProved, match="motion displacement: sign"):
        await open_laser(beside(f"{url}?tested=wrong.json", tmp_path))


async def test_a_driver_that_is_not_whole_is_refused_by_name(device: tuple[Device, str], monkeypatch: pytest.MonkeyPatch) -> None:
    _, url = device
    with pytest.raises(BadUrl, match="opens no cnc"):
        await open_controller(url)
    monkeypatch.delattr(driver.AcmeMeter, "peek")
    with pytest.raises(BadUrl, match="meter:DRIVER lacks peek"):
        await open_laser(url)
