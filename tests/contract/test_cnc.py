"""The controller driver against a controller on a real socket that can misbehave."""

from __future__ import annotations

import asyncio
import struct
import zlib
from collections.abc import AsyncIterator

import pytest

from drivers.api import ControllerStatus
from drivers.cnc import banks as banks_module
from drivers.cnc.driver import ModbusController
from drivers.cnc.registers import Bit
from drivers.errors import BadFrame, DeviceFault, LinkDown, Rebooted, Refused, ReplyTimeout, WrongDevice
from drivers.links.modbus import ModbusLink
from drivers.links.urls import parse_url
from drivers.registry import open_controller

READY = Bit.REMOTE | Bit.REFERENCED | Bit.DRIVES_ON | Bit.IN_POSITION
TARGET = (100.0, -50.0, 25.5)


class Cnc:
    """A controller behind a Modbus peer, written from docs/protocols/cnc.md; axes jump to the target when ``finish`` is called."""

    def __init__(self, peer) -> None:
        self.peer = peer
        self.bits = int(READY)
        self.result = 0
        self.comp_result = 0
        self.auto_finish = True
        self.log: list[tuple[str, int]] = []
        self.fifo: list[tuple[int, int, int]] = []
        self.lose_points = 0
        self.moving = asyncio.Event()
        self.held = asyncio.Event()
        self.boot(100)
        peer.on_write = self.written
        peer.on_read = self.read

    def boot(self, boot_id: int) -> None:
        self.peer.put(0, "ifHII", 0x01020304, 1234.5, 1, boot_id, 1)
        self.peer.put(9, "HHHH", 3, 100, 4800, 8192)
        self.peer.put(22, "HHHH", 0, 0, 0, 0)
        self.peer.put(48, "HH", 0, 0)
        self.peer.put(208, "HIIHHHHII", 0, 0xAAAA5555, 0, 2, 0, 0, 0, 0, 0)
        self.time_us = 0

    def read(self, address: int, count: int) -> None:
        self.time_us += 1000
        self.peer.put(16, "QI", self.time_us, self.bits)
        self.peer.put(32, "H", 8192 - len(self.fifo))

    def written(self, address: int, values: tuple[int, ...]) -> int | None:
        if address == 64:
            return self.motion(values)
        if address == 80:
            return self.hold(values[0])
        if address == 96:
            return self.chunk(values)
        if address == 230:
            return self.comp(values)
        if 6000 <= address < 10800 or 1000 <= address < 5800:
            bank = int(address >= 6000)
            return 2 if self.peer.words[208] == bank else None
        return 2

    def motion(self, values: tuple[int, ...]) -> None:
        number, command = values[:2]
        if number != (self.peer.words[23] + 1) & 0xFFFF:
            return
        self.log.append(("motion", command))
        self.peer.put(23, "HH", number, self.result)
        if self.result:
            return
        if command == 2:
            self.fifo.clear()
        if command == 1:
            self.target = values[2:8]
            self.bits |= Bit.MOVING
            self.moving.set()
            if self.auto_finish:
                self.finish()

    def finish(self, there: bool = True) -> None:
        if there:
            for i, word in enumerate(self.target):
                self.peer.words[26 + i] = word
        self.bits &= ~Bit.MOVING
        self.peer.words[25] = self.peer.words[23]

    def hold(self, level: int) -> None:
        self.log.append(("hold", level))
        self.bits = self.bits | Bit.FEED_HOLD if level else self.bits & ~Bit.FEED_HOLD
        if level == 2 and self.bits & Bit.MOVING:
            self.finish(there=False)
        if level:
            self.held.set()

    def chunk(self, values: tuple[int, ...]) -> None:
        number, count = values[:2]
        if number != (self.peer.words[48] + 1) & 0xFFFF:
            return
        points = struct.unpack(f">{3 * count}i", struct.pack(f">{6 * count}H", *values[2:]))
        self.peer.put(48, "HH", number, self.result)
        if not self.result:
            self.fifo += [points[i : i + 3] for i in range(0, 3 * count, 3)][self.lose_points :]

    def comp(self, values: tuple[int, ...]) -> None:
        number, command, bank = values[:3]
        if number != (self.peer.words[215] + 1) & 0xFFFF:
            return
        self.log.append(("comp", command))
        self.peer.put(215, "HH", number, self.comp_result)
        if command == 2 and not self.comp_result:
            self.peer.words[208] = bank

    def image(self, bank: int, n_words: int) -> bytes:
        base = (1000, 6000)[bank]
        return struct.pack(f">{n_words}H", *(self.peer.words[base + i] for i in range(n_words)))


@pytest.fixture
def cnc(tcp_peer) -> Cnc:
    return Cnc(tcp_peer)


@pytest.fixture
async def controller(tcp_peer, cnc) -> AsyncIterator[ModbusController]:
    opened = ModbusController(await ModbusLink.connect(parse_url(tcp_peer.url), timeout_s=0.15))
    await opened.identify()
    yield opened
    await opened.close()


def move(controller: ModbusController, timeout_s: float = 5.0) -> asyncio.Task[ControllerStatus]:
    return asyncio.create_task(controller.move(TARGET, feed_mm_min=3000.0, timeout_s=timeout_s))


async def silent(exchange) -> None:
    return


async def honest(exchange) -> None:
    exchange.reply()


async def hang_up(exchange) -> None:
    exchange.hang_up()


# ---- identity and status


async def test_identify_and_status(controller):
    assert (await controller.identify()).boot_id == 100
    status = await controller.status()
    assert status.bits == READY
    assert status.fifo_free == 8192


async def test_wrong_device(tcp_peer, cnc):
    tcp_peer.put(4, "H", 3)
    with pytest.raises(WrongDevice, match="map version 3"):
        await open_controller(tcp_peer.url)


async def test_reboot_is_noticed_by_status_and_moves_nothing(controller, cnc):
    for _ in range(3):
        await controller.status()
    cnc.boot(101)
    with pytest.raises(Rebooted):
        await controller.move(TARGET, feed_mm_min=100.0, timeout_s=1.0)
    with pytest.raises(Rebooted):
        await controller.seal(1, 7)
    assert ("motion", 1) not in cnc.log
    assert not [entry for entry in cnc.log if entry[0] == "comp"]
    await controller.identify()
    await controller.status()


async def test_reboot_behind_a_reconnect_is_noticed_although_the_clock_went_on(controller, cnc, tcp_peer):
    await controller.status()
    cnc.boot(101)
    cnc.time_us = 10**9
    tcp_peer.tricks = [hang_up]
    with pytest.raises(Rebooted):
        await controller.status()


# ---- moves


async def test_move(controller, cnc):
    status = await controller.move(TARGET, feed_mm_min=3000.0, timeout_s=5.0)
    assert status.position_mm == TARGET
    assert cnc.log == [("motion", 1)]
    assert cnc.peer.words[73] == 300_000 & 0xFFFF


async def test_move_waits_until_it_is_done(controller, cnc):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    for _ in range(3):
        await controller.status()
    assert not task.done()
    cnc.finish()
    assert (await task).position_mm == TARGET
    assert ("hold", 1) not in cnc.log


@pytest.mark.parametrize(("result", "why"), [(1, "bad argument"), (2, "interlock"), (3, "strokes"), (5, "busy")])
async def test_a_refused_move(controller, cnc, result, why):
    cnc.result = result
    with pytest.raises(Refused, match=why):
        await controller.move(TARGET, feed_mm_min=3000.0, timeout_s=1.0)
    assert cnc.log == [("motion", 1)]


@pytest.mark.parametrize(
    ("target", "feed"), [((float("nan"), 0.0, 0.0), 1.0), ((1e6, 0.0, 0.0), 1.0), (TARGET, float("inf")), (TARGET, -1.0)]
)
async def test_nonsense_never_reaches_the_controller(controller, cnc, target, feed):
    with pytest.raises(Refused):
        await controller.move(target, feed_mm_min=feed, timeout_s=1.0)
    assert cnc.log == []


async def test_a_move_into_feed_hold_is_refused_before_it_is_sent(controller, cnc):
    await controller.hold()
    with pytest.raises(Refused, match="feed hold is on"):
        await controller.move(TARGET, feed_mm_min=1.0, timeout_s=1.0)
    await controller.resume()
    await controller.move(TARGET, feed_mm_min=1.0, timeout_s=1.0)
    assert cnc.log == [("hold", 1), ("hold", 0), ("motion", 1)]


async def test_hold_while_a_move_is_pending(controller, cnc):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    await controller.hold()
    with pytest.raises(DeviceFault, match="feed hold"):
        await task
    assert cnc.log == [("motion", 1), ("hold", 1)]


async def test_abort_while_a_move_is_pending(controller, cnc):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    await controller.abort()
    with pytest.raises(DeviceFault, match=r"feed hold|aborted"):
        await task
    assert cnc.log == [("motion", 1), ("hold", 2), ("hold", 0)]
    cnc.auto_finish = True
    await controller.move(TARGET, feed_mm_min=1.0, timeout_s=1.0)


@pytest.mark.parametrize(
    ("bit", "alarm", "why"),
    [(Bit.ESTOP, 1, "e-stop"), (Bit.ALARM, 2, "stroke limit"), (Bit.ALARM, 77, "code 77"), (Bit.DOOR_OPEN, 0, "door")],
)
async def test_trouble_during_a_move(controller, cnc, bit, alarm, why):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    cnc.peer.put(22, "H", alarm)
    cnc.bits |= bit
    with pytest.raises(DeviceFault, match=why) as caught:
        await task
    assert caught.value.remedy
    assert cnc.log[-1] == ("hold", 1)


async def test_reboot_during_a_move(controller, cnc):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    await controller.status()
    cnc.boot(101)
    with pytest.raises(Rebooted):
        await task
    assert cnc.log[-1] == ("hold", 1)


async def test_a_move_that_takes_too_long_is_held(controller, cnc):
    cnc.auto_finish = False
    with pytest.raises(ReplyTimeout, match="feed hold set"):
        await controller.move(TARGET, feed_mm_min=1.0, timeout_s=0.1)
    assert cnc.log == [("motion", 1), ("hold", 1)]


async def test_a_cancelled_move_is_held_even_if_cancelled_twice(controller, cnc):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    task.cancel()
    await asyncio.sleep(0)
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task
    assert cnc.log == [("motion", 1), ("hold", 1)]


async def test_cancelled_at_every_loop_step_the_machine_never_runs_on(controller, cnc):
    """Cancel a move after n turns of the event loop: either nothing moved, or a feed hold was sent before the cancellation arrived."""
    cnc.auto_finish = False
    moved = 0
    for turns in range(80):
        cnc.log.clear()
        cnc.moving.clear()
        task = move(controller)
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        await controller.status()
        if ("motion", 1) in cnc.log:
            moved += 1
            assert cnc.log.index(("hold", 1)) > cnc.log.index(("motion", 1))
            cnc.finish()
        await controller.resume()
    assert moved > 5


async def test_link_lost_during_a_move_tries_to_hold_over_a_new_connection(controller, cnc, tcp_peer):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    tcp_peer.tricks = [silent, silent]
    with pytest.raises(ReplyTimeout):
        await task
    assert cnc.log == [("motion", 1), ("hold", 1)]
    await controller.resume()


async def test_the_error_says_so_when_the_hold_could_not_be_sent(controller, cnc, tcp_peer):
    cnc.auto_finish = False
    task = move(controller)
    await cnc.moving.wait()
    tcp_peer.always = silent
    with pytest.raises(ReplyTimeout) as caught:
        await task
    assert "feed hold could not be sent" in caught.value.__notes__[0]


@pytest.mark.parametrize("executed", [True, False])
async def test_a_lost_answer_to_a_move_is_decided_by_the_acknowledge(controller, cnc, tcp_peer, executed):
    async def lose(exchange) -> None:
        if not executed:
            tcp_peer.put(23, "HHH", 0, 0, 0)
            cnc.bits = int(READY)

    tcp_peer.tricks = [honest, lose]
    if executed:
        assert (await controller.move(TARGET, feed_mm_min=1.0, timeout_s=5.0)).position_mm == TARGET
    else:
        with pytest.raises(ReplyTimeout) as caught:
            await controller.move(TARGET, feed_mm_min=1.0, timeout_s=5.0)
        assert "not executed" in caught.value.__notes__[0]
    assert [entry for entry in cnc.log if entry[0] == "motion"] == [("motion", 1)]


async def test_numbers_wrap(controller, cnc):
    cnc.peer.put(23, "HHH", 0xFFFF, 0, 0xFFFF)
    await controller.move(TARGET, feed_mm_min=1.0, timeout_s=1.0)
    assert cnc.peer.words[23] == 0


async def test_two_moves_at_once_never_share_a_number(controller, cnc):
    first, second = move(controller), move(controller)
    await asyncio.wait([first, second])
    assert cnc.log.count(("motion", 1)) == 2


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
    assert (status.bank_crc, status.bank_state) == ((0x11112222, 0x33334444), (2, 1))
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
    with pytest.raises(DeviceFault, match="generation changed"):
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


async def test_impossible_commands_never_reach_the_controller(controller, cnc):
    with pytest.raises(Refused):
        await controller.seal(2, 7)
    with pytest.raises(Refused):
        await controller.lease(2**32, 1)
    assert cnc.log == []
