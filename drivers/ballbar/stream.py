"""Check the order of samples, and deliver them as a stream.

Sequence numbers and device time distinguish gaps, duplicates, late samples and restarts (`SequenceTracker`). A `Stream` passes samples from
the framing thread to the tap, which records them, and to a consumer in the event loop.
"""

from __future__ import annotations

import asyncio
import threading
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

from abbe.drivers.api import BarBatch, BarSample, BarTap, bar_is_out, overran
from abbe.drivers.errors import Backpressure, BadFrame, DriverError, LossyLine

_WRAP = 1 << 32
_HALF = _WRAP // 2
_LATE_WINDOW = 128
_Runs = list[tuple[int, list[BarSample]]]
_SLEW_NM_S = 100_000_000  # 100 mm/s: no axis changes the bar's length faster; a bar pushed by hand does, but then keeps its new length
_JITTER = 0.05  # of a period: by how much a sample's device time may differ from its number
_MAX_LOSS = 0.001
_LOSS_FLOOR = 10_000  # samples: an early burst is judged as if the run were this long; the whole run is judged at its end


@dataclass(frozen=True, slots=True)
class SampleRun:
    """Samples without a gap between them, after ``missing`` lost ones."""

    missing: int
    samples: tuple[BarSample, ...]


@dataclass(frozen=True, slots=True)
class Reads:
    """Known settings of the box: their change number (in bits 8 to 15 of every status) and the stroke to either side."""

    number: int
    range_nm: int


class SegmentEnd(Exception):  # noqa: N818 - an event, not a mistake
    """Samples before and after this event must not be joined; ``runs`` are the good samples before it."""

    runs: list[SampleRun]


class SequenceRestart(SegmentEnd):
    """The numbers or the device clock went back: the box restarted, or another program started a new stream."""


class OtherPace(SegmentEnd):
    """Sequence number and device clock disagree: the rate changed, or the clock or the stream jumped."""


class OtherSettings(SegmentEnd):
    """Samples come with other settings of the box (unit, range, zero)."""


class SequenceTracker:
    """Checks the samples of one stream from its START. Without the box's settings (``reads``) stroke and slew are not checked.

    Attributes
    ----------
    accepted, lost, overrun, duplicates, strays : int
        Samples delivered; missing on the line; missing because the box's buffer overran (by its status); dropped as duplicates; dropped
        because number, clock or reading is impossible.
    """

    def __init__(self, rate_hz: int, reads: Reads | None = None) -> None:
        self._period_us = 1_000_000 / rate_hz
        self._next = 0
        self._last_us = -1
        # (least us, most us) to the next sample, stroke nm, slew nm, mask of the status, and its required value
        open_gates = (1 << 31, 1 << 32, 0, 0)
        gates = open_gates if reads is None else (reads.range_nm, _SLEW_NM_S // rate_hz, 0xFF00, (reads.number & 0xFF) << 8)
        self._plain_limits = ((1.0 - _JITTER) * self._period_us, (1.0 + _JITTER) * self._period_us, *gates)
        self._last_nm: int | None = None
        self._candidate: BarSample | None = None
        self._stray_before = False
        self.accepted = self.lost = self.overrun = self.duplicates = self.strays = 0

    @property
    def too_lossy(self) -> bool:
        """Whether more than 0.1 % of the samples so far, or of ``_LOSS_FLOOR`` samples if there are fewer, are lost."""
        return self.lost > _MAX_LOSS * max(self.lost + self.accepted, _LOSS_FLOOR)

    @property
    def was_lossy(self) -> bool:
        """Whether more than 0.1 % of the samples so far are lost, however few there are."""
        return self.lost > _MAX_LOSS * (self.lost + self.accepted)

    def accept(self, samples: list[BarSample]) -> list[SampleRun]:
        """Sort samples into runs without gaps; drop and count duplicates, late samples and impossible ones.

        Raises
        ------
        SequenceRestart
            The stream began anew: samples before and after must not be joined.
        OtherPace
            Two consecutive samples have an impossible clock or reading.
        OtherSettings
            The box's settings changed since the stream began.
        """
        runs: _Runs = []
        at = 0
        try:
            while at < len(samples):
                plain = self._plain(samples, at)
                if plain > at:
                    self._give(0, samples[at:plain], runs)
                if plain < len(samples):
                    self._odd(samples[plain], runs)
                at = plain + 1
        except SegmentEnd as end:
            end.runs = _frozen(runs)
            raise
        return _frozen(runs)

    def rest(self) -> list[SampleRun]:
        """Return the candidate of `_weighed`, if any, at the end of the stream: no further sample comes to judge it."""
        candidate, self._candidate = self._candidate, None
        runs: _Runs = []
        if candidate is not None:
            self._give((candidate.seq - self._next) % _WRAP, (candidate,), runs)
        return _frozen(runs)

    def _plain(self, samples: Sequence[BarSample], at: int) -> int:
        """Return the index of the first sample from ``at`` on that fails a simple check. Fast path for a good line."""
        if self._candidate is not None or self._last_us < 0:
            return at
        expected, last_us, last_nm = self._next, self._last_us, self._last_nm
        least_us, most_us, limit_nm, step_nm, mask, number = self._plain_limits
        while at < len(samples):
            sample = samples[at]
            nm = sample.reading_nm
            if sample.seq != expected or not least_us <= sample.device_us - last_us <= most_us or sample.status & mask != number:
                break
            if last_nm is None or not (-step_nm <= nm - last_nm <= step_nm and -limit_nm <= nm <= limit_nm):
                break
            expected, last_us, last_nm = (expected + 1) % _WRAP, sample.device_us, nm
            at += 1
        return at

    def _odd(self, sample: BarSample, runs: _Runs) -> None:
        ahead = (sample.seq - self._next) % _WRAP
        if ahead >= _HALF:
            self._late(sample, _WRAP - ahead)
            return
        kind, reason = self._misfit(sample, ahead)
        if reason:
            self._refuse(sample, kind, reason)
            return
        for good in self._weighed(sample) if self._candidate is not None or self._jumps(sample) else (sample,):
            self._give((good.seq - self._next) % _WRAP, (good,), runs)

    def _give(self, missing: int, samples: Sequence[BarSample], runs: _Runs) -> None:
        if missing or not runs:
            runs.append((missing, []))
            if overran(samples[0].status):
                self.overrun += missing
            else:
                self.lost += missing
        runs[-1][1].extend(samples)
        last = samples[-1]
        self.accepted += len(samples)
        self._next = (last.seq + 1) % _WRAP
        self._last_us = last.device_us
        self._last_nm = None if bar_is_out(last.status) else last.reading_nm
        self._stray_before = False

    def _misfit(self, sample: BarSample, ahead: int) -> tuple[type[SegmentEnd], str]:
        """Return error class and reason why this sample cannot follow after ``ahead`` missing samples; no reason: the sample can."""
        reason = self._clock_misfit(sample.device_us - self._last_us, ahead + 1)
        _, _, limit_nm, _, mask, number = self._plain_limits
        if not reason and sample.status & mask != number:
            return OtherSettings, f"sample {sample.seq} was taken with settings {sample.status >> 8} instead of {number >> 8}"
        if not reason and abs(sample.reading_nm) > limit_nm and not bar_is_out(sample.status):
            reason = f"sample {sample.seq} reads {sample.reading_nm} nm, the stroke ends at {limit_nm} nm"
        return SequenceRestart if sample.device_us <= self._last_us else OtherPace, reason

    def _clock_misfit(self, step_us: int, steps: int) -> str:
        if self._last_us < 0:
            return ""
        off_us = abs(step_us - steps * self._period_us)
        if off_us <= (_JITTER + 0.01 * (steps - 1)) * self._period_us:
            return ""
        return f"{steps} samples took the device {step_us} us instead of {steps * self._period_us:g} us"

    def _refuse(self, sample: BarSample, kind: type[SegmentEnd], reason: str) -> None:
        # One such sample is a damaged frame; two in a row mean another stream, another rate or a clock jump.
        self.strays += 1
        if sample.device_us <= self._last_us or self._stray_before:
            raise kind(reason)
        self._stray_before = True

    def _late(self, sample: BarSample, behind: int) -> None:
        # A late sample is recent and its time matches its number; anything else is another stream.
        expected_us = self._last_us - (behind - 1) * self._period_us
        tolerance_us = (2 + 0.01 * behind) * self._period_us
        if behind > _LATE_WINDOW or abs(sample.device_us - expected_us) > tolerance_us:
            raise SequenceRestart(f"sample number went back from {(self._next - 1) % _WRAP} to {sample.seq}")
        self.duplicates += 1

    def _jumps(self, sample: BarSample) -> bool:
        return (
            self._last_nm is not None and abs(sample.reading_nm - self._last_nm) > self._plain_limits[3] and not bar_is_out(sample.status)
        )

    def _weighed(self, sample: BarSample) -> tuple[BarSample, ...]:
        """Hold back a reading that jumps (the candidate) until the next reading shows whether it was a step or a single false value."""
        candidate = self._candidate
        if candidate is None:
            self._candidate = sample
            return ()
        if (sample.seq - candidate.seq) % _WRAP >= _HALF:  # a late sample from before the candidate
            return (sample,)
        if sample.seq == candidate.seq:
            self.duplicates += 1
            return ()
        self._candidate = None
        back = self._last_nm is not None and abs(sample.reading_nm - self._last_nm) <= 2 * self._plain_limits[3]
        if back and abs(sample.reading_nm - candidate.reading_nm) > self._plain_limits[3] and not bar_is_out(sample.status):
            self.strays += 1
            return (sample,)
        return (candidate, sample)


def _frozen(runs: _Runs) -> list[SampleRun]:
    return [SampleRun(missing, tuple(samples)) for missing, samples in runs]


STOP_FILL = 0.8


class Stream:
    """Sorts samples, passes each to the tap in the framing thread, and buffers ``buffer_s`` seconds of them for a slow consumer.

    Without a tap, samples that do not fit into the buffer are reported as missing. With a tap all samples are recorded, but the stream
    fails at 80 % of the buffer: the consumer watches the machine and must not be that far behind.
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
            The stream began anew, or its pace or the box's settings changed. Only the samples before this event are taken.
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
        """Deliver the last sample to the tap after the box has stopped. May wait for a slow tap."""
        with self._putting:  # the framing thread may still be in the middle of a batch
            if not self._finished:
                self._finished = True
                self._take(self._host_s, self.tracker.rest(), overran=False)

    def verdict(self, bad_bytes: int) -> DriverError | None:
        """Judge the line after a stream that ended normally: `LossyLine` invalidates the stream, `BadFrame` is a note, None is good."""
        tracker = self.tracker
        if tracker.was_lossy:
            return self.lossy()
        if not bad_bytes and not tracker.lost and not tracker.strays and not tracker.duplicates:
            return None
        detail = (
            f"{bad_bytes} bad bytes; of {tracker.lost + tracker.accepted} samples {tracker.lost} were lost, {tracker.strays} impossible, "
            f"{tracker.duplicates} came twice or late"
        )
        return BadFrame(self._device, "read samples", detail, "Abbe records every gap; if gaps come often, check the cable and its shield")

    def lossy(self) -> LossyLine:
        """Return the error for a stream that has lost too many samples."""
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
            if self._left or self._error is not None:  # samples after an error must not be joined to earlier ones
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
            self.fail(Backpressure(self._device, "watch the samples", f"the buffer of samples to watch is {behind:.0%} full", SLOW))
        self._wake()

    def mark(self, fill: float) -> None:
        """Warn the tap that the ring buffer has reached this fill (0 to 1); from 80 % on, fail the stream. Called in the reading thread."""
        text = f"the ring between reading and storing is {fill:.0%} full"
        if self.tap is not None:
            self.tap.warn(text)
            if fill >= STOP_FILL:
                self.fail(Backpressure(self._device, "store the samples", text, SLOW))

    def fail(self, error: DriverError) -> None:
        """End the stream after the buffered samples; back-pressure ends it at once, because the machine must stop."""
        with self._lock:
            if self._error is None:
                self._error = error
            if isinstance(error, Backpressure):
                self._batches.clear()
        self._wake()

    def leave(self) -> None:
        """Stop buffering after the consumer has left; the tap continues until the box has stopped."""
        with self._lock:
            self._left = True
            self._batches.clear()

    async def get(self, timeout_s: float) -> BarBatch:
        """Wait for the next batch; raises TimeoutError if none came. A batch that arrived while this computer stalled still counts."""
        try:
            async with asyncio.timeout(timeout_s):
                while not self._batches and self._error is None:
                    self._news.clear()
                    if not self._batches and self._error is None:
                        await self._news.wait()
        except TimeoutError:
            if not self._batches and self._error is None:
                raise
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
