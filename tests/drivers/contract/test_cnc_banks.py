"""The controller driver against a controller on a real socket that can misbehave: paths and compensation banks."""

from __future__ import annotations

import struct
import zlib

import pytest

from abbe.drivers.api import BankState
from abbe.drivers.cnc import banks as banks_module
from abbe.drivers.errors import BadFrame, DeviceFault, LinkDown, Rebooted, Refused, ReplyTimeout
from tests.drivers.contract.cnc_peer import hang_up, honest, silent

# ---- paths


async def test_path(controller, cnc):
    points = [(i * 0.5, -i * 0.25, i * 0.125) for i in range(100)]
    await controller.load_path(points)
    assert cnc.fifo == [tuple(round(v * 100_000) for v in point) for point in points]
    await controller.start_path(feed_mm_min=1200.0)
    assert cnc.log == [("motion", 2), ("motion", 3)]
    sizes = [len(values) for address, values in cnc.peer.writes if address == 96]
    assert sizes == [2 + 6 * 19] * 5 + [2 + 6 * 5]


async def test_a_point_beyond_the_strokes(controller, cnc):
    cnc.result = 0
    tasks = controller.load_path([(0.0, 0.0, 0.0)] * 30)

    def refuse(values: tuple[int, ...]) -> None:
        cnc.peer.put(48, "HH", values[0], 3)

    cnc.chunk = refuse
    with pytest.raises(Refused, match="strokes"):
        await tasks


async def test_lost_points_are_noticed(controller, cnc):
    cnc.lose_points = 1
    with pytest.raises(DeviceFault, match="28 points arrived instead of 30"):
        await controller.load_path([(0.0, 0.0, 0.0)] * 30)


async def test_too_many_points_never_reach_the_controller(controller, cnc):
    with pytest.raises(Refused, match="8193 points"):
        await controller.load_path([(0.0, 0.0, 0.0)] * 8193)
    assert cnc.log == []


async def test_reset_alarm(controller, cnc):
    await controller.reset_alarm()
    assert cnc.log == [("motion", 4)]


# ---- banks


def image(n_words: int = 45) -> bytes:
    return struct.pack(">HHHH", 0xABBE, 1, 1, n_words) + bytes(range(256)) * 40


async def test_write_and_read_back(controller, cnc):
    data = image(333)[:666]
    await controller.write_bank(1, data)
    assert await controller.read_bank(1) == data
    assert await controller.read_bank(1, 20) == data[:20]
    assert cnc.image(1, 333) == data
    windows = [(address, len(values)) for address, values in cnc.peer.writes if address >= 1000]
    assert windows == [(6000, 100), (6100, 100), (6200, 100), (6300, 33)]


async def test_the_active_bank_cannot_be_written(controller):
    with pytest.raises(Refused, match="not writable"):
        await controller.write_bank(0, image()[:90])


@pytest.mark.parametrize(("bank", "data"), [(2, b"\x00\x00"), (-1, b"\x00\x00"), (1, b""), (1, b"\x00"), (1, bytes(9602))])
async def test_impossible_writes_never_reach_the_controller(controller, cnc, bank, data):
    with pytest.raises(Refused):
        await controller.write_bank(bank, data)
    assert cnc.peer.writes == []


async def test_an_empty_bank_has_no_length(controller):
    with pytest.raises(BadFrame, match="no image"):
        await controller.read_bank(1)
    with pytest.raises(Refused):
        await controller.read_bank(1, 3)
    assert await controller.read_bank(1, 4) == bytes(4)


async def test_a_lost_window_is_not_repeated(controller, cnc, tcp_peer):
    tcp_peer.tricks = [honest, silent]
    with pytest.raises(ReplyTimeout):
        await controller.write_bank(1, image(333)[:666])
    assert [address for address, _ in cnc.peer.writes] == [6000, 6100]


async def test_comp_status(controller, cnc):
    cnc.peer.put(208, "HIIHHHHII", 1, 0x11112222, 0x33334444, 2, 1, 5, 0, 77, 9000)
    status = await controller.comp_status()
    assert (status.boot_id, status.gen, status.active_bank) == (100, 1, 1)
    assert (status.bank_crc, status.bank_state) == ((0x11112222, 0x33334444), (BankState.SEALED, BankState.WRITING))
    assert (status.lease_owner, status.lease_left_ms) == (77, 9000)


async def test_comp_status_is_never_torn(controller, cnc):
    reads = 0

    def edit(address: int, count: int) -> None:
        nonlocal reads
        if address == 208:
            reads += 1
            if reads <= 2:
                cnc.peer.put(7, "I", 1 + reads)  # somebody changes a bank during our read

    cnc.peer.on_read = edit
    status = await controller.comp_status()
    assert (reads, status.gen) == (3, 3)


async def test_comp_status_gives_up_when_somebody_keeps_editing(controller, cnc):
    reads = 0

    def edit(address: int, count: int) -> None:
        nonlocal reads
        reads += address == 208
        cnc.peer.put(7, "I", reads)

    cnc.peer.on_read = edit
    with pytest.raises(DeviceFault, match="tables changed"):
        await controller.comp_status()
    assert reads == banks_module._SEQLOCK_TRIES


async def test_comp_commands(controller, cnc):
    await controller.lease(7, 60_000)
    await controller.seal(1, 7)
    await controller.activate(1, expect_crc=zlib.crc32(b"x"), expect_gen=1, owner=7)
    await controller.release(7)
    assert cnc.log == [("comp", 3), ("comp", 1), ("comp", 2), ("comp", 4)]


@pytest.mark.parametrize(
    ("result", "why"), [(1, "bad"), (2, "interlock"), (3, "CRC"), (4, "generation"), (5, "active"), (6, "valid image"), (7, "lease")]
)
async def test_refused_activation(controller, cnc, result, why):
    cnc.comp_result = result
    with pytest.raises(Refused, match=why):
        await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)
    assert cnc.log == [("comp", 2)]


@pytest.mark.parametrize("trouble", [silent, hang_up])
@pytest.mark.parametrize("executed", [True, False])
async def test_a_lost_answer_to_an_activation_is_decided_by_the_controller(controller, cnc, tcp_peer, trouble, executed):
    async def lose(exchange) -> None:
        if not executed:
            tcp_peer.put(215, "H", 0)
            tcp_peer.put(208, "H", 0)
        await trouble(exchange)

    tcp_peer.tricks = [honest, honest, lose]
    if executed:
        await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)
    else:
        with pytest.raises((ReplyTimeout, LinkDown)) as caught:
            await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)
        assert "not executed" in caught.value.__notes__[0]
    assert [request[0] for request in tcp_peer.requests].count(16) == 1


async def test_an_activation_across_a_reboot_proves_nothing(controller, cnc, tcp_peer):
    async def reboot(exchange) -> None:
        cnc.boot(101)
        tcp_peer.put(215, "H", 1)  # the new run happens to stand at the same number
        exchange.hang_up()

    tcp_peer.tricks = [honest, honest, reboot]
    with pytest.raises(Rebooted):
        await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)


async def test_acknowledged_but_not_active_is_a_fault(controller, cnc):
    cnc.comp = lambda values: cnc.peer.put(215, "HH", values[0], 0)
    with pytest.raises(DeviceFault, match="bank 0 is active"):
        await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)


class Another:
    """Another program, whose command takes the number of the first of ours and has this result; the rest is executed as always."""

    def __init__(self, cnc, result: int, holder: int) -> None:
        self._cnc, self._honest, self._first = cnc, cnc.comp, (result, holder)
        self.passed_over: list[int] = []

    def __call__(self, values) -> None:
        if self.passed_over:
            self._honest(values)
            return
        self.passed_over.append(values[1])
        result, holder = self._first
        self._cnc.peer.put(215, "HH", values[0], result)
        self._cnc.peer.put(217, "I", holder)


async def test_a_lease_whose_number_another_program_took_is_not_believed(controller, cnc):
    cnc.comp = Another(cnc, 0, 9)
    with pytest.raises(Refused, match="another owner"):
        await controller.lease(7, 60_000)
    assert (cnc.comp.passed_over, cnc.log) == ([3], [])  # and whoever has it is not disturbed by a second try


@pytest.mark.parametrize(("command", "theirs"), [("lease", 7), ("release", 7), ("release", 0), ("seal", 7), ("seal", 0)])
async def test_a_command_that_was_passed_over_is_sent_again_under_the_next_number(controller, cnc, command, theirs):
    """Whatever the other's command was answered: who has the lease, and what the bank is, tell that ours was not executed."""
    cnc.peer.put(217, "I", 7)
    another = cnc.comp = Another(cnc, theirs, 7)
    number, words = {"seal": (1, (1, 7)), "lease": (3, (7, 1000)), "release": (4, (7,))}[command]
    await getattr(controller, command)(*words)
    assert (another.passed_over, cnc.log) == ([number], [("comp", number)])


@pytest.mark.parametrize("answer", [0, 7])
async def test_releasing_a_free_lease_is_done_at_once_whatever_the_control_calls_it(controller, cnc, answer):
    cnc.comp_result = answer
    await controller.release(7)
    assert cnc.log == [("comp", 4)]  # the number is used up all the same: a command still on its way is shut out


async def test_a_lease_that_is_free_and_refused_is_not_taken_for_given(controller, cnc):
    cnc.comp_result = 7
    with pytest.raises(DeviceFault, match="used the same command number"):
        await controller.lease(7, 60_000)
    assert cnc.log == [("comp", 3)] * banks_module._TRIES


async def test_an_activation_that_was_passed_over_is_told_and_never_sent_again(controller, cnc):
    cnc.comp = Another(cnc, 7, 7)
    with pytest.raises(DeviceFault, match="used the same command number: this command was not executed"):
        await controller.activate(1, expect_crc=1, expect_gen=1, owner=7)
    assert (cnc.comp.passed_over, cnc.log) == ([2], [])


async def test_impossible_commands_never_reach_the_controller(controller, cnc):
    with pytest.raises(Refused):
        await controller.seal(2, 7)
    with pytest.raises(Refused):
        await controller.lease(2**32, 1)
    assert cnc.log == []
