"""Live samples of the running path for browsers: the latest minute, and a bounded queue for each listener.

A frame is binary, little endian: version (u32, 1), number of the path (u32), number of its first sample (u32), count of samples (u32),
arrival of the last sample at the core (f64, UTC ms), then the deviations (f32, µm; NaN: no reading).
"""

from __future__ import annotations

import asyncio
import struct
from base64 import b64decode
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import contextmanager

from pydantic import TypeAdapter

from abbe.service.channel.messages import LiveSamples
from abbe.service.domain.progress import MachineReading, RecordedPath
from abbe.service.errors import ChannelBroken

VERSION = 1
HEAD = struct.Struct("<IIIId")
FLOAT_B = 4
KEPT_FRAMES = 1200
"""Frames that a new listener gets at once: a minute at 20 Hz."""
QUEUE = 40
"""Frames that wait for one browser; then the oldest are dropped. The recording on disk is complete."""
MOST_LISTENERS, MOST_EACH = 32, 12
"""Simultaneous listeners, in all and per account: one account cannot shut out the others."""
_PATH = TypeAdapter(RecordedPath)
_MACHINE = TypeAdapter(dict[str, MachineReading | None])


class SampleBoard:
    """The path that is being recorded and its latest frames."""

    def __init__(self) -> None:
        self._path: RecordedPath | None = None
        self._frames: deque[bytes] = deque(maxlen=KEPT_FRAMES)
        self._listeners: dict[asyncio.Queue[bytes | str | None], str] = {}
        self.dropped = 0
        """Number of frames that were dropped for slow browsers."""

    def set_path(self, path: RecordedPath) -> None:
        """Set the path that is being recorded; number 0: none."""
        self._path = path if path.number else None
        if path.number:
            self._frames.clear()
        self._publish(b"")

    def set_machine(self, machine: MachineReading | None) -> None:
        """Pass the state of the machine on to the listeners; None: it is not measured any more."""
        self._publish(_MACHINE.dump_json({"machine": machine}).decode())

    def add_samples(self, samples: LiveSamples) -> None:
        """Pass new samples on to the listeners. Raises ChannelBroken if they cannot be decoded."""
        try:
            values = b64decode(samples.values, validate=True)
        except ValueError:
            raise ChannelBroken("samples on the channel of the service are not base64") from None
        if len(values) % FLOAT_B:
            raise ChannelBroken(f"samples on the channel of the service are {len(values)} bytes long, not a multiple of 4")
        frame = HEAD.pack(VERSION, samples.path, samples.first % 2**32, len(values) // FLOAT_B, samples.arrived_ms) + values
        self._frames.append(frame)
        self._publish(frame)

    def end(self) -> None:
        """Release all listeners."""
        self._publish(None)

    def _publish(self, frame: bytes | str | None) -> None:
        for queue in self._listeners:
            if queue.full():
                queue.get_nowait()
                self.dropped += 1
            queue.put_nowait(frame)

    @contextmanager
    def listener(self, who: str = "") -> Iterator[Callable[[], AsyncIterator[str | bytes]] | None]:
        """Subscribe to the kept and all later frames: text (a path or the state of the machine as JSON) and binary.

        Yields None if this account or all together have too many listeners.
        """
        if len(self._listeners) >= MOST_LISTENERS or list(self._listeners.values()).count(who) >= MOST_EACH:
            yield None
            return
        queue: asyncio.Queue[bytes | str | None] = asyncio.Queue(QUEUE)
        begun, kept = self._path, b"".join(self._frames)

        async def parts() -> AsyncIterator[str | bytes]:
            path = begun
            yield _text(path)
            if kept and path is not None:
                yield kept
            while (frame := await queue.get()) is not None:
                if self._path is not path:
                    path = self._path
                    yield _text(path)
                if frame:
                    yield frame

        self._listeners[queue] = who
        try:
            yield parts
        finally:
            self._listeners.pop(queue, None)


def _text(path: RecordedPath | None) -> str:
    return '{"number":0}' if path is None else _PATH.dump_json(path).decode()
