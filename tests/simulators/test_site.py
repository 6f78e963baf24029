"""The simulator as a process, over its real wires, with raw bytes from the protocol documents."""

import asyncio
import json
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from abbe.simulators.scenario import Scenario
from abbe.simulators.site import Site
from tests.patience import within

IDENTIFY = bytes.fromhex("A55A810201001D72")
START_1000 = bytes.fromhex("A55A82040200E803669C")
STOP = bytes.fromhex("A55A8302030017F9")
ACK_START = bytes.fromhex("A55A030402008200 64D9")
READ_CANARIES = bytes.fromhex("000100000006010300000004")
CANARIES = bytes.fromhex("00010000000B01030801020304449A5000")


def fixture(sim: Any, **request: Any) -> dict[str, Any]:
    with socket.create_connection(("127.0.0.1", sim.port("fixture")), 5) as link, link.makefile("rw", encoding="utf-8") as lines:
        lines.write(json.dumps({"id": 5, **request}) + "\n")
        lines.flush()
        answer: dict[str, Any] = json.loads(lines.readline())
    assert answer.pop("id") == 5
    return answer


class Line:
    """The ball-bar's serial line as a host opens it."""

    def __init__(self, path: str) -> None:
        self.fd = os.open(path, os.O_RDWR | os.O_NOCTTY)
        self.data = b""

    def read_until(self, enough, seconds: float = 5.0) -> bytes:
        """Read until ``enough(data)``; the deadline only ends a test that fails."""
        end = time.monotonic() + seconds
        while not enough(self.data):
            left = end - time.monotonic()
            assert left > 0, f"only {len(self.data)} bytes: {self.data[:60].hex(' ')}"
            if select.select([self.fd], [], [], left)[0]:
                self.data += os.read(self.fd, 65536)
        return self.data

    def close(self) -> None:
        os.close(self.fd)


def frames(data: bytes) -> list[tuple[int, bytes]]:
    found, i = [], 0
    while i + 4 <= len(data) and i + 6 + data[i + 3] <= len(data):
        assert data[i : i + 2] == b"\xa5\x5a"
        found.append((data[i + 2], data[i + 4 : i + 4 + data[i + 3]]))
        i += 6 + data[i + 3]
    return found


def exchange(port: int, request: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), 5) as link:
        link.sendall(request)
        return link.recv(300)


def test_canaries_byte_for_byte(start) -> None:
    with start() as sim:
        assert exchange(sim.port("cnc"), READ_CANARIES) == CANARIES
        assert exchange(sim.port("laser"), READ_CANARIES) == CANARIES
        assert exchange(sim.port("laser"), bytes.fromhex("000100000006010400000004")) == CANARIES[:7] + b"\x04" + CANARIES[8:]
        # exceptions: an address that is not there, the active bank, a read-only register, coils
        assert exchange(sim.port("cnc"), bytes.fromhex("000200000006010300E00004")).hex() == "000200000003018302"
        assert exchange(sim.port("cnc"), bytes.fromhex("00030000000901 1003E800010200FF")).hex() == "000300000003019002"
        assert exchange(sim.port("laser"), bytes.fromhex("00040000000601 06002B0001")).hex() == "000400000003018602"
        assert exchange(sim.port("cnc"), bytes.fromhex("000500000006010100000001")).hex() == "000500000003018101"
        # FC6 writes the hold level
        assert exchange(sim.port("cnc"), bytes.fromhex("000600000006010600500001")).hex() == "000600000006010600500001"
        status = struct.unpack(">9xQI", exchange(sim.port("cnc"), bytes.fromhex("000700000006010300100006")))
        assert status[1] >> 8 & 1


def test_ready_line_and_machine(start) -> None:
    with start("--seed", "5", "--speed", "7", "--ballbar", "tcp") as sim:
        ready = sim.ready
        assert set(ready) == {"ready", "ballbar", "laser", "cnc", "fixture", "speed", "machine", "artefact"}
        assert (ready["ready"], ready["speed"]) == (True, 7.0)
        assert ready["machine"] == {
            "chain": "w-X-Y-b-Z-t",
            "stroke_mm": {"X": [0, 600], "Y": [0, 500], "Z": [0, 450]},
            "pivots_mm": {"X": [300, 250, -150], "Y": [300, 250, -250], "Z": [0, 320, 260]},
            "tool_mm": [0, 0, -120],
        }
        assert ready["laser"] == f"modbus+tcp://127.0.0.1:{sim.port('laser')}?unit=1"
        assert ready["cnc"] == f"modbus+tcp://127.0.0.1:{sim.port('cnc')}?unit=1"
        assert ready["ballbar"] == f"socket://127.0.0.1:{sim.port('ballbar')}"
        assert ready["fixture"] == f"fixture+tcp://127.0.0.1:{sim.port('fixture')}"


def test_pty_streams_1_khz_without_a_gap(start) -> None:
    with start() as sim, closing(Line(sim.path("ballbar"))) as line:
        assert sim.ready["ballbar"].endswith("?baud=460800")
        os.write(line.fd, IDENTIFY)
        info = frames(line.read_until(lambda d: len(d) >= 34))
        assert info[0][0] == 2
        line.data = b""
        begin = time.monotonic()
        os.write(line.fd, START_1000)
        data = line.read_until(lambda d: len(d) >= 10 + 24 * 1500)
        seconds = time.monotonic() - begin
        os.write(line.fd, STOP)
        data = line.read_until(lambda d: d.endswith(bytes.fromhex("A55A03040300830054E1")) or frames(d)[-1][0] == 3)
        assert data.startswith(ACK_START)
        samples = [struct.unpack("<IQiH", payload) for kind, payload in frames(data) if kind == 1]
        assert [s[0] for s in samples] == list(range(len(samples)))
        assert {b[1] - a[1] for a, b in pairwise(samples)} == {1000}
        assert seconds > 1.4, "not faster than its own clock"
        ledger = fixture(sim, op="ledger")
        assert (ledger["samples_sent"], ledger["samples_dropped"]) == (len(samples), 0)


def test_pty_survives_a_host_that_closes_and_reopens(start, tmp_path: Path) -> None:
    with start("--link-dir", str(tmp_path / "links")) as sim:
        assert sim.path("ballbar") == str(tmp_path / "links" / "ballbar")
        for _ in range(3):
            with closing(Line(sim.path("ballbar"))) as line:
                os.write(line.fd, IDENTIFY)
                assert frames(line.read_until(lambda d: len(d) >= 34))[0][0] == 2


def test_unplugged_line_ends_and_comes_back_at_the_same_path(start, tmp_path: Path) -> None:
    with start("--link-dir", str(tmp_path)) as sim:
        boots = []
        for _ in range(2):
            with closing(Line(sim.path("ballbar"))) as line:
                os.write(line.fd, IDENTIFY)
                boots.append(struct.unpack("<I", line.read_until(lambda d: len(d) >= 34)[6:10])[0])
                os.write(line.fd, START_1000)
                line.read_until(lambda d: len(d) > 500)
                assert fixture(sim, op="unplug_ballbar")["ok"]
                with pytest.raises(OSError, match="Input/output error"):  # noqa: PT012  (what was on its way may come first)
                    while os.read(line.fd, 4096):
                        pass
                    raise OSError("Input/output error")  # end of file says the same
            assert not (tmp_path / "ballbar").is_symlink()
            assert fixture(sim, op="plug_ballbar")["ballbar"] == sim.ready["ballbar"]
        assert boots[0] != boots[1], "it was without power"


def test_a_reader_who_sleeps_finds_a_gap_marked_by_bit_2(start) -> None:
    with start("--speed", "60") as sim, closing(Line(sim.path("ballbar"))) as line:
        os.write(line.fd, START_1000)
        while not fixture(sim, op="ledger")["samples_dropped"]:
            pass
        os.set_blocking(line.fd, False)
        marked = None
        line.data = b""
        while marked is None:
            line.read_until(lambda d, want=len(line.data) + 24: len(d) >= want)
            samples = [struct.unpack("<IQiH", payload) for kind, payload in frames(line.data) if kind == 1]
            marked = next((i for i, s in enumerate(samples) if s[3] & 4), None)
        assert samples[marked][0] > samples[marked - 1][0] + 1
        assert [s[0] for s in samples[:marked]] == list(range(marked))
        assert not any(s[3] & 4 for s in samples[:marked])


def test_a_world_faster_than_real_time_waits_for_a_host_that_watches_it(monkeypatch: pytest.MonkeyPatch) -> None:
    wall_s = [0.0]
    monkeypatch.setattr(asyncio, "get_running_loop", lambda: SimpleNamespace(time=lambda: wall_s[0]))
    site, line = Site(Scenario(speed=50.0)), SimpleNamespace(connected=True)
    site._cnc = line

    def passed_s(seconds: float) -> float:
        """Simulated time between two questions of the host."""
        site.registers.read(16, 4)
        before_s, end_s = site.world.time_s, wall_s[0] + seconds
        while wall_s[0] < end_s:
            wall_s[0] += 0.005
            site._advance()
        return site.world.time_s - before_s

    assert passed_s(0.3) == pytest.approx(15.0, abs=0.3), "nothing streams, so nobody is late"
    assert site.world.ballbar.start(1000, site.world.time_s)
    assert passed_s(0.02) == pytest.approx(1.0, abs=0.3), "it asks often enough"
    assert passed_s(0.45) == pytest.approx(2.0), "2000 samples"
    assert 2.0 < passed_s(1.0) < 30.0, "who asks nothing for so long does not watch"
    site.registers.read(16, 4)
    line.connected = False
    assert passed_s(0.3) == pytest.approx(15.0, abs=0.3), "nobody waits for a host that has hung up"


def test_ballbar_over_tcp(start) -> None:
    with start("--ballbar", "tcp") as sim:
        for _ in range(2):
            with socket.create_connection(("127.0.0.1", sim.port("ballbar")), 5) as link:
                link.sendall(START_1000)
                data = b""
                while ACK_START not in data or len(data) < data.index(ACK_START) + 10 + 24 * 100:
                    data += link.recv(4096)
                # a box that streamed for the host before goes on until it is told to start again
                data = data[data.index(ACK_START) :]
                assert [struct.unpack("<I", p[:4])[0] for k, p in frames(data) if k == 1][:100] == list(range(100))
        assert fixture(sim, op="unplug_ballbar")["ok"]
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", sim.port("ballbar")), 5)
        assert fixture(sim, op="plug_ballbar")["ballbar"] == sim.ready["ballbar"]
        socket.create_connection(("127.0.0.1", sim.port("ballbar")), 5).close()


def modbus_crc(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ 0xA001 if crc & 1 else crc >> 1
    return struct.pack("<H", crc)


def test_laser_over_rtu(start, tmp_path: Path) -> None:
    with start("--laser", "rtu", "--link-dir", str(tmp_path)) as sim:
        assert sim.ready["laser"] == f"modbus+rtu://{tmp_path / 'laser'}?baud=115200&unit=1"
        for _ in range(2):
            with closing(Line(sim.path("laser"))) as line:
                request = bytes.fromhex("010300000004")
                os.write(line.fd, request + modbus_crc(request))
                answer = line.read_until(lambda d: len(d) >= 13)
                assert answer[:-2] == bytes.fromhex("01030801020304449A5000")
                assert answer[-2:] == modbus_crc(answer[:-2])


def test_fixture(start) -> None:
    with start() as sim:
        assert fixture(sim, op="identify")["name"]
        first = fixture(sim, op="mount_ballbar", radius_mm=150.0)
        second = fixture(sim, op="mount_laser", beam=[0.6, 0.0, 0.8])
        assert first["ok"]
        assert second["ok"]
        assert second["time_us"] > first["time_us"]
        assert fixture(sim, op="change_ballbar", radius_mm=100.0)["ok"]  # the cup stands
        assert fixture(sim, op="unmount")["ok"]
        for bad, error in (
            ({"op": "nonsense"}, "unknown op: nonsense"),
            ({"op": "mount_ballbar"}, "radius_mm: a number is expected"),
            ({"op": "mount_ballbar", "radius_mm": -1}, "radius_mm is out of range"),
            ({"op": "change_ballbar", "radius_mm": 0}, "radius_mm is out of range"),
            ({"op": "change_ballbar", "radius_mm": 100.0}, "no cup stands here"),
            ({"op": "mount_laser", "beam": [1, 1, 1]}, "beam is not a unit vector"),
            ({"op": "mount_laser", "beam": "X"}, "beam: three numbers are expected"),
            ({"op": "estop"}, "on: true or false is expected"),
            ({"op": "drift", "axis": "W", "um_per_m": 1}, "axis: X, Y or Z is expected"),
        ):
            assert fixture(sim, **bad) == {"ok": False, "error": error}
        with socket.create_connection(("127.0.0.1", sim.port("fixture")), 5) as link, link.makefile("rwb") as lines:
            lines.write(b"not json\n[1]\n" + json.dumps({"id": "a", "op": "identify"}).encode() + b"\n")
            lines.flush()
            answers = [json.loads(lines.readline()) for _ in range(3)]
        assert [a["ok"] for a in answers] == [False, False, True]
        assert answers[2]["id"] == "a"


def test_fixture_switches_reach_the_controller(start) -> None:
    def bits(sim: Any) -> int:
        return struct.unpack(">9xI", exchange(sim.port("cnc"), bytes.fromhex("000100000006010300140002")))[0]

    with start() as sim:
        fixture(sim, op="door", on=True)
        assert bits(sim) & 0b11 == 0b10
        fixture(sim, op="door", on=False)
        fixture(sim, op="estop", on=True)
        assert bits(sim) & 0b100111 == 0b101
        fixture(sim, op="estop", on=False)
        fixture(sim, op="mount_laser", beam=[1.0, 0.0, 0.0])
        fixture(sim, op="beam", blocked=True)
        fixture(sim, op="drift", axis="X", um_per_m=40.0)


def test_nobody_mounts_on_a_moving_machine(start) -> None:
    move = struct.pack(">HHHBBHHBHHiiiI", 1, 0, 27, 1, 16, 64, 10, 20, 1, 1, 0, 0, 0, 100)  # 1 mm/min
    with start() as sim:
        exchange(sim.port("cnc"), move)
        assert fixture(sim, op="mount_ballbar", radius_mm=100.0) == {"ok": False, "error": "the machine is moving"}


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signals_end_it_cleanly(start, tmp_path: Path, number: int) -> None:
    with start("--link-dir", str(tmp_path), "--laser", "rtu") as sim:
        assert sorted(p.name for p in tmp_path.iterdir()) == ["ballbar", "laser"]
        with closing(Line(sim.path("ballbar"))) as line:
            os.write(line.fd, START_1000)
            line.read_until(lambda d: len(d) > 100)
            begin = time.monotonic()
            sim.process.send_signal(number)
            assert sim.process.wait(within(5)) == 0
            assert time.monotonic() - begin < within(1.0)
        assert list(tmp_path.iterdir()) == []


def test_ends_with_its_parent(start) -> None:
    with start() as sim:
        sim.process.stdin.close()
        assert sim.process.wait(within(5)) == 0


def refused(*arguments: str) -> str:
    done = subprocess.run([sys.executable, "-m", "abbe.simulators", *arguments], capture_output=True, text=True, check=False, timeout=20)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1
    return done.stderr


def test_errors_are_one_line_and_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text("[machine]\nchian = 'w-X-Y-b-Z-t'\n")
    assert refused(str(tmp_path / "bad.toml")).startswith("error USE-001: simulators: unknown key: machine.chian - correct ")
    assert refused("--speed", "0").startswith("error USE-001: simulators: speed: must be above 0 - correct this option or ")
    assert "none.toml" in refused(str(tmp_path / "none.toml"))
    assert "--nonsense" in refused("--nonsense")
    assert "speed" in refused("--speed", "0")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = str(taken.getsockname()[1])
        for device in ("cnc", "ballbar", "laser", "fixture") if os.environ.get("ABBE_TEST_LONG") else ("cnc", "ballbar"):
            assert port in refused("--ballbar", "tcp", f"--{device}-port", port)
    (tmp_path / "ballbar").write_text("not ours")
    assert "ballbar" in refused("--link-dir", str(tmp_path))
    assert (tmp_path / "ballbar").read_text() == "not ours"
