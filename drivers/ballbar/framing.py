"""The thread between the ring of bytes and the stream: it frames, gives samples to the stream and answers to the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

from abbe.drivers.api import BarSample
from abbe.drivers.ballbar import frames
from abbe.drivers.ballbar.sequence import SegmentEnd
from abbe.drivers.ballbar.stream import Stream
from abbe.drivers.links.reading import Ring

_TAKE_S = 3600.0
_STOP_S = 2.0


@dataclass(slots=True)
class BarCounters:
    """What came over the wire so far, for diagnostics: whole frames, and what went wrong; none of that reaches the data.

    ``bad_frames``: looked like frames until the check sum. ``strays``: samples that cannot be (see `abbe.drivers.ballbar.sequence`).
    ``lost``: samples missing between others. ``overflow``: samples that a slow consumer without a tap let go.
    """

    frames: int = 0
    bad_bytes: int = 0
    bad_frames: int = 0
    duplicates: int = 0
    strays: int = 0
    lost: int = 0
    overflow: int = 0


class Framing:
    """Frames what the ring holds until the ring ends.

    Parameters
    ----------
    ring : Ring
        Filled by the reading thread.
    counters : BarCounters
        Kept up to date.
    answered : callable
        Called in the event loop with each frame that answers a command.
    restarted : callable
        Called in the event loop with the stream and the reason when the box began anew, or reads otherwise, in the middle of it.
    broken : callable
        Called in the event loop with a defect that ended this thread.
    """

    def __init__(
        self,
        name: str,
        ring: Ring,
        counters: BarCounters,
        answered: Callable[[frames.Answer], None],
        restarted: Callable[[Stream, SegmentEnd], None],
        broken: Callable[[Exception], None],
    ) -> None:
        self.ring = ring
        self.stream: Stream | None = None
        """Where samples go; set from the event loop between STOP and START."""
        self._counters, self._answered, self._restarted, self._broken = counters, answered, restarted, broken
        self._loop = asyncio.get_running_loop()
        self._overran = False
        ring.on_mark = self._mark
        self._thread = threading.Thread(target=self._run, name=f"frame {name}", daemon=True)
        self._thread.start()

    @property
    def runs(self) -> bool:
        """False once the line has ended."""
        return self._thread.is_alive()

    async def drained(self, within_s: float) -> bool:
        """Wait until everything that was read so far is framed and given on; False when it was not in this time, or the thread has died."""
        return await asyncio.to_thread(self.ring.drained, within_s) if self.runs else not self.ring.fill

    async def ended(self) -> None:
        """Wait until everything that was read is framed, two seconds at the most (a disk that hangs may hold the tap)."""
        await asyncio.to_thread(self._thread.join, _STOP_S)

    def _run(self) -> None:
        decoder = frames.FrameDecoder()
        try:
            while (pieces := self.ring.take(_TAKE_S)) is not None:
                for piece in pieces:
                    self._overran |= bool(piece.lost_before)
                if pieces:
                    self._sort(pieces[-1].host_s, decoder.feed(b"".join([piece.data for piece in pieces])))
        except Exception as error:  # noqa: BLE001 - a thread that ends in silence would look like a mute box
            self._tell(self._broken, error)

    def _sort(self, host_s: float, received: list[frames.Frame]) -> None:
        samples: list[BarSample] = []
        self._counters.frames += len(received)
        for frame in received:
            if type(frame) is BarSample:
                samples.append(frame)
            elif isinstance(frame, frames.Bad):
                self._counters.bad_bytes += frame.n_bytes
                self._counters.bad_frames += frame.reason == "check sum"
                self._counters.frames -= 1
            else:
                self._give(host_s, samples)  # what came before an answer is stored before whoever waits for it goes on
                samples = []
                self._tell(self._answered, frame)
        self._give(host_s, samples)

    def _give(self, host_s: float, samples: list[BarSample]) -> None:
        stream = self.stream
        if stream is None or not samples:
            return
        tracker, counters = stream.tracker, self._counters
        before = (tracker.duplicates, tracker.strays, tracker.lost, stream.overflow)
        try:
            stream.put(host_s, samples, overran=self._overran)
            self._overran = False
        except SegmentEnd as event:
            self._tell(self._restarted, stream, event)
            if self.stream is stream:
                self.stream = None
        counters.duplicates += tracker.duplicates - before[0]
        counters.strays += tracker.strays - before[1]
        counters.lost += tracker.lost - before[2]
        counters.overflow += stream.overflow - before[3]

    def _mark(self, mark: float) -> None:
        stream = self.stream  # the event loop may take it away meanwhile
        if stream is not None:
            stream.mark(mark)

    def _tell(self, call: Callable[..., None], *arguments: object) -> None:
        with suppress(RuntimeError):  # the loop has been closed: nobody is left to tell
            self._loop.call_soon_threadsafe(call, *arguments)
