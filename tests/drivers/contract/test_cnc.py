"""The controller driver against a controller on a real socket that can misbehave: identity, status and moves."""

from __future__ import annotations

import asyncio

import pytest

from abbe.drivers.cnc.registers import Bit, conditions_of
from abbe.drivers.errors import DeviceFault, Rebooted, Refused, ReplyTimeout, WrongDevice
from abbe.drivers.registry import open_controller
from tests.drivers.contract.cnc_peer import READY, TARGET, hang_up, honest, move, silent

# ---- identity and status


async def test_identify_and_status(controller):
    assert (await controller.identify()).boot_id == 100
    status = await controller.status()
    assert status.conditions == conditions_of(READY)
    assert (await controller.block()).fifo_free == 8192


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
    with pytest.raises(ReplyTimeout, match="Abbe set feed hold"):
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
