"""Modbus with parties that nobody here wrote: mbpoll asks our simulators, our link a libmodbus server, socat writes down the frames."""

from __future__ import annotations

import asyncio
import re
import select
import shutil
import socket
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from abbe.drivers.errors import Refused
from abbe.drivers.links.modbus_link import Canary, ModbusLink, ModbusOperation
from abbe.drivers.links.urls import ModbusRtuUrl, ModbusTcpUrl
from abbe.models.compensation.tables import NineTables, grid_positions
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.push.operations import VerificationResult
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from abbe.simulators.cnc.device import Controller
from abbe.simulators.cnc.wire import CncRegisters
from abbe.simulators.faults.modbus_toxics import crc16
from abbe.simulators.laser.wire import LaserRegisters
from abbe.simulators.modbus_wire import ModbusRtu, ModbusTcp
from abbe.simulators.scenario import MachineConfig, Scenario
from abbe.simulators.truth.machine import Geometry
from abbe.simulators.world import World
from tests.faults.sequencer_world import bench
from tests.mbpoll import poll_table
from tests.patience import within

pytestmark = pytest.mark.timeout(60)
ROOT = Path(__file__).resolve().parents[2]
HEADER = Path("/usr/include/modbus/modbus.h")
SOURCE = Path(__file__).with_name("libmodbus_server.c")


# --- programs ------------------------------------------------------------------------------------------------------------------------


def wait_for(condition: Callable[[], object], what: str) -> None:
    end = time.monotonic() + within(10)
    while not condition():
        assert time.monotonic() < end, f"not within 10 s: {what}"
        select.select([], [], [], 0.01)


@contextmanager
def running(*words: str, log: Path | None = None) -> Iterator[subprocess.Popen[str]]:
    with (log or Path("/dev/null")).open("w") as err:
        process = subprocess.Popen(words, stdout=subprocess.PIPE, stderr=err, text=True)
        try:
            yield process
        finally:
            process.terminate()
            process.wait(timeout=within(10))
            assert process.stdout is not None
            process.stdout.close()


@contextmanager
def serial_pair(folder: Path) -> Iterator[tuple[Path, Path, Path]]:
    """Two joined ptys and the log of what passes between them."""
    ours, theirs, log = folder / "ours", folder / "theirs", folder / "traffic"
    with running("socat", "-v", "-x", f"pty,raw,echo=0,link={ours}", f"pty,raw,echo=0,link={theirs}", log=log):
        wait_for(lambda: ours.exists() and theirs.exists(), "socat's ptys")
        yield ours, theirs, log


@contextmanager
def listened(folder: Path, port: int) -> Iterator[tuple[int, Path]]:
    """A port that leads to another one, and the log of what passes."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        free = probe.getsockname()[1]
    log = folder / "traffic"
    words = ("socat", "-v", "-x", f"tcp-listen:{free},bind=127.0.0.1,reuseaddr,fork", f"tcp:127.0.0.1:{port}")
    with running(*words, log=log) as process:
        wait_for(
            lambda: f":{free:04X} 00000000:0000 0A" in Path("/proc/net/tcp").read_text() or process.poll() is not None, "socat listens"
        )
        yield free, log


def traffic(log: Path) -> str:
    """All bytes that passed, as hexadecimal, in order; what socat read in pieces is joined."""
    lines = re.findall(r"^ ((?:[0-9a-f]{2} ?)+)", log.read_text(errors="replace"), flags=re.MULTILINE)
    return " ".join(" ".join(lines).split())


async def mbpoll(*words: str) -> str:
    process = await asyncio.create_subprocess_exec("mbpoll", *words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    async with asyncio.timeout(within(20)):
        out, _ = await process.communicate()
    return out.decode()


def values(text: str) -> dict[int, str]:
    return {int(address): value for address, value in re.findall(r"\[(\d+)\]:\s+(\S+)", text)}


@pytest.fixture
def tools(require):
    for name in ("mbpoll", "socat"):
        require(name, shutil.which(name) is not None, f"{name} is not installed")


@pytest.fixture(scope="module")
def compiled(tmp_path_factory) -> Path | None:
    """The C server, if there is a compiler and libmodbus."""
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None or not HEADER.exists():
        return None
    program = tmp_path_factory.mktemp("libmodbus") / "server"
    subprocess.run([compiler, "-o", program, SOURCE, "-lmodbus"], check=True, capture_output=True, timeout=60)
    return program


@pytest.fixture
def libmodbus(require, compiled) -> str:
    require("libmodbus", compiled is not None, "libmodbus-dev and a C compiler are not installed")
    return str(compiled)


# --- our simulators, their clients ------------------------------------------------------------------------------------------------------


def laser_map() -> LaserRegisters:
    world = World(Scenario())
    return LaserRegisters(world.laser, 0xBEEF0001, lambda: None, world.tool_position)


def cnc_map() -> tuple[Controller, CncRegisters]:
    controller = Controller(Geometry(MachineConfig()))
    return controller, CncRegisters(controller, 0xCAFE0002, lambda: None)


async def test_mbpoll_reads_and_writes_the_controller_over_tcp(tools):
    controller, registers = cnc_map()
    server = ModbusTcp(registers)
    common = ("-m", "tcp", "-p", str(await server.start(0)), "-a", "1", "-0", "-1")
    found = await mbpoll(*common, "-t", "4:int", "-B", "-r", "26", "-c", "3", "127.0.0.1")
    assert [int(v) for v in values(found).values()] == [round(float(p) * 1e5) for p in controller.position_mm]
    await mbpoll(*common, "-t", "4", "-r", "80", "127.0.0.1", "1")  # one register: FC6
    assert controller.held
    words = [str(n) for n in range(100, 130)]
    await mbpoll(*common, "-t", "4", "-r", "6000", "127.0.0.1", *words)  # many: FC16
    assert controller.comp.words[1][:30] == list(range(100, 130))
    assert list(values(await mbpoll(*common, "-t", "4", "-r", "6000", "-c", "30", "127.0.0.1")).values()) == words
    refused = await mbpoll(*common, "-t", "4", "-r", "1000", "127.0.0.1", "5", "6")  # the active bank
    assert "Illegal data address" in refused
    await server.stop()


async def test_mbpoll_reads_and_writes_the_laser_over_rtu(tools, tmp_path):
    with serial_pair(tmp_path) as (ours, theirs, log):
        server = ModbusRtu(laser_map())
        await server.start(str(ours), 115200)
        common = ("-m", "rtu", "-b", "115200", "-P", "none", "-a", "1", "-0", "-1")
        assert float(values(await mbpoll(*common, "-t", "4:float", "-B", "-r", "2", str(theirs)))[2]) == 1234.5
        assert values(await mbpoll(*common, "-t", "3", "-r", "0", "-c", "4", str(theirs)))[0] in ("258", "0x0102")
        await mbpoll(*common, "-t", "4", "-r", "40", str(theirs), "1", "1", "0")
        acknowledged = values(await mbpoll(*common, "-t", "4", "-r", "43", "-c", "2", str(theirs)))
        assert list(acknowledged.values()) == ["1", "2"]  # executed, and refused: there is no mirror
        assert "Illegal data address" in await mbpoll(*common, "-t", "4", "-r", "100", str(theirs))
        await mbpoll(*common, "-t", "4", "-r", "0", "-c", "4", str(theirs))
        await server.stop()
        seen = traffic(log)
    for request, answer in examples("laser.md", "RTU"):
        assert f"{request} {answer}" in seen, request


def examples(page: str, line: str) -> list[tuple[str, str]]:
    """Byte examples of a page of docs/protocols on ``TCP`` or ``RTU``: request and answer as hexadecimal."""
    text = (ROOT / "docs" / "protocols" / page).read_text(encoding="utf-8")
    found = re.findall(rf"\({line}[^)]*\):\nrequest `([^`]+)` answer `([^`]+)`", text)
    assert found, f"no {line} examples in {page}"
    return [(request.lower(), answer.lower()) for request, answer in found]


def test_the_examples_are_whole_frames():
    for page in ("laser.md", "cnc.md"):
        for frame in (bytes.fromhex(one) for pair in examples(page, "TCP") for one in pair):
            assert int.from_bytes(frame[4:6], "big") == len(frame) - 6
    for frame in (bytes.fromhex(one) for pair in examples("laser.md", "RTU") for one in pair):
        assert crc16(frame[:-2]) == frame[-2:]


@pytest.mark.parametrize("page", ["laser.md", "cnc.md"])
async def test_the_simulators_answer_the_documented_frames(page):
    """The requests of docs/protocols as they are printed, over a bare socket."""
    registers = laser_map() if page == "laser.md" else cnc_map()[1]
    server = ModbusTcp(registers)
    reader, writer = await asyncio.open_connection("127.0.0.1", await server.start(0))
    for request, answer in examples(page, "TCP"):
        writer.write(bytes.fromhex(request))
        assert (await reader.readexactly(len(bytes.fromhex(answer)))).hex(" ") == answer
    writer.close()
    await writer.wait_closed()
    await server.stop()


async def test_our_link_sends_the_documented_frames(tools, tmp_path):
    server = ModbusTcp(cnc_map()[1])
    with listened(tmp_path, await server.start(0)) as (port, log):
        link = await ModbusLink.connect(ModbusTcpUrl("127.0.0.1", port))
        assert await link.read(0, 4) == (0x0102, 0x0304, 0x449A, 0x5000)
        await link.close()
        await server.stop()
        request, answer = examples("cnc.md", "TCP")[0]
        wait_for(lambda: answer in traffic(log), "the answer in socat's log")
        assert f"{request} {answer}" in traffic(log)


# --- their server, our link -------------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["tcp", "rtu"])
def server_url(request, require, libmodbus, tmp_path) -> Iterator[ModbusTcpUrl | ModbusRtuUrl]:
    if request.param == "tcp":
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        with running(libmodbus, "tcp", str(port)) as server:
            assert server.stdout is not None
            assert server.stdout.readline() == "ready\n"
            yield ModbusTcpUrl("127.0.0.1", port)
        return
    require("socat", shutil.which("socat") is not None, "socat is not installed")
    with serial_pair(tmp_path) as (ours, theirs, _), running(libmodbus, "rtu", str(theirs)) as server:
        assert server.stdout is not None
        assert server.stdout.readline() == "ready\n"
        yield ModbusRtuUrl(str(ours))


@pytest.mark.parametrize("canary", [None, Canary()])
async def test_our_link_reads_and_writes_a_libmodbus_server(server_url, canary):
    link = await ModbusLink.connect(server_url, canary=canary)
    assert await link.read(0, 4) == (0x0102, 0x0304, 0x449A, 0x5000)
    for count in (1, 2, 100, 125):
        assert await link.read(500, count, lead=20) == tuple(range(500, 500 + count))
    await link.write(700, range(3000, 3123), ModbusOperation.LEVEL)
    assert await link.read(700, 123) == tuple(range(3000, 3123))
    with pytest.raises(Refused, match="exception 2"):
        await link.read(990, 20)
    assert await link.read(999, 1) == (999,)
    assert link.connections == 1
    assert link.foreign_bytes == 0
    await link.close()
    again = await ModbusLink.connect(server_url, canary=canary)  # it takes one connection after the other
    assert await again.read(701, 1) == (3001,)
    await again.close()


async def test_mbpoll_reads_the_numbers_of_the_table_that_was_pushed(require, tmp_path):
    """The whole way of a table: the push machine writes it through our driver into the simulated controller, mbpoll reads it."""
    require("mbpoll", shutil.which("mbpoll") is not None, "mbpoll is not installed")

    async def yes() -> VerificationResult:
        return VerificationResult(True, "a stand-in")

    async with bench(tmp_path, seed=5) as b:
        b.sim.pace(20.0)
        grids = grid_positions(b.site.machine, (13, 11, 9))
        draws = np.random.default_rng(11)
        curves = [np.round(draws.uniform(-0.03, 0.03, (g.size, 3)), 4) for g in grids]  # both signs, 300 units and more
        none = [np.zeros_like(c) for c in curves]
        tables = NineTables(grids, (curves[0], curves[1], curves[2]), (none[0], none[1], none[2]))
        with Store.open(f"sqlite:///{tmp_path / 'abbe.sqlite3'}") as store:
            wanted = WantedTable(tables, await read_base(b.session.controller), 100, None, {})
            pushed = await Pushing(b.session.controller, store, b.site).bring(wanted, Questions(list, "a test", yes, yes))
        assert pushed.kept
        found = await poll_table(int(re.search(r":(\d+)", b.site.urls.cnc.partition("//")[2]).group(1)))
    assert found.bank == pushed.bank == 1 - pushed.previous_bank
    for a in range(3):
        assert found.position_mm[a] == pytest.approx(list(grids[a]), abs=1e-5)
        for i in range(3):
            assert found.correction_mm[a][i] == pytest.approx(list(curves[a][:, i]), abs=1e-9)
