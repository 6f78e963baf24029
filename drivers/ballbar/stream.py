"""One stream of samples between the thread that frames them and those who want them: the tap to the disk, a consumer in the event loop."""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from contextlib import suppress

from abbe.drivers.api import BarBatch, BarSample, BarTap
from abbe.drivers.ballbar.sequence import Reads, SampleRun, SegmentEnd, SequenceTracker
from abbe.drivers.errors import Backpressure, BadFrame, DriverError, LossyLine

STOP_FILL = 0.8


class Stream:
    """Sorts samples, gives every one to the tap, and buffers them for a consumer who may be slow.

    The buffer is bounded. Without a tap, what does not fit is reported as missing; with a tap it is safe already, and a consumer so far
    behind (he watches the machine) is a reason to stop.

    Parameters
    ----------
    device : str
        Name for errors.
    rate_hz : int
        Samples per second asked for.
    buffer_s : float
        Room for the consumer, seconds of samples.
    tap : BarTap or None
        Takes every sample first, in the framing thread.
    boot_id : int
        Of the box.
    reads : Reads, optional
        The box's settings, if it tells them.
    """

    def __init__(self, device: str, rate_hz: int, buffer_s: float, tap: BarTap | None, boot_id: int, *, reads: Reads | None = None) -> None:
        self.tap = tap
        self.tracker = SequenceTracker(rate_hz, reads)
        self.overflow = 0
        self._device, self._boot_id = device, boot_id
        self._size = self._room = int(buffer_s * rate_hz)
        self._batches: deque[BarBatch] = deque()
        self._lost = 0
        self._host_s = 0.0
        self._error: DriverError | None = None
        self._left = False
        self._lock = threading.Lock()
        self._putting = threading.Lock()
        self._finished = False
        self._news = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    def put(self, host_s: float, samples: list[BarSample], *, overran: bool) -> None:
        """Take samples in the framing thread.

        Raises
        ------
        SegmentEnd
            The stream began anew, or the box reads otherwise now; what came before that was taken, nothing after it.
        """
        with self._putting:
            if self._finished:
                return
            self._host_s = host_s
            try:
                self._take(host_s, self.tracker.accept(samples), overran=overran)
            except SegmentEnd as end:
                self._take(host_s, end.runs, overran=overran)
                raise
            if self.tracker.too_lossy and self._error is None:
                self.fail(self.lossy())

    def finish(self) -> None:
        """The box has stopped: the tap gets what was still weighed, and nothing after it. May wait for a slow tap."""
        with self._putting:  # the framing thread may still be in the middle of a batch
            if not self._finished:
                self._finished = True
                self._take(self._host_s, self.tracker.rest(), overran=False)

    def verdict(self, bad_bytes: int) -> DriverError | None:
        """What the line did to a stream that ended as it should: `LossyLine` refuses it, `BadFrame` is only to be noted."""
        tracker = self.tracker
        if tracker.was_lossy:
            return self.lossy()
        if not bad_bytes and not tracker.lost and not tracker.strays and not tracker.duplicates:
            return None
        detail = (
            f"{bad_bytes} bad bytes; of {tracker.lost + tracker.accepted} samples {tracker.lost} were lost, {tracker.strays} could not be, "
            f"{tracker.duplicates} came twice or late"
        )
        return BadFrame(
            self._device, "read samples", detail, "every gap is recorded; if it happens often, look at the cable and its shield"
        )

    def lossy(self) -> LossyLine:
        """The error of a run that has lost too much."""
        lost, total = self.tracker.lost, self.tracker.lost + self.tracker.accepted
        detail = f"{lost} of {total} samples were lost on the line ({lost / total:.2%}; 0.1 % is the most that a run may lose)"
        return LossyLine(
            self._device,
            "read samples",
            detail,
            "keep the cable away from drives and motors, check its shield and plugs, then measure again",
        )

    def _take(self, host_s: float, runs: list[SampleRun], *, overran: bool) -> None:
        for run in runs:
            batch = BarBatch(host_s, run.samples, run.missing, self._boot_id, overran and bool(run.missing))
            if self.tap is not None:
                self.tap.take(batch)
            self._buffer(batch)

    def _buffer(self, batch: BarBatch) -> None:
        count = len(batch.samples)
        with self._lock:
            if self._left or self._error is not None:  # nothing after the reason to stop may be joined to what came before it
                return
            if count > self._room:
                self._lost += batch.missing + count
                self.overflow += count
            else:
                self._room -= count
                missing, self._lost = batch.missing + self._lost, 0
                self._batches.append(BarBatch(batch.host_s, batch.samples, missing, batch.boot_id, batch.overran))
            behind = 1.0 - self._room / self._size
        if self.tap is not None and behind >= STOP_FILL:
            self.fail(Backpressure(self._device, "watch the samples", f"the program is {behind:.0%} of its buffer behind", SLOW))
        self._wake()

    def mark(self, fill: float) -> None:
        """The ring between reading and framing has filled up to this mark (reading thread)."""
        text = f"the ring between reading and storing is {fill:.0%} full"
        if self.tap is not None:
            self.tap.warn(text)
            if fill >= STOP_FILL:
                self.fail(Backpressure(self._device, "store the samples", text, SLOW))

    def fail(self, error: DriverError) -> None:
        """End the stream, after what is already buffered; back-pressure ends it at once, since the machine has to be stopped."""
        with self._lock:
            if self._error is None:
                self._error = error
            if isinstance(error, Backpressure):
                self._batches.clear()
        self._wake()

    def leave(self) -> None:
        """The consumer has gone; the tap goes on until the box has stopped."""
        with self._lock:
            self._left = True
            self._batches.clear()

    async def get(self, timeout_s: float) -> BarBatch:
        """Wait for the next batch; TimeoutError when none comes."""
        async with asyncio.timeout(timeout_s):
            while not self._batches and self._error is None:
                self._news.clear()
                if not self._batches and self._error is None:
                    await self._news.wait()
        with self._lock:
            if self._batches:
                batch = self._batches.popleft()
                self._room += len(batch.samples)
                return batch
        assert self._error is not None
        raise self._error

    def _wake(self) -> None:
        if not self._news.is_set():
            with suppress(RuntimeError):  # the loop has been closed
                self._loop.call_soon_threadsafe(self._news.set)


SLOW = "free this computer from other work, check its disk, then measure this test again"
