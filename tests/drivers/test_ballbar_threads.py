"""The threads between line and tap when something is short or breaks: they end, and whoever waits hears of it."""

from __future__ import annotations

import asyncio
import errno
import os
import threading
import tty

import pytest

from abbe.drivers.api import BarBatch, BarSample
from abbe.drivers.ballbar.driver import SerialBallBar
from abbe.drivers.ballbar.frames import BarCounters, Conversation, Info
from abbe.drivers.ballbar.stream import Stream
from abbe.drivers.errors import LinkDown, ReplyTimeout
from abbe.drivers.links import reading
from abbe.drivers.links.reading import ReadingThread, Ring
from abbe.drivers.links.serial_link import ByteLink
from abbe.drivers.links.urls import SerialUrl
from tests.patience import within


@pytest.mark.parametrize("call", ["dup", "pipe"])
async def test_no_more_descriptors_is_a_line_that_is_down_and_leaves_nothing_behind(monkeypatch, call: str) -> None:
    def refused(*words: object) -> object:
        raise OSError(errno.EMFILE, os.strerror(errno.EMFILE))

    master, slave = os.openpty()
    tty.setraw(slave)
    bar = SerialBallBar(ByteLink(SerialUrl(os.ttyname(slave)), list))
    files, threads = os.listdir("/proc/self/fd"), set(threading.enumerate())
    with monkeypatch.context() as patched:
        patched.setattr(reading.os, call, refused)
        with pytest.raises(LinkDown, match="Too many open files"):
            await bar.open()
    assert bar.state != "ready"
    assert os.listdir("/proc/self/fd") == files
    assert not [one for one in {*threading.enumerate()} - threads if one.name.startswith(("frame", "read"))]
    await bar.open()
    assert bar.state != "down"
    await bar.close()
    os.close(master)
    os.close(slave)


def test_a_defect_in_the_reading_thread_is_told_as_the_loss_of_the_line() -> None:
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    ring, told, gone = Ring(10), list[OSError | None](), threading.Event()

    def defect(mark: float) -> None:
        raise ValueError(mark)

    ring.on_mark = defect
    thread = ReadingThread(reader, ring, lambda error: (told.append(error), gone.set()), "test")
    os.write(writer, b"12345678")
    assert gone.wait(within(10))
    assert "failed: ValueError" in str(told[0])
    assert ring.take(1.0) is not None
    assert ring.take(1.0) is None
    thread.stop()
    os.close(reader)
    os.close(writer)


class SlowTap:
    """Takes nothing until it is let go; notes how many are in it at once."""

    def __init__(self) -> None:
        self.inside, self.go = threading.Event(), threading.Event()
        self.now = self.most = 0
        self.seqs: list[int] = []

    def take(self, batch: BarBatch) -> None:
        self.now += 1
        self.most = max(self.most, self.now)
        self.inside.set()
        self.go.wait(within(20))
        self.seqs += [one.seq for one in batch.samples]
        self.now -= 1

    def warn(self, text: str) -> None:
        raise AssertionError(text)


async def test_a_stream_is_finished_only_when_nobody_puts_into_it_and_takes_nothing_afterwards() -> None:
    tap = SlowTap()
    stream = Stream("bar", 1000, 30.0, tap, 1)
    samples = [BarSample(seq, 1000 * (seq + 1), 1000 * seq, 8) for seq in range(60)]
    putting = asyncio.create_task(asyncio.to_thread(stream.put, 0.0, samples[:50], overran=False))
    await asyncio.to_thread(tap.inside.wait, 20)
    finishing = asyncio.create_task(asyncio.to_thread(stream.finish))
    done, _ = await asyncio.wait([finishing], timeout=0.2)
    assert not done
    tap.go.set()
    await asyncio.gather(putting, finishing)
    stream.put(0.0, samples[50:], overran=False)
    assert tap.most == 1
    assert tap.seqs == list(range(50))


async def test_samples_that_came_while_this_computer_stalled_are_no_silence() -> None:
    stream = Stream("bar", 1000, 30.0, None, 1)
    getting = asyncio.create_task(stream.get(0.05))
    await asyncio.sleep(0)
    stream.put(0.0, [BarSample(seq, 1000 * (seq + 1), 1000 * seq, 8) for seq in range(50)], overran=False)
    threading.Event().wait(0.2)  # the loop gets no core, and its deadline passes
    assert (await getting).samples[0].seq == 0
    with pytest.raises(TimeoutError):
        await stream.get(0.05)


async def test_a_reply_that_came_while_this_computer_stalled_is_no_silence() -> None:
    async def send(data: bytes) -> None:
        del data

    talk = Conversation("bar", send, BarCounters(), lambda: 0.05, lambda: 0.0)
    asking = asyncio.create_task(talk.identify())
    await asyncio.sleep(0)
    threading.Event().wait(0.2)  # neither the loop nor the threads that read get a core, and the deadline passes
    reply = Info(1, 0x5EED, 7, 0x0110, 2000, 0, "DBB110")
    asyncio.get_running_loop().call_later(0.01, talk.answered, reply)
    assert await asking is reply
    with pytest.raises(ReplyTimeout, match="no answer within"):
        await talk.identify()
