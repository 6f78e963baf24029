"""The channel: only its own messages pass, none is too long, and the web process has no way past it."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import sys
from collections.abc import AsyncIterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from abbe.service.channel import messages as m
from abbe.service.channel.messages import FULL_B, Wire
from abbe.service.clock import SystemClock
from abbe.service.config import load_machine
from abbe.service.core import web_process
from abbe.service.core.web_process import WebProcess
from abbe.service.domain.machine import AxisMaterial, Issuer, Item, MachineObject, Rules
from abbe.service.domain.machine_file import FileEdit, MachineFileSummary, StatedValue
from abbe.service.domain.progress import DeviceStatus, JobState, MachineReading, RecordedPath, RunningCheck
from abbe.service.domain.schedule import DueSlot, Needs, Schedule
from abbe.service.errors import ChannelBroken, CoreUnavailable
from abbe.service.storage.store import Store
from abbe.service.web.core_link.core_line import QUEUE, SILENT_S, CoreLine
from abbe.service.web.process import import_guard
from tests.patience import within
from tests.service.core.fakes import FakeClock, settle, utc

NOW = utc(2026, 11, 22, 6)
MACHINE = MachineObject.read({"chain": "w-Y-X-b-Z-t", "vertical_axis": "Z", "stroke_mm": dict.fromkeys("XYZ", (0.0, 600.0))})
MOMENT = m.Snapshot(
    "snapshot",
    3,
    RunningCheck(
        id="0123456789ab",
        schedule="weekly",
        recipe="quick-check",
        since_utc=NOW,
        stage="helix",
        message="revolution 3 of 10",
        done=3.0,
        total=10.0,
        eta_s=42.0,
        step=2,
        steps=7,
        points=5,
        prompt=3,
        ask="hang in the bar",
    ),
    (DeviceStatus(role="laser", url="modbus+tcp://127.0.0.1:5021", state="in use", at_utc=NOW),),
    (DueSlot(schedule=Schedule("weekly", "0 6 * * 1", "Europe/Berlin", "quick-check", needs=Needs(idle=True)), slot_utc=NOW),),
    True,
    2,
    ("DRV-002: refused",),
    77_000_000,
    1,
)
JOB = JobState(
    id="0123456789ab", kind="check", recipe="quick-check", schedule="", who="user:bob", state="paused", text="door", begun_utc=NOW
)
CORE = [
    m.Begin(
        "begin",
        1,
        "mill-7",
        "0.1.0",
        "sqlite:///x",
        "",
        ("localhost",),
        "",
        "",
        ("quick-check",),
        8080,
        False,
        (),
        Rules(
            {},
            None,
            None,
            {"X": AxisMaterial(11.5e-6, 0.6e-6, None, 0.2, 0.0)},
            {"laser": "serial 2"},
            Issuer(laboratory="L", city="Bonn", country="DE", person="A"),
            Item(serial="4711"),
        ),
        m.MachineSummary(
            MachineObject.read({"chain": "w-Y-X-b-Z-t", "vertical_axis": "Z", "stroke_mm": dict.fromkeys("XYZ", (0.0, 600.0))}), 6000.0
        ),
        ("identification",),
        1024,
        "modbus+tcp://127.0.0.1:502",
        True,
        MachineFileSummary("/etc/abbe/mill.toml", "ab" * 32, (StatedValue("limits.table_value_um", "80.0", "file", 12),)),
    ),
    MOMENT,
    m.Jobs("jobs", (JOB, replace(JOB, ended_utc=NOW, verification=7))),
    m.LiveMachine(
        "machine",
        MachineReading(
            at_ms=1.5,
            position_mm=(1.0, 2.0, 3.0),
            feed_mm_min=None,
            override_percent=100,
            door_open=False,
            air_c=20.5,
            laser_at_ms=None,
            laser_mm=None,
            beam_good=False,
        ),
    ),
    m.LivePath(
        "path",
        RecordedPath(
            number=3,
            run="helix1",
            test="ballbar_helix",
            radius_mm=150.0,
            feed_mm_min=2000.0,
            rate_hz=1000,
            duration_s=84.2,
            angle_deg=(0.0, 90.5),
        ),
    ),
    m.LiveSamples("samples", 3, 4050, 1.7e12, "AACAPw=="),
    m.Answer("answer", 1, "busy", "the machine measures", ""),
]
WEB = [
    m.Serving("up", 1),
    m.WebHeartbeat("alive"),
    m.StartJob(request=1, recipe="quick-check", key="k", who="user:bob", alarm=0, resume=""),
    m.SteerJob(request=2, job="0" * 12, how="pause", who="x"),
    m.ConfirmPrompt(request=3, job="0" * 12, prompt=2, who="user:bob"),
    m.RollBack(request=3, push=7, crc=0xFFFFFFFF, reason="worse since then", key="k", who="user:ann"),
    m.PushNow(request=4, proposal=3, key="k", who="user:ann"),
    m.ChangeFile(request=5, sha256="ab" * 32, edits=(FileEdit("verify.helix_rms_um", "6.5"),), reason="new", looser=True, who="user:ann"),
]


@pytest.mark.parametrize("message", CORE, ids=lambda message: message.kind)
def test_what_the_core_says_arrives(message: Any) -> None:
    assert m.from_core(m.encode(message)) == message
    with pytest.raises(ChannelBroken):
        m.from_web(m.encode(message))


@pytest.mark.parametrize("message", WEB, ids=lambda message: message.kind)
def test_what_the_web_process_says_arrives(message: Any) -> None:
    assert m.from_web(m.encode(message)) == message
    with pytest.raises(ChannelBroken):
        m.from_core(m.encode(message))


def test_every_message_is_tried_here() -> None:
    assert {type(message) for message in CORE} == set(m.FromCore.__args__)
    assert {type(message) for message in WEB} == set(m.FromWeb.__args__)


@pytest.mark.parametrize("message", [*CORE, *WEB], ids=lambda message: message.kind)
def test_a_message_that_lacks_or_adds_something_is_refused(message: Any) -> None:
    read = m.from_core if message in CORE else m.from_web
    whole = json.loads(m.encode(message))
    for name in (one.name for one in fields(message)):
        with pytest.raises(ChannelBroken):
            read(json.dumps({k: v for k, v in whole.items() if k != name}).encode())
        with pytest.raises(ChannelBroken):
            read(json.dumps({**whole, name: {"another": "type"}}).encode())
    with pytest.raises(ChannelBroken):
        read(json.dumps({**whole, "register": 40001}).encode())


@pytest.mark.parametrize(
    "message",
    [
        m.StartJob(request=1, recipe="x" * 201, key="", who="user:bob", alarm=0, resume=""),
        m.StartJob(request=-1, recipe="x", key="", who="user:bob", alarm=0, resume=""),
        m.SteerJob(request=1, job="0", how="fly", who="x"),  # type: ignore[arg-type]
        m.RollBack(request=1, push=7, crc=2**32, reason="worse", key="k", who="user:ann"),
        m.RollBack(request=1, push=7, crc=1, reason="", key="k", who="user:ann"),
        m.RollBack(request=1, push=7, crc=1, reason="x" * 501, key="k", who="user:ann"),
        replace(MOMENT, core_rss_bytes=2**63),
        replace(MOMENT, check=replace(MOMENT.check, done=float("nan"))),  # type: ignore[type-var]
        replace(MOMENT, attention=("x" * 4000,) * 21),
        m.Jobs("jobs", (JOB,) * (m.MOST_JOBS + 1)),
    ],
)
def test_what_is_out_of_bounds_is_not_even_sent(message: Any) -> None:
    with pytest.raises(ChannelBroken):
        m.encode(message)


def test_the_longest_messages_are_short_enough() -> None:
    worst = m.Jobs(
        "jobs",
        tuple(replace(JOB, recipe="r" * 200, who="w" * 200, state="s" * 200, ask="a" * 200, text="t" * 4000) for _ in range(m.MOST_JOBS)),
    )
    assert len(m.encode(worst)) < m.LARGEST_B


@settings(max_examples=60)
@given(
    st.binary(max_size=300)
    | st.recursive(st.none() | st.integers() | st.text(), lambda v: st.dictionaries(st.text(), v)).map(lambda v: json.dumps(v).encode())
)
def test_anything_else_is_refused_in_one_way(body: bytes) -> None:
    for read in (m.from_core, m.from_web):
        with pytest.raises(ChannelBroken):
            read(body)


# ---- the wire -----------------------------------------------------------------------------------------------------------------------


@dataclass
class Pair:
    core: Wire
    web: Wire
    raw: socket.socket | None = None


@pytest.fixture
async def pair() -> AsyncIterator[Pair]:
    ours, theirs = socket.socketpair()
    made = Pair(await Wire.over(ours), await Wire.over(theirs))
    yield made
    made.core.close()
    made.web.close()
    await settle()


async def test_messages_in_order_and_the_end(pair: Pair) -> None:
    for message in CORE:
        pair.core.send(message)
    assert [m.from_core(await pair.web.receive() or b"") for _ in CORE] == CORE
    pair.core.close()
    assert await pair.web.receive() is None


async def test_an_announced_giant_is_refused_before_it_is_read() -> None:
    ours, theirs = socket.socketpair()
    wire = await Wire.over(ours)
    theirs.sendall((m.LARGEST_B + 1).to_bytes(4, "big"))
    with pytest.raises(ChannelBroken, match="announced"):
        await wire.receive()
    wire.close()
    theirs.close()
    await settle()


async def test_half_a_message_is_an_end() -> None:
    ours, theirs = socket.socketpair()
    wire = await Wire.over(ours)
    theirs.sendall(b"\0\0\0\7abc")
    theirs.close()
    assert await wire.receive() is None
    wire.close()
    await settle()


async def test_who_does_not_read_is_not_waited_for(pair: Pair) -> None:
    sent = 0
    while not pair.core.is_full:
        pair.core.send(replace(MOMENT, attention=("x" * 4000,) * 20))
        sent += 1
    assert sent * 80_000 < 2 * FULL_B + 1_000_000  # what the operating system keeps comes on top


# ---- the core as the web process sees it --------------------------------------------------------------------------------------------


async def test_old_news_are_not_shown_and_listeners_are_bounded(pair: Pair) -> None:
    clock = FakeClock(NOW)
    line = CoreLine(pair.web, clock)
    with pytest.raises(CoreUnavailable):
        line.snapshot()
    listening = asyncio.create_task(line.listen())
    with line.listener() as snapshots:
        assert snapshots is not None
        for changes in range(1, 3 * QUEUE):
            pair.core.send(replace(MOMENT, changes=changes))
        pair.core.send(m.Jobs("jobs", (JOB,)))
        pair.core.close()  # everything before the end is heard before the end
        await listening
        assert (line.snapshot().changes, line.jobs()) == (3 * QUEUE - 1, (JOB,))
        line.end()
        heard = [moment.changes async for moment in snapshots()]
        assert heard == list(range(2 * QUEUE + 1, 3 * QUEUE))  # the newest that fit, and the end
    clock.now_s += SILENT_S + 0.1
    for look in (line.snapshot, line.jobs, line.next_due, lambda: line.job, lambda: line.devices):
        with pytest.raises(CoreUnavailable):
            look()
    with pytest.raises(CoreUnavailable):
        await line.start("quick-check", "", "user:bob")


# ---- the wall, and the process --------------------------------------------------------------------------------------------------


def test_the_web_process_loads_nothing_that_reaches_a_device() -> None:
    """In a fresh interpreter: everything that the process loads, and what it is refused afterwards."""
    program = (
        "import sys\nimport abbe.service.web.process.__main__\nfrom abbe.service.web.process import import_guard\nimport_guard.install()\n"
        "import abbe.service.web.process.serving, abbe.service.logs\n"
        "bad = [name for name in sys.modules if import_guard.is_forbidden(name)]\nassert not bad, bad\n"
        "for name in ('abbe.drivers.registry', 'pymodbus.client', 'serial', 'abbe.service.push.execute'):\n"
        "    try:\n        __import__(name)\n    except ImportError as error:\n        assert 'does not import' in str(error), error\n"
        "    else:\n        raise AssertionError(name)\nprint('shut')\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "shut\n"), done.stderr


def test_the_wall_knows_parts_from_beginnings() -> None:
    assert [
        import_guard.is_forbidden(name)
        for name in ("abbe.drivers.registry", "abbe.drivers.api", "serial", "serialise", "abbe.service.web", "abbe.service.core.jobs")
    ] == [
        True,
        False,
        True,
        False,
        False,
        True,
    ]


@dataclass
class Nothing:
    """A book without jobs."""

    asked: list[Any] = field(default_factory=list)

    def latest(self) -> tuple[JobState, ...]:
        return ()


def seen_by_others(pid: int) -> str:
    """Environment and command line of a process."""
    return "".join(Path(f"/proc/{pid}/{name}").read_text() for name in ("environ", "cmdline"))


async def test_a_web_process_that_hangs_or_dies_is_replaced(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """The real process: killed, then frozen; each time there is another one, and at the end there is none."""
    url = f"sqlite:///{tmp_path / 'abbe.sqlite3'}"
    Store.open(url).close()
    monkeypatch.setattr(web_process, "HANG_S", 4.0)
    monkeypatch.setenv("ABBE_MQTT__URL", "mqtt://user:secret@broker")
    with socket.create_server(("127.0.0.1", 0)) as listening:
        up = asyncio.Event()
        begin = replace(CORE[0], store_url=url)  # type: ignore[type-var]
        web = WebProcess(begin, listening, lambda restarts: replace(MOMENT, web_restarts=restarts), Nothing(), SystemClock())  # type: ignore[arg-type]
        monkeypatch.setattr(web_process.log, "info", lambda *_, **__: up.set())
        running = asyncio.create_task(web.run())
        pids = []
        for number in (9, 19, 0):  # SIGKILL, SIGSTOP
            async with asyncio.timeout(within(40)):
                await up.wait()
            up.clear()
            child = web._child
            assert child is not None
            pids.append(child.pid)
            environment = seen_by_others(child.pid)
            assert "secret" not in environment
            assert "sqlite" not in environment
            if number:
                child.send_signal(number)
        assert (len(set(pids)), web.restarts) == (3, 2)
        web.stop()
        async with asyncio.timeout(within(10)):
            await running
        assert child.returncode == 0


def test_a_long_machine_file_is_cut_to_one_message(tmp_path: Path) -> None:
    """200 schedules with names of 32 letters: what the file states comes before defaults, and the page learns how much is missing."""
    entry = '[[schedule]]\nname = "{:032}"\nrecipe = "quick-check"\ncron = "0 6 * * 1-5"\ntimezone = "Europe/Berlin"\n'
    head = 'name = "VMC-1"\nchain = "w-X-Y-b-Z-t"\n[stroke_mm]\nX = [0, 600]\nY = [0, 500]\nZ = [0, 450]\n'
    path = tmp_path / "machine.toml"
    path.write_text(head + "".join(map(entry.format, range(200))))
    loaded = load_machine(path)
    stated = loaded.summary()
    begin = replace(CORE[0], schedules=tuple(loaded.machine.schedule))
    with pytest.raises(ChannelBroken, match="a message of"):
        m.encode(replace(begin, stated=stated))
    sent = m.from_core(m.encode(begin.stating(stated)))
    assert isinstance(sent, m.Begin)
    assert sent.stated is not None
    assert 0 < sent.stated.left_out == len(stated.values) - len(sent.stated.values)
    assert [one for one in sent.stated.values if one.origin == "file"] == [one for one in stated.values if one.origin == "file"]
    assert m.from_core(m.encode(CORE[0].stating(CORE[0].stated))) == CORE[0]
