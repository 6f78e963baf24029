"""The core shows its paths over the real channel: each told once, then its samples, then that there is none; nobody is waited for."""

from __future__ import annotations

import asyncio
import socket
from base64 import b64decode

import numpy as np

from abbe.service.capture.live import LiveFeed
from abbe.service.channel.messages import LiveMachine, LivePath, LiveSamples, Wire, encode, from_core
from abbe.service.clock import SystemClock
from abbe.service.core.web_process import show_live
from abbe.service.domain.progress import MachineReading
from tests.patience import within
from tests.service.capture.test_live import QUARTER, SETUP, batch


async def hear(wire: Wire) -> LivePath | LiveSamples:
    async with asyncio.timeout(within(30)):
        body = await wire.receive()
    assert body is not None
    told = from_core(body)
    assert isinstance(told, LivePath | LiveSamples)
    return told


async def test_a_path_its_samples_and_its_end() -> None:
    ours, theirs = socket.socketpair()
    core, web = await Wire.over(ours), await Wire.over(theirs)
    feed, clock = LiveFeed(), SystemClock()
    showing = asyncio.create_task(show_live(core, feed, clock))
    for number in (1, 2):
        feed.begin(f"helix{number}", "ballbar_helix", SETUP, (QUARTER, 6000.0, 1000))
        path = await hear(web)
        assert isinstance(path, LivePath)
        assert (path.path.number, path.path.run, path.path.rate_hz) == (number, f"helix{number}", 1000)
        before_ms = clock.utc().timestamp() * 1e3
        feed.take(batch(7, [1000, -2000], host_s=clock.monotonic_s()))
        told = await hear(web)
        assert isinstance(told, LiveSamples)
        assert (told.path, told.first) == (number, 0)
        assert np.frombuffer(b64decode(told.values), "<f4").tolist() == [1.0, -2.0]
        assert before_ms - 50.0 <= told.arrived_ms <= clock.utc().timestamp() * 1e3 + 50.0
        feed.end()
        ended = await hear(web)
        assert isinstance(ended, LivePath)
        assert ended.path.number == 0
    showing.cancel()
    await asyncio.gather(showing, return_exceptions=True)
    core.close()
    web.close()


async def test_the_machine_is_told_while_it_is_measured_and_then_that_it_is_not() -> None:
    ours, theirs = socket.socketpair()
    core, web = await Wire.over(ours), await Wire.over(theirs)
    feed = LiveFeed()
    showing = asyncio.create_task(show_live(core, feed, SystemClock()))
    reading = MachineReading(
        at_ms=0.0, position_mm=(1.0, 2.0, 3.0), feed_mm_min=600.0, override_percent=100, door_open=False, air_c=20.5,
        laser_at_ms=None, laser_mm=None, beam_good=False,
    )  # fmt: skip
    with feed.showing(lambda: reading):
        for _ in range(2):
            async with asyncio.timeout(within(30)):
                assert await web.receive() == encode(LiveMachine("machine", reading))
    async with asyncio.timeout(within(30)):
        while (body := await web.receive()) == encode(LiveMachine("machine", reading)):
            pass
    assert body == encode(LiveMachine("machine", None))
    showing.cancel()
    await asyncio.gather(showing, return_exceptions=True)
    core.close()
    web.close()


async def test_a_web_process_that_does_not_read_is_not_waited_for_and_costs_no_memory() -> None:
    ours, theirs = socket.socketpair()
    core = await Wire.over(ours)
    feed = LiveFeed()
    while not core.is_full:
        core._writer.write(bytes(100_000))
    waiting = core._writer.transport.get_write_buffer_size()
    feed.begin("helix", "ballbar_helix", SETUP, (QUARTER, 6000.0, 1000))
    showing = asyncio.create_task(show_live(core, feed, SystemClock()))
    for k in range(5000):
        feed.take(batch(k, [k]))
        await asyncio.sleep(0)
    assert core._writer.transport.get_write_buffer_size() <= waiting
    assert len(feed._batches) <= 2000
    assert not showing.done()
    showing.cancel()
    await asyncio.gather(showing, return_exceptions=True)
    core.close()
    theirs.close()
