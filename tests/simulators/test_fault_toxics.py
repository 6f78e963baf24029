"""Fault scenarios, frames and what happens to them: pure, and the proxy over real sockets."""

from __future__ import annotations

import asyncio
import sys

import pytest

from abbe.simulators.faults.modbus_proxy import ModbusProxy, refusing
from abbe.simulators.faults.modbus_toxics import KINDS, MBAP, RTU, Cutter, Frame, Toxics, answer, crc16, parts
from abbe.simulators.faults.scenario import Fault, FaultScenario, FaultScenarioError, from_dict, load, scenario

READ = Frame(1, bytes.fromhex("0300640002"), tid=7)
REPLY = Frame(1, bytes.fromhex("030400640065"), tid=7)
WRITE = Frame(1, bytes.fromhex("10006400020400010002"), tid=8)
ECHO = Frame(1, bytes.fromhex("1000640002"), tid=8)


def test_the_check_sum_of_the_standard():
    assert crc16(b"123456789") == (0x4B37).to_bytes(2, "little")


@pytest.mark.parametrize("framing", [MBAP, RTU])
@pytest.mark.parametrize("step", [1, 3, 1000])
def test_a_stream_is_cut_into_its_frames_however_it_arrives(framing, step):
    for requests, frames in ((True, (READ, WRITE, READ)), (False, (REPLY, ECHO, Frame(1, b"\x83\x02", tid=9)))):
        stream = b"".join(frame.bytes(framing) for frame in frames)
        cutter = Cutter(framing, requests=requests)
        found = [frame for i in range(0, len(stream), step) for frame in cutter.feed(stream[i : i + step])]
        assert found == [frame.bytes(framing) for frame in frames]
        assert [parts(frame, framing).pdu for frame in found] == [frame.pdu for frame in frames]


class Four:
    size = 4

    def __init__(self) -> None:
        self.words = [10, 11, 12, 13]

    def read(self, address: int, count: int) -> list[int] | None:
        return self.words[address : address + count] if address + count <= 4 else None

    def write(self, address: int, values: list[int]) -> bool:
        return address + len(values) <= 4


@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        ("0300010002", "0304000b000c"),
        ("0400010001", "0402000b"),
        ("0300030002", "8302"),
        ("0600010009", "0600010009"),
        ("100000000204 00010002", "1000000002"),
        ("100003000204 00010002", "9002"),
        ("0500000000", "8501"),
    ],
)
def test_a_register_map_answers(asked, answered):
    assert answer(Four(), bytes.fromhex(asked)).hex() == answered


@pytest.mark.parametrize("framing", [MBAP, RTU])
@pytest.mark.parametrize(
    ("fault", "pdu", "fields"),
    [
        (Fault("set_unit", value=9), "030400640065", {"unit": 9}),
        (Fault("set_function", value=4), "040400640065", {}),
        (Fault("set_byte_count", value=2), "030200640065", {}),
        (Fault("more_registers", value=1), "0306006400650000", {}),
        (Fault("more_registers", value=-1), "03020064", {}),
        (Fault("exception", value=6), "8306", {}),
        (Fault("exception_after", value=6), "8306", {}),
        (Fault("instead", data="9001"), "9001", {}),
    ],
)
def test_what_becomes_of_a_reply(framing, fault, pdu, fields):
    toxics = Toxics(scenario(fault), framing)
    passed, acts = toxics.request(READ.bytes(framing))
    acts += toxics.reply(REPLY.bytes(framing), 0.0) if passed else []
    assert bool(passed) is (fault.kind != "exception")
    got = parts(acts[0].data, framing)
    assert got.pdu.hex() == pdu
    assert got.unit == fields.get("unit", 1)
    assert len(acts) == 1


@pytest.mark.parametrize("name", ["tid", "pid", "length"])
def test_the_header_can_lie(name):
    toxics = Toxics(scenario(Fault(f"set_{name}", value=77)), MBAP)
    toxics.request(READ.bytes(MBAP))
    assert getattr(parts(toxics.reply(REPLY.bytes(MBAP), 0.0)[0].data, MBAP), name) == 77


def test_times_of_what_is_late():
    toxics = Toxics(scenario(Fault("delay_reply", seconds=0.5), Fault("duplicate_reply", at=1, seconds=0.2)), RTU)
    request, reply = READ.bytes(RTU), REPLY.bytes(RTU)
    for _ in range(3):
        toxics.request(request)
    assert [act.after_s for act in toxics.reply(reply, 10.0)] == [0.5]
    assert [act.after_s for act in toxics.reply(reply, 10.1)] == pytest.approx([0.4, 0.6])  # one thing at a time
    assert [act.after_s for act in toxics.reply(reply, 10.7)] == [0.0]


def test_replies_change_places():
    toxics = Toxics(scenario(Fault("swap_replies")), MBAP)
    first, second = REPLY.bytes(MBAP), ECHO.bytes(MBAP)
    toxics.request(READ.bytes(MBAP))
    toxics.request(WRITE.bytes(MBAP))
    assert toxics.reply(first, 0.0) == []
    assert [act.data for act in toxics.reply(second, 0.0)] == [second, first]


def test_faults_hit_what_they_name():
    faults = scenario(Fault("drop_request", on="write 100"), Fault("drop_reply", at=1, on="read"))
    toxics = Toxics(faults, RTU)
    assert toxics.request(READ.bytes(RTU))[0]
    assert toxics.reply(REPLY.bytes(RTU), 0.0)
    assert not toxics.request(WRITE.bytes(RTU))[0]
    assert toxics.request(WRITE.bytes(RTU))[0]
    assert toxics.reply(ECHO.bytes(RTU), 0.0)
    assert toxics.request(READ.bytes(RTU))[0]
    assert toxics.reply(REPLY.bytes(RTU), 0.0) == []


def test_a_black_hole_swallows_everything_from_there_on():
    toxics = Toxics(scenario(Fault("black_hole", at=1)), RTU)
    assert toxics.request(READ.bytes(RTU))[0]
    assert toxics.reply(REPLY.bytes(RTU), 0.0)
    for _ in range(3):
        assert toxics.request(READ.bytes(RTU)) == (b"", [])
    assert toxics.reply(REPLY.bytes(RTU), 0.0) == []


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_is_described(kind):
    import abbe.simulators.faults.modbus_toxics as module

    assert kind in (module.__doc__ or "")


def test_a_scenario_file(tmp_path):
    path = tmp_path / "late.toml"
    path.write_text('name = "late"\nseed = 3\n[[fault]]\nkind = "delay_reply"\nat = 2\nseconds = 0.3\non = "read"\n')
    assert load(path) == FaultScenario("late", 3, (Fault("delay_reply", at=2, seconds=0.3, on="read"),))


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ({"fault": [{"kind": "cut", "colour": 1}]}, "colour"),
        ({"fault": [{"at": 1}]}, "kind"),
        ({"fault": [{"kind": "cut", "at": "1"}]}, "at"),
        ({"fault": [{"kind": "cut", "at": True}]}, "at"),
        ({"fault": [{"kind": "cut", "at": -1}]}, "below 0"),
        ({"fault": [{"kind": "noise_after", "data": "xyz"}]}, "hexadecimal"),
        ({"faults": []}, "faults"),
        ({"fault": {}}, "list"),
        ({"name": 3}, "name"),
    ],
)
def test_unusable_scenarios_are_refused(data, says):
    with pytest.raises(FaultScenarioError, match=says):
        from_dict(data)


def test_unknown_kinds_and_missing_files_are_refused(tmp_path):
    with pytest.raises(FaultScenarioError, match="earthquake"):
        Toxics(scenario(Fault("earthquake")), MBAP)
    with pytest.raises(FaultScenarioError, match="on 'sundays'"):
        Toxics(scenario(Fault("cut", on="sundays")), MBAP)
    with pytest.raises(FaultScenarioError):
        load(tmp_path / "nothing.toml")


async def echo_server() -> asyncio.Server:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(100):
            writer.write(Frame(1, b"\x03\x02\x00\x01", tid=parts(data, MBAP).tid).bytes(MBAP))
        writer.close()

    return await asyncio.start_server(serve, "127.0.0.1", 0)


async def test_the_proxy_knows_rtu_frames_over_tcp():
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while await reader.read(100):
            writer.write(REPLY.bytes(RTU))
        writer.close()

    server = await asyncio.start_server(serve, "127.0.0.1", 0)
    proxy = ModbusProxy(server.sockets[0].getsockname(), scenario(Fault("more_registers", value=1), Fault("one_byte", at=1)), RTU)
    reader, writer = await asyncio.open_connection("127.0.0.1", await proxy.start())
    for pdu in ("0306006400650000", "030400640065"):
        writer.write(READ.bytes(RTU))
        data = await reader.readexactly(1 + len(pdu) // 2 + 2)
        assert parts(data, RTU).pdu.hex() == pdu
        assert crc16(data[:-2]) == data[-2:]
    writer.close()
    await proxy.stop()
    server.close()


async def test_the_proxy_as_a_program(tmp_path):
    server = await echo_server()
    host, port = server.sockets[0].getsockname()
    faults = tmp_path / "faults.toml"
    faults.write_text('[[fault]]\nkind = "set_unit"\nvalue = 9\n')
    words = (sys.executable, "-m", "abbe.simulators.faults.modbus_proxy", f"{host}:{port}", str(faults))
    process = await asyncio.create_subprocess_exec(*words, stdout=asyncio.subprocess.PIPE)
    assert process.stdout is not None
    url = (await process.stdout.readline()).decode()
    reader, writer = await asyncio.open_connection("127.0.0.1", int(url.partition("127.0.0.1:")[2].partition("?")[0]))
    for unit in (9, 1):
        writer.write(READ.bytes(MBAP))
        assert parts(await reader.readexactly(11), MBAP).unit == unit
    writer.close()
    process.terminate()
    await process.wait()
    server.close()


async def test_the_proxy_passes_on_hangs_up_and_counts():
    server = await echo_server()
    proxy = ModbusProxy(server.sockets[0].getsockname())
    port = await proxy.start()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    writer.write(READ.bytes(MBAP))
    assert parts(await reader.readexactly(11), MBAP).tid == 7
    proxy.play(scenario(Fault("rst")))
    writer.write(READ.bytes(MBAP))
    with pytest.raises(ConnectionResetError):
        assert await reader.read(1)
    writer.close()
    proxy.play(refusing(1))
    for expected in (b"", b"\x00"):
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(READ.bytes(MBAP))
        try:
            got = await reader.read(1)
        except ConnectionResetError:
            got = b""
        assert got == expected
        writer.close()
    assert (proxy.connections, proxy.most_open) == (3, 1)
    await proxy.stop()
    server.close()
