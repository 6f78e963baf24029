"""`abbe device`: the shipped files, and the test of a device from the command line."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from abbe.drivers.device_file import BUILTIN
from abbe.service.cli import run


class Gauge:
    """A gauge that answers a dial gauge's question, in a thread of its own."""

    def __init__(self) -> None:
        self.port, self._ready, self._loop = 0, threading.Event(), asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_until_complete, args=(self._serve(),))
        self._thread.start()
        assert self._ready.wait(10.0)

    async def _serve(self) -> None:
        self._end = asyncio.Event()
        server = await asyncio.start_server(self._answer, "127.0.0.1", 0)
        self.port = server.sockets[0].getsockname()[1]
        self._ready.set()
        await self._end.wait()
        server.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while question := await reader.read(64):
            writer.write(b"SN 1\r" if question == b"ID?\r" else b"+001.2500\r")
        writer.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(10.0)
        self._loop.close()


@pytest.fixture
def gauge() -> Iterator[Gauge]:
    made = Gauge()
    yield made
    made.close()


def test_the_shipped_files_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["device", "list", "--json"]) == 0
    listed = json.loads(capsys.readouterr().out)
    assert {one["name"] for one in listed} == {path.stem for path in BUILTIN.glob("*.toml")}
    assert {one["kind"] for one in listed} == {"displacement", "position", "temperature"}


def test_a_shipped_file_is_printed_to_be_changed(tmp_path: Path) -> None:
    assert run(["device", "show", "dial-gauge", "--out", str(tmp_path / "mine.toml")]) == 0
    assert (tmp_path / "mine.toml").read_text() == (BUILTIN / "dial-gauge.toml").read_text()


def test_without_a_known_motion_a_device_is_only_shown_and_the_report_says_so(
    gauge: Gauge, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    report = tmp_path / "report.json"
    words = ["device", "test", f"socket://127.0.0.1:{gauge.port}?device=dial-gauge", "--no-faults", "--out", str(report)]
    assert run(words) == 0
    out = capsys.readouterr().out
    assert "digital dial gauge SN 1" in out
    assert "not proved motion displacement: no known motion was made (--move)" in out
    assert "the device can be watched, but not used to measure; not proved: motion displacement" in out
    assert json.loads(report.read_text())["abilities"] == ["watch"]


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (["socket://127.0.0.1:1?device=no-such"], "DRV-012"),
        (["socket://127.0.0.1:1?device=dial-gauge", "--move", "1", "--tolerance", "0.5"], "CFG-001"),
        (["modbus+tcp://127.0.0.1:1?device=dial-gauge"], "DRV-001"),
        (["socket://127.0.0.1:1?tested=x.json"], "DRV-001"),
        (["socket://127.0.0.1:1?device=dial-gauge"], "DRV-002"),
    ],
)
def test_what_cannot_be_tested_is_one_line(words: list[str], why: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["device", "test", *words]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f"error {why}: ")
    assert err.count("\n") == 1
