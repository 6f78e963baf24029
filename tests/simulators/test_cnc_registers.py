"""The CNC register map, decoded by struct formats typed from docs/protocols/cnc.md."""

import struct
import zlib

import numpy as np
import pytest

from abbe.simulators.cnc.bank import empty_image
from abbe.simulators.cnc.device import Controller
from abbe.simulators.cnc.wire import CncRegisters
from abbe.simulators.scenario import MachineConfig
from abbe.simulators.truth.machine import Geometry

MOVE, PATH_CLEAR, PATH_START, RESET = 1, 2, 3, 4


class Rig:
    """Register map of a lone controller, with a clock in the test's hand."""

    def __init__(self) -> None:
        self.cnc = Controller(Geometry(MachineConfig()))
        self.now_s = 0.0
        self.map = CncRegisters(self.cnc, 0xCAFE0002, lambda: self.cnc.advance(self.now_s))

    def bytes(self, address: int, count: int) -> bytes:
        words = self.map.read(address, count)
        assert words is not None
        return struct.pack(f">{count}H", *words)

    def get(self, address: int, form: str) -> int:
        return struct.unpack(">" + form, self.bytes(address, struct.calcsize(">" + form) // 2))[0]

    def put(self, address: int, form: str, *values: int) -> bool:
        data = struct.pack(">" + form, *values)
        return self.map.write(address, list(struct.unpack(f">{len(data) // 2}H", data)))

    def motion(self, seq: int, cmd: int, target=(0, 0, 0), feed: int = 600_000) -> tuple[int, int, int]:
        """Write a motion block; gives acknowledged number, result, finished number."""
        assert self.put(64, "HHiiiI", seq, cmd, *target, feed)
        return self.get(23, "H"), self.get(24, "H"), self.get(25, "H")

    def comp(self, seq: int, cmd: int, bank: int = 0, crc: int = 0, gen: int = 0, owner: int = 0, ms: int = 0) -> int:
        assert self.put(230, "HHHIIII", seq, cmd, bank, crc, gen, owner, ms)
        assert self.get(215, "H") == seq
        return self.get(216, "H")


@pytest.fixture
def rig() -> Rig:
    return Rig()


def test_identity(rig: Rig) -> None:
    assert rig.bytes(0, 4).hex() == "01020304449a5000"
    assert [rig.get(a, f) for a, f in ((4, "H"), (5, "I"), (9, "H"), (10, "H"), (11, "H"), (12, "H"))] == [
        1,
        0xCAFE0002,
        3,
        100,
        4800,
        8192,
    ]


def test_status_of_a_move(rig: Rig) -> None:
    assert rig.get(20, "I") == 0b0_1011_1000  # remote, referenced, drives on, in position
    assert [rig.get(26 + 2 * i, "i") for i in range(3)] == [30_000_000, 25_000_000, 22_500_000]
    assert rig.motion(1, MOVE, (40_000_000, 25_000_000, 22_500_000)) == (1, 0, 0)  # 100 mm at 6000 mm/min
    rig.now_s = 0.5
    assert rig.get(26, "i") == 35_000_000
    assert rig.get(16, "Q") == 500_000
    assert rig.get(20, "I") == 0b0_0111_1000  # moving instead of in position
    rig.now_s = 2.0
    assert [rig.get(a, f) for a, f in ((25, "H"), (26, "i"), (44, "Q"))] == [1, 40_000_000, 1_000_000]


def test_numbered_commands_execute_once(rig: Rig) -> None:
    assert rig.motion(2, MOVE, (1, 2, 3)) == (0, 0, 0), "a skipped number does nothing"
    assert rig.motion(1, MOVE, (31_000_000, 25_000_000, 22_500_000)) == (1, 0, 0)
    rig.now_s = 10.0
    assert rig.motion(1, MOVE, (0, 0, 0)) == (1, 0, 1), "a repeated number does nothing"
    assert not rig.cnc.moving
    assert rig.motion(2, MOVE, (-1, 0, 0)) == (2, 3, 1), "refused: acknowledged, not done"
    assert rig.motion(3, PATH_CLEAR) == (3, 0, 3)
    assert rig.motion(4, 9) == (4, 1, 3)


def test_numbers_wrap(rig: Rig) -> None:
    for number in [*range(1, 65536), 0, 1]:
        rig.put(64, "HHiiiI", number, PATH_CLEAR, 0, 0, 0, 0)
    assert (rig.get(23, "H"), rig.get(25, "H")) == (1, 1)


def test_path(rig: Rig) -> None:
    points = [(30_000_000 + 10_000 * (i + 1), 25_000_000, 22_500_000) for i in range(19)]
    assert rig.put(96, "HH57i", 1, 19, *(v for p in points for v in p))
    assert [rig.get(a, "H") for a in (32, 48, 49)] == [8192 - 19, 1, 0]
    assert rig.put(96, "HH57i", 1, 19, *(v for p in points for v in p)), "repeated chunk"
    assert rig.get(32, "H") == 8192 - 19
    assert rig.put(96, "HHiii", 2, 2, 0, 0, 0), "count and length differ"
    assert [rig.get(a, "H") for a in (32, 48, 49)] == [8192 - 19, 2, 1]
    rig.now_s = 1.0
    assert rig.motion(1, PATH_START, feed=6_000)[:2] == (1, 0)  # 1.9 mm at 1 mm/s
    rig.now_s = 2.04
    assert rig.get(20, "I") >> 9 & 1
    assert [rig.get(a, f) for a, f in ((33, "I"), (35, "Q"), (39, "Q"), (32, "H"))] == [10, 1_000_000, 0, 8192 - 9]
    rig.now_s = 9.0
    assert [rig.get(a, f) for a, f in ((33, "I"), (39, "Q"), (25, "H"))] == [19, 2_900_000, 1]
    assert not rig.get(20, "I") >> 9 & 1


def test_hold_register(rig: Rig) -> None:
    rig.motion(1, MOVE, (40_000_000, 25_000_000, 22_500_000))
    assert rig.map.write(80, [1])
    assert rig.get(20, "I") >> 8 & 1
    assert rig.map.write(80, [2])
    assert (rig.get(25, "H"), rig.get(80, "H")) == (1, 2)
    assert not rig.map.write(80, [3])


def test_reset_counts_as_done_after_an_estop(rig: Rig) -> None:
    rig.motion(1, MOVE, (40_000_000, 25_000_000, 22_500_000))
    rig.now_s = 0.5
    rig.cnc.set_estop(pressed=True)
    assert [rig.get(a, "H") for a in (22, 23, 25)] == [1, 1, 0]
    assert rig.get(20, "I") & 0b1110_0111 == 0b101  # e-stop and alarm; neither drives on, moving nor in position
    rig.cnc.set_estop(pressed=False)
    assert rig.motion(2, RESET) == (2, 0, 2)
    rig.now_s = 5.0
    assert rig.get(25, "H") == 2


@pytest.mark.parametrize(
    ("address", "count"), [(60, 8), (74, 1), (81, 1), (96, 4), (224, 1), (241, 1), (999, 1), (5799, 2), (10799, 2), (5900, 1)]
)
def test_illegal_reads(rig: Rig, address: int, count: int) -> None:
    assert rig.map.read(address, count) is None


@pytest.mark.parametrize("address", [0, 16, 63, 208, 223, 97, 241, 1000, 5800, 10800])
def test_illegal_writes(rig: Rig, address: int) -> None:
    assert not rig.map.write(address, [0])


def test_bank_from_writing_to_activation(rig: Rig) -> None:
    words = empty_image()
    words[2], words[3], words[8:11] = 1, 24 + 3 * 6, [2, 2, 2]
    words[18:24] = struct.unpack(">6H", struct.pack(">3i", 60_000_000, 50_000_000, 45_000_000))
    words += [50] * 18  # +5 um from each of three axes on every output
    generation = rig.get(7, "I")
    assert rig.map.write(6000, words[:20])
    assert rig.map.write(6020, words[20:])
    assert rig.bytes(6000, len(words)) == struct.pack(f">{len(words)}H", *words)
    assert [rig.get(a, f) for a, f in ((7, "I"), (208, "H"), (211, "I"), (213, "H"), (214, "H"))] == [generation + 2, 0, 0, 2, 1]
    assert rig.comp(1, 1, bank=1, owner=5) == 7, "no lease"
    assert rig.comp(2, 3, owner=5, ms=10_000) == 0
    assert (rig.get(217, "I"), rig.get(219, "I")) == (5, 10_000)
    assert rig.comp(3, 1, bank=1, owner=5) == 0
    crc = zlib.crc32(struct.pack(f">{len(words)}H", *words))
    assert (rig.get(211, "I"), rig.get(214, "H")) == (crc, 2)
    now = rig.get(7, "I")
    assert rig.comp(4, 2, bank=1, crc=crc, gen=now - 1, owner=5) == 4
    assert rig.comp(5, 2, bank=1, crc=crc + 1, gen=now, owner=5) == 3
    rig.motion(1, MOVE, (30_000_001, 25_000_000, 22_500_000))
    assert rig.comp(6, 2, bank=1, crc=crc, gen=now, owner=5) == 2, "the machine moves"
    rig.now_s = 1.0
    assert rig.comp(7, 2, bank=1, crc=crc, gen=now, owner=5) == 0
    assert [rig.get(a, f) for a, f in ((208, "H"), (7, "I"))] == [1, now + 1]
    assert rig.get(20, "I") >> 10 & 1
    np.testing.assert_allclose(rig.cnc.comp.correction(np.array([[1.0, 2.0, 3.0]])), [[0.015] * 3])
    assert not rig.map.write(6000, [0]), "now the active one"
    assert rig.map.write(1000, [0])
    assert rig.comp(8, 4, owner=5) == 0
    assert rig.get(217, "I") == 0
    assert rig.comp(9, 7) == 1
