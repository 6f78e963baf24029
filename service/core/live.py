"""Shows the web process what the running path reads, twenty times a second, and never waits for it."""

from __future__ import annotations

import asyncio
from base64 import b64encode
from dataclasses import asdict

from abbe.service.capture.live import LiveFeed, Stretch
from abbe.service.channel.messages import LivePath, LiveSamples
from abbe.service.channel.wire import Wire
from abbe.service.clock import Clock

FRAME_S = 0.05
"""Between two messages: 20 Hz, about 50 samples each at 1 kHz."""
NO_PATH = LivePath("path", 0, "", "", 0.0, 0.0, 0, 0.0, ())
WORD = 200


async def show_live(wire: Wire, live: LiveFeed, clock: Clock) -> None:
    """Tell every path and what it reads, until cancelled. A web process that does not read in time misses samples, and the disk none."""
    live.stretches()  # what came in while nobody looked on is old: it would be seconds of samples at once
    told = 0
    while True:
        await live.active.wait()
        while live.path is not None:
            if not wire.is_full:
                told = _told(wire, live, told)
                for part in live.stretches():
                    wire.send(_message(part, clock))
            await asyncio.sleep(FRAME_S)
        if told:
            wire.send(NO_PATH)
            told = 0


def _told(wire: Wire, live: LiveFeed, told: int) -> int:
    path = live.path
    if path is None or path.number == told:
        return told
    wire.send(LivePath("path", **asdict(path) | {"run": path.run[:WORD], "test": path.test[:WORD]}))
    return path.number


def _message(part: Stretch, clock: Clock) -> LiveSamples:
    # The instant at which the samples came in was read off the monotonic clock; a browser knows only the calendar's.
    ago_s = clock.monotonic_s() - part.host_s
    arrived_ms = clock.utc().timestamp() * 1e3 - ago_s * 1e3
    return LiveSamples("samples", part.path, part.first, arrived_ms, b64encode(part.values_um.astype("<f4").tobytes()).decode("ascii"))
