"""The box's bytes: every example of docs/protocols/ballbar.md, and what happens when nobody reads."""

import struct

import numpy as np
import pytest

from abbe.simulators.ballbar.device import BallbarDevice, Samples
from abbe.simulators.ballbar.wire import BallbarWire, Parser, crc16, encode, encode_ack, encode_info, encode_samples
from abbe.simulators.world import World

EXAMPLES = {
    "IDENTIFY": "A5 5A 81 02 01 00 1D 72",
    "START": "A5 5A 82 04 02 00 E8 03 66 9C",
    "STOP": "A5 5A 83 02 03 00 17 F9",
    "ACK": "A5 5A 03 04 02 00 82 00 64 D9",
    "SAMPLE": "A5 5A 01 12 07 00 00 00 87 D6 12 00 00 00 00 00 C7 CF FF FF 08 00 A8 E2",
    "INFO": "A5 5A 02 1C 01 00 01 00 FE CA 67 12 00 00 00 01 E8 03 00 00 41 42 42 2D 31 00 00 00 00 00 00 00 EA F7",
}
BYTES = {name: bytes.fromhex(text) for name, text in EXAMPLES.items()}


def columns(*rows: tuple[int, int, int, int]) -> Samples:
    return Samples(*(np.array(column, dtype=np.int64) for column in zip(*rows, strict=True)))


def test_crc_check_value() -> None:
    assert crc16(b"123456789") == 0x29B1


def test_examples_of_the_box() -> None:
    assert encode_ack(2, 0x82, 0) == BYTES["ACK"]
    assert encode_info(1, 0xCAFE0001, 0) == BYTES["INFO"]
    assert encode_samples(columns((7, 1234567, -12345, 8))) == BYTES["SAMPLE"]


def test_examples_of_the_host() -> None:
    assert encode(0x81, b"\x01\x00") == BYTES["IDENTIFY"]
    whole = BYTES["IDENTIFY"] + BYTES["START"] + BYTES["STOP"]
    expected = [(0x81, b"\x01\x00"), (0x82, b"\x02\x00\xe8\x03"), (0x83, b"\x03\x00")]
    assert list(Parser().feed(whole)) == expected
    parser = Parser()
    assert [frame for byte in whole for frame in parser.feed(bytes([byte]))] == expected


def test_many_samples_are_the_same_as_one_by_one() -> None:
    rng = np.random.default_rng(4)
    rows = [
        (int(rng.integers(2**32)), int(rng.integers(2**60)), int(rng.integers(-(2**31), 2**31)), int(rng.integers(2**16)))
        for _ in range(50)
    ]
    one_by_one = b"".join(encode(1, struct.pack("<IQiH", *row)) for row in rows)
    assert encode_samples(columns(*rows)) == one_by_one
    assert encode_samples(columns((2**32 + 5, 0, 0, 0)))[4:8] == b"\x05\0\0\0", "the number wraps"


@pytest.mark.parametrize(
    "noise",
    [b"\x00\x01garbage", b"\xa5", b"\xa5\x5a\x81\xff", b"\xa5\x5a\x81\x02\x01\x00\x1d\x73", b"\xa5\xa5\xa5", b"\xa5\x5a\xa5\x5a"],
)
def test_parser_finds_its_feet(noise: bytes) -> None:
    assert (0x83, b"\x03\x00") in list(Parser().feed(noise + BYTES["STOP"] + BYTES["STOP"] * 5))


class Line:
    """A line with a given amount of room."""

    url = "test://"

    def __init__(self, room: int) -> None:
        self.free, self.sent = room, b""

    def room(self) -> int:
        return self.free

    def send(self, data: bytes) -> None:
        self.sent += data
        self.free = max(0, self.free - len(data))

    def pump(self) -> None: ...
    async def open(self, received) -> None: ...
    async def close(self) -> None: ...


def box(world: World, room: int = 10**9) -> tuple[BallbarWire, Line]:
    line = Line(room)
    return BallbarWire(world.ballbar, line, 0xCAFE0001, lambda: world.time_s), line


def samples(data: bytes) -> list[tuple[int, int, int, int]]:
    found = []
    for i in range(0, len(data), 24):
        assert data[i : i + 4] == b"\xa5\x5a\x01\x12"
        found.append(struct.unpack("<IQiH", data[i + 4 : i + 22]))
    return found


def test_conversation(quiet_world) -> None:
    world = quiet_world()
    wire, line = box(world)
    wire.received(BYTES["IDENTIFY"])
    assert line.sent == BYTES["INFO"]
    world.advance(1.0)
    line.sent = b""
    wire.received(BYTES["START"])
    assert line.sent == BYTES["ACK"]
    world.advance(1.01)
    line.sent = b""
    wire.received(BYTES["STOP"])
    stream, ack = line.sent[:-10], line.sent[-10:]
    assert ack == encode(3, b"\x03\x00\x83\x00"), "the ACK comes after the last sample"
    got = samples(stream)
    assert [s[0] for s in got] == list(range(10))
    assert np.diff([s[1] for s in got]).tolist() == [1000] * 9
    assert {s[2:] for s in got} == {(0, 16)}, "no bar"
    world.advance(2.0)
    line.sent = b""
    wire.flush()
    assert line.sent == b""


@pytest.mark.parametrize(
    ("request_frame", "result"),
    [
        (encode(0x82, struct.pack("<HH", 9, 300)), 1),
        (encode(0x82, struct.pack("<HH", 9, 0)), 1),
        (encode(0x82, struct.pack("<HH", 9, 2000)), 1),
        (encode(0x82, struct.pack("<HH", 9, 8)), 0),
        (encode(0x82, struct.pack("<H", 9)), 1),
        (encode(0x85, struct.pack("<H", 9)), 2),
    ],
)
def test_results_of_commands(quiet_world, request_frame: bytes, result: int) -> None:
    wire, line = box(quiet_world())
    wire.received(request_frame)
    assert line.sent == encode(3, struct.pack("<HBB", 9, request_frame[2], result))


def test_a_reader_who_does_not_read_loses_whole_samples(quiet_world) -> None:
    world = quiet_world()
    wire, line = box(world, room=10 + 5 * 24 + 7)
    wire.received(BYTES["START"])
    line.sent = b""
    world.advance(0.0105)
    wire.flush()
    assert [s[0] for s in samples(line.sent)] == [0, 1, 2, 3, 4]
    line.sent, line.free = b"", 10**6
    world.advance(0.0125)
    wire.flush()
    assert [(s[0], s[3]) for s in samples(line.sent)] == [(10, 16 | 4), (11, 16)]
    assert (wire.samples_sent, wire.samples_dropped) == (7, 5)


def test_restart_streams_no_more(quiet_world) -> None:
    world = quiet_world()
    wire, line = box(world)
    wire.received(BYTES["START"])
    wire.restart(0xCAFE0009)
    world.advance(1.0)
    line.sent = b""
    wire.flush()
    wire.received(BYTES["IDENTIFY"])
    assert line.sent == encode_info(1, 0xCAFE0009, 0)


def test_an_idle_box_has_no_samples(quiet_world) -> None:
    device: BallbarDevice = quiet_world().ballbar
    assert len(device.take().seq) == 0
