"""The laser's register map, decoded by struct formats typed from docs/protocols/laser.md."""

import struct

import numpy as np
import pytest

from abbe.simulators.laser.wire import LaserRegisters


@pytest.fixture
def rig(quiet_world):
    world = quiet_world()
    clock = {"now": 0.0}
    registers = LaserRegisters(world.laser, 0xBEEF0001, lambda: world.advance(clock["now"]), world.tool_position, clock_offset_us=500)

    def get(address: int, form: str) -> int:
        words = registers.read(address, struct.calcsize(">" + form) // 2)
        assert words is not None
        return struct.unpack(">" + form, struct.pack(f">{len(words)}H", *words))[0]

    return world, clock, registers, get


def test_identity(rig) -> None:
    _, _, registers, get = rig
    assert registers.read(0, 4) == [0x0102, 0x0304, 0x449A, 0x5000]
    assert (get(4, "H"), get(5, "I")) == (1, 0xBEEF0001)
    assert get(43, "H") == 0


def test_reading(rig) -> None:
    world, clock, registers, get = rig
    assert get(21, "H") == 0b10011, "nothing mounted"
    world.laser.mount(np.array([-1.0, 0.0, 0.0]), world.tool_position())
    assert registers.write(40, [1, 3, 1])
    assert registers.write(40, [2, 1, 0])
    assert registers.read(40, 5) == [2, 1, 0, 2, 0]
    clock["now"] = 0.5
    registers.read(10, 1)
    world.controller.move(np.array([312.3456789, 250.0, 225.0]), 6000.0)
    clock["now"] = 10.02
    assert get(16, "q") == pytest.approx(-123_456_789, abs=1), "a tenth of a nanometre a count, negative towards the laser"
    assert (get(10, "I"), get(12, "Q")) == (200, 10_000_500)
    assert get(21, "H") == 0b01100
    assert 900 < get(20, "H") <= 1000
    assert 1500 < get(22, "h") < 2500
    assert 99_000 < get(23, "I") < 103_000
    assert 300 < get(25, "H") < 600
    assert 2_500_000 < get(26, "I") < 2_900_000
    words = registers.read(10, 18)
    assert words is not None
    assert words[6:10] == registers.read(16, 4)


def test_commands_execute_once_and_in_turn(rig) -> None:
    _, _, registers, _ = rig
    assert registers.write(40, [2, 3, 1])
    assert registers.read(43, 2) == [0, 0], "a skipped number"
    assert registers.write(40, [1, 1, 0])
    assert registers.read(43, 2) == [1, 2], "zero without a mirror"
    assert registers.write(40, [1, 3, 1])
    assert registers.read(43, 2) == [1, 2], "a repeated number"
    assert registers.write(40, [2, 3, 7])
    assert registers.read(43, 2) == [2, 1]
    assert registers.write(40, [3, 8, 0])
    assert registers.read(43, 2) == [3, 1]


@pytest.mark.parametrize(("address", "count"), [(27, 2), (28, 1), (39, 2), (44, 2), (45, 1)])
def test_illegal_reads(rig, address: int, count: int) -> None:
    assert rig[2].read(address, count) is None


@pytest.mark.parametrize(("address", "count"), [(0, 1), (16, 4), (39, 2), (41, 3), (43, 1)])
def test_illegal_writes(rig, address: int, count: int) -> None:
    assert not rig[2].write(address, [0] * count)
