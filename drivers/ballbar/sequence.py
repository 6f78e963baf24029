"""Which samples are new, which are missing, and whether the box has started anew: pure bookkeeping of sequence numbers."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.api import BarSample

_WRAP = 1 << 32
_LATE_WINDOW = 128


@dataclass(frozen=True, slots=True)
class Run:
    """Samples without a gap between them, after ``missing`` lost ones."""

    missing: int
    samples: tuple[BarSample, ...]


class SequenceRestart(Exception):  # noqa: N818 - an event, not a mistake
    """The numbers or the device clock went back: the box was restarted, or somebody else started a new stream."""


class SequenceTracker:
    """Follows one stream from its START.

    Parameters
    ----------
    rate_hz : int
        Samples per second that were asked for.
    """

    def __init__(self, rate_hz: int) -> None:
        self._period_us = 1_000_000 / rate_hz
        self._next = 0
        self._last_us = -1
        self.duplicates = 0

    def accept(self, samples: list[BarSample]) -> list[Run]:
        """Sort samples into runs without gaps; drop and count duplicates and latecomers.

        Raises
        ------
        SequenceRestart
            The stream began anew: nothing after this may be joined to what came before.
        """
        runs: list[Run] = []
        current: list[BarSample] = []
        missing = 0
        for sample in samples:
            ahead = (sample.seq - self._next) % _WRAP
            if ahead >= _WRAP // 2:
                self._check_late(sample, _WRAP - ahead)
                self.duplicates += 1
                continue
            if sample.device_us <= self._last_us:
                raise SequenceRestart(f"sample {sample.seq}: device time went back from {self._last_us} to {sample.device_us} us")
            if ahead:
                if current:
                    runs.append(Run(missing, tuple(current)))
                missing, current = ahead, []
            current.append(sample)
            self._next = (sample.seq + 1) % _WRAP
            self._last_us = sample.device_us
        if current:
            runs.append(Run(missing, tuple(current)))
        return runs

    def _check_late(self, sample: BarSample, behind: int) -> None:
        # A true latecomer is recent and carries the time that belongs to its number; anything else is another stream.
        expected_us = self._last_us - (behind - 1) * self._period_us
        tolerance_us = 2 * self._period_us + 0.01 * behind * self._period_us
        if behind > _LATE_WINDOW or abs(sample.device_us - expected_us) > tolerance_us:
            raise SequenceRestart(f"sample number went back from {(self._next - 1) % _WRAP} to {sample.seq}")
