"""What the running path reads, as the browsers get it: the latest minute, and a bounded queue for each that looks on.

A frame is binary, little endian: version (u32, 1), number of the path (u32), number of its first sample (u32), how many follow (u32), when
the last one arrived at the core (f64, UTC ms), then the deviations (f32, µm; NaN: the box did not read).
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
from abbe.service.domain.recorded_path import RecordedPath
from abbe.service.errors import ChannelBroken

VERSION = 1
HEAD = struct.Struct("<IIIId")
FLOAT_B = 4
KEPT_FRAMES = 1200
"""Who comes later gets so many: a minute at 20 Hz."""
QUEUE = 40
"""So many frames wait for one browser; then the oldest go. The disk has had them all."""
MOST_LISTENERS, MOST_EACH = 32, 12
"""Listeners at once, in all and of one account: one account cannot keep the others out."""
_PATH = TypeAdapter(RecordedPath)


class SampleBoard:
    """The path that is recorded now and its latest frames."""

    def __init__(self) -> None:
        self._path: RecordedPath | None = None
        self._frames: deque[bytes] = deque(maxlen=KEPT_FRAMES)
        self._listeners: dict[asyncio.Queue[bytes | None], str] = {}
        self.dropped = 0
        """Frames that some browser was too slow for."""

    def hear_path(self, path: RecordedPath) -> None:
        """The core begins a path, or (number 0) has none any more."""
        self._path = path if path.number else None
        if path.number:
            self._frames.clear()
        self._tell(b"")

    def hear_samples(self, told: LiveSamples) -> None:
        """The core has read more.

        Raises
        ------
        ChannelBroken
            What it sends are no samples.
        """
        try:
            values = b64decode(told.values, validate=True)
        except ValueError:
            raise ChannelBroken("samples on the channel of the service are not base64") from None
        if len(values) % FLOAT_B:
            raise ChannelBroken(f"samples on the channel of the service are {len(values)} bytes long: no float32")
        frame = HEAD.pack(VERSION, told.path, told.first % 2**32, len(values) // FLOAT_B, told.arrived_ms) + values
        self._frames.append(frame)
        self._tell(frame)

    def end(self) -> None:
        """Nobody who looks on waits any longer."""
        self._tell(None)

    def _tell(self, frame: bytes | None) -> None:
        for queue in self._listeners:
            if queue.full():
                queue.get_nowait()
                self.dropped += 1
            queue.put_nowait(frame)

    @contextmanager
    def listener(self, who: str = "") -> Iterator[Callable[[], AsyncIterator[str | bytes]] | None]:
        """A way to get what there is and everything from now on, texts (a path, as JSON) and frames; None: too many look on,
        or too many of this account.
        """
        if len(self._listeners) >= MOST_LISTENERS or list(self._listeners.values()).count(who) >= MOST_EACH:
            yield None
            return
        queue: asyncio.Queue[bytes | None] = asyncio.Queue(QUEUE)
        begun, kept = self._path, b"".join(self._frames)

        async def parts() -> AsyncIterator[str | bytes]:
            told = begun
            yield _text(told)
            if kept and told is not None:
                yield kept
            while (frame := await queue.get()) is not None:
                if self._path is not told:
                    told = self._path
                    yield _text(told)
                if frame:
                    yield frame

        self._listeners[queue] = who
        try:
            yield parts
        finally:
            self._listeners.pop(queue, None)


def _text(path: RecordedPath | None) -> str:
    return '{"number":0}' if path is None else _PATH.dump_json(path).decode()
