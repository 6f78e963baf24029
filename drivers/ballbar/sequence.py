"""Which samples are new, which are missing, which cannot be, and whether the box has started anew: pure bookkeeping, the second gate.

The check sum lets one damaged frame in some 65000 through. Number and device clock count the same periods, so a number that the clock does
not confirm is no sample; neither is a reading beyond the stroke, nor a single one far beside both its neighbours. What is refused here
is counted and becomes part of a gap.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from abbe.drivers.api import BarSample
from abbe.drivers.flags import bar_is_out, overran

_WRAP = 1 << 32
_HALF = _WRAP // 2
_LATE_WINDOW = 128
_Runs = list[tuple[int, list[BarSample]]]
_SLEW_NM_S = 100_000_000  # 100 mm/s: faster than any axis changes a bar's length, and a bar pushed in by hand stays where it is
_JITTER = 0.05  # of a period, between the number and the clock of a sample
_MAX_LOSS = 0.001
_LOSS_FLOOR = 10_000  # samples: a burst at the very beginning is judged as if the run were this long, the rest at its end


@dataclass(frozen=True, slots=True)
class SampleRun:
    """Samples without a gap between them, after ``missing`` lost ones."""

    missing: int
    samples: tuple[BarSample, ...]


@dataclass(frozen=True, slots=True)
class Reads:
    """What is known of the box's settings: their number (bits 8 to 15 of every status) and the stroke."""

    number: int
    range_nm: int


class SegmentEnd(Exception):  # noqa: N818 - an event, not a mistake
    """Nothing after this may be joined to what came before; ``runs`` is what was good until then."""

    runs: list[SampleRun]


class SequenceRestart(SegmentEnd):
    """The numbers or the device clock went back: the box was restarted, or somebody else started a new stream."""


class OtherPace(SegmentEnd):
    """Number and device clock of the samples no longer count the same periods: another rate, or a clock or stream that jumped."""


class OtherSettings(SegmentEnd):
    """Samples come with other settings of the box (unit, range, zero)."""


class SequenceTracker:
    """Follows one stream from its START.

    Parameters
    ----------
    rate_hz : int
        Samples per second that were asked for.
    reads : Reads, optional
        The box's settings, if it tells them: without them the gates of stroke and slew are open.

    Attributes
    ----------
    accepted, lost, overrun, duplicates, strays : int
        Samples given out; missing between them; missing because nobody fetched them from the box in time (it says so): no fault of the
        line; dropped as already known; dropped because number, clock or reading cannot be.
    """

    def __init__(self, rate_hz: int, reads: Reads | None = None) -> None:
        self._period_us = 1_000_000 / rate_hz
        self._next = 0
        self._last_us = -1
        # (least us, most us) to the next sample, stroke nm, slew nm, and which bits of the status have to be what
        open_gates = (1 << 31, 1 << 32, 0, 0)
        gates = open_gates if reads is None else (reads.range_nm, _SLEW_NM_S // rate_hz, 0xFF00, (reads.number & 0xFF) << 8)
        self._plain_limits = ((1.0 - _JITTER) * self._period_us, (1.0 + _JITTER) * self._period_us, *gates)
        self._last_nm: int | None = None
        self._held: BarSample | None = None
        self._stray_before = False
        self.accepted = self.lost = self.overrun = self.duplicates = self.strays = 0

    @property
    def too_lossy(self) -> bool:
        """True as soon as the run cannot end at 0.1 % loss or less, unless it lasts much longer than ``_LOSS_FLOOR`` samples."""
        return self.lost > _MAX_LOSS * max(self.lost + self.accepted, _LOSS_FLOOR)

    @property
    def was_lossy(self) -> bool:
        """True when the run as it stands has lost more than 0.1 %."""
        return self.lost > _MAX_LOSS * (self.lost + self.accepted)

    def accept(self, samples: list[BarSample]) -> list[SampleRun]:
        """Sort samples into runs without gaps; drop and count duplicates, latecomers and what cannot be.

        Raises
        ------
        SequenceRestart
            The stream began anew: nothing after this may be joined to what came before.
        OtherPace
            Two samples in a row do not fit it.
        OtherSettings
            The box reads otherwise than when the stream began.
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
        """The sample that is still weighed when the stream has ended: given as it came, since nothing more will tell."""
        held, self._held = self._held, None
        runs: _Runs = []
        if held is not None:
            self._give((held.seq - self._next) % _WRAP, (held,), runs)
        return _frozen(runs)

    def _plain(self, samples: Sequence[BarSample], at: int) -> int:
        """Find where the samples that simply go on end, so that a good line costs next to nothing."""
        if self._held is not None or self._last_us < 0:
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
        for good in self._weighed(sample) if self._held is not None or self._jumps(sample) else (sample,):
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
        """Say why this cannot be the sample ``ahead`` places on, or nothing."""
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
        # One such sample is a damaged frame; two in a row are another stream, another rate or a clock that jumped.
        self.strays += 1
        if sample.device_us <= self._last_us or self._stray_before:
            raise kind(reason)
        self._stray_before = True

    def _late(self, sample: BarSample, behind: int) -> None:
        # A true latecomer is recent and carries the time that belongs to its number; anything else is another stream.
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
        """Keep a reading that jumps until the next one says whether it was a step or a single false value."""
        held = self._held
        if held is None:
            self._held = sample
            return ()
        if (sample.seq - held.seq) % _WRAP >= _HALF:  # it belongs before the one that is kept
            return (sample,)
        if sample.seq == held.seq:
            self.duplicates += 1
            return ()
        self._held = None
        back = self._last_nm is not None and abs(sample.reading_nm - self._last_nm) <= 2 * self._plain_limits[3]
        if back and abs(sample.reading_nm - held.reading_nm) > self._plain_limits[3] and not bar_is_out(sample.status):
            self.strays += 1
            return (sample,)
        return (held, sample)


def _frozen(runs: _Runs) -> list[SampleRun]:
    return [SampleRun(missing, tuple(samples)) for missing, samples in runs]
