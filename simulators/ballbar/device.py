"""The ball-bar as a state machine: mounting, streaming, samples. No bytes; lengths in mm, samples in nm and µs as sent by the box."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import I64, B, F
from abbe.simulators.scenario import Magnitudes
from abbe.simulators.truth.draws import STREAM_BAR_NOISE, STREAM_CUP, Draws, generator

RANGE_MM = 1.0
MAX_RATE_HZ = 1000
OUT_OF_RANGE, OVERRUN, SYNC, NO_BAR = 1, 4, 8, 16
MM_PER_INCH = 25.4

Locate = Callable[[F, F], F]
"""Maps times (n,) s and axis positions (n, 3) mm to actual tool positions (n, 3) mm."""


@dataclass(frozen=True, slots=True)
class Samples:
    """Successive samples as columns (n,): number since START, device time µs, reading nm, status bits."""

    seq: I64
    time_us: I64
    reading_nm: I64
    status: I64


@dataclass(frozen=True, slots=True)
class _Taken:
    """Samples before their readings are computed: axis positions and sync level at each instant."""

    seq: I64
    time_us: I64
    axes_mm: F
    sync: B


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of the box, which a person changes at its panel. ``number`` starts at 1 and counts the changes since power-on."""

    number: int = 1
    inch: bool = False
    range_mm: float = RANGE_MM
    zero_mm: float = 0.0


class BallbarDevice:
    """The ball-bar and its box, whose clock runs ``clock_offset_us`` ahead of the world's, because it was switched on earlier."""

    def __init__(self, draws: Draws, sizes: Magnitudes, locate: Locate, *, clock_offset_us: int = 0) -> None:
        self._draws, self._sizes, self._locate = draws, sizes, locate
        self.offset_us = clock_offset_us
        self.settings = Settings()
        self.tells_settings = False
        """Whether bits 8 to 15 of the status carry the number of the settings (firmware 1.1)."""
        self.rate_hz = 0
        self._start_us = 0
        self._next = 0
        self._cup_mm: F | None = None
        self._radius_mm = 0.0
        self._bar_in = False
        self._hung_in_s = 0.0
        self._mounts = 0
        self._pushed = False
        self.too_much: Callable[[F, float, float], F] | None = None
        """Hidden effect: maps times (n,) s, the time when the bar was mounted (s) and its length (mm) to errors of the readings (n,) mm."""
        self._noise = generator(draws.seed, STREAM_BAR_NOISE)
        self._taken: list[_Taken] = []
        self._ready: list[Samples] = []

    # ---- people --------------------------------------------------------------------------------------------------

    def mount(self, radius_mm: float, tool_mm: F, now_s: float) -> None:
        """Put the cup near the tool's actual position (3,) mm, with a small random offset, and mount the bar of length ``radius_mm``."""
        self.settle()
        rng = generator(self._draws.seed, STREAM_CUP, self._mounts)
        self._mounts += 1
        direction = rng.normal(size=3)
        offset_mm = rng.uniform(*self._sizes.cup_offset_um) * 1e-3
        self._cup_mm = tool_mm + direction / np.linalg.norm(direction) * offset_mm
        self._radius_mm, self._bar_in, self._hung_in_s = radius_mm, True, now_s

    def take_out(self) -> bool:
        """Take the bar out; the cup stays. Return False if there is no cup."""
        self.settle()
        self._bar_in = False
        return self._cup_mm is not None

    def change(self, radius_mm: float, now_s: float) -> bool:
        """Mount a bar of another nominal length, warm from the hand; the cup stays. Return False if there is no cup."""
        self.settle()
        if self._cup_mm is None:
            return False
        self._radius_mm, self._bar_in, self._hung_in_s = radius_mm, True, now_s
        return True

    def unmount(self) -> None:
        """Take bar and cup away."""
        self.settle()
        self._cup_mm, self._bar_in = None, False

    def switch(self, *, inch: bool | None = None, range_mm: float | None = None, zero_mm: float | None = None) -> None:
        """Change the given settings from the next sample on; the others stay."""
        self.settle()
        old = self.settings
        self.settings = Settings(
            old.number % 255 + 1,
            old.inch if inch is None else inch,
            old.range_mm if range_mm is None else range_mm,
            old.zero_mm if zero_mm is None else zero_mm,
        )

    def forget_settings(self) -> None:
        """Reset the settings to those of a box that was just switched on."""
        self.settle()
        self.settings = Settings()

    def push(self, *, out: bool) -> None:
        """Push the bar out of its range (``out``), or release it."""
        self.settle()
        self._pushed = out

    # ---- commands ------------------------------------------------------------------------------------------------

    def start(self, rate_hz: int, now_s: float) -> bool:
        """Start a stream, numbered from 0; the first sample comes one period from now. Return False for an impossible rate."""
        if not 0 < rate_hz <= MAX_RATE_HZ or MAX_RATE_HZ % rate_hz:
            return False
        self._taken.clear()
        self._ready.clear()
        self.rate_hz, self._next = rate_hz, 0
        self._start_us = int(now_s * 1e6) + self._period_us
        return True

    def stop(self) -> None:
        """Stop streaming; samples already taken stay."""
        self.rate_hz = 0

    @property
    def _period_us(self) -> int:
        return 1_000_000 // self.rate_hz

    # ---- time ----------------------------------------------------------------------------------------------------

    def due_s(self, until_s: float) -> F:
        """Return the instants (world time, s) of the samples to be taken up to ``until_s``."""
        if self.rate_hz == 0:
            return np.empty(0)
        count = (int(until_s * 1e6) - self._start_us) // self._period_us + 1 - self._next
        if count <= 0:
            return np.empty(0)
        ticks = np.arange(self._next, self._next + count, dtype=np.float64)
        return (self._start_us + self._period_us * ticks) * 1e-6

    def record(self, axes_mm: F, sync: B) -> None:
        """Take the next n samples: axis positions (n, 3) mm and sync levels (n,) at the instants that ``due_s`` returned."""
        seq = np.arange(self._next, self._next + len(axes_mm))
        self._taken.append(_Taken(seq, self._start_us + self._period_us * seq, axes_mm, sync))
        self._next += len(axes_mm)

    def take(self) -> Samples:
        """Return all samples taken since the last call."""
        self.settle()
        ready, self._ready = self._ready, []
        if len(ready) == 1:
            return ready[0]
        none = np.empty(0, dtype=np.int64)
        return Samples(*(np.concatenate([none, *(getattr(s, name) for s in ready)]) for name in Samples.__slots__))

    def settle(self) -> None:
        """Compute the readings of the samples taken so far; called before every change that affects readings."""
        if not self._taken:
            return
        parts, self._taken = self._taken, []
        seq, time_us = (np.concatenate([getattr(p, name) for p in parts]) for name in ("seq", "time_us"))
        axes_mm, sync = np.concatenate([p.axes_mm for p in parts]), np.concatenate([p.sync for p in parts])
        noise = self._noise.normal(size=len(seq)) * self._draws.bar_noise_mm
        status = np.where(sync, SYNC, 0)
        reading_mm = np.zeros(len(seq))
        setting = self.settings
        if self.tells_settings:
            status |= setting.number << 8
        if self._cup_mm is None or not self._bar_in:
            status |= NO_BAR
        else:
            times_s = time_us * 1e-6
            distance = np.linalg.norm(self._locate(times_s, axes_mm) - self._cup_mm, axis=1)
            free = distance - self._radius_mm + self._draws.bar_length_error_mm + noise
            if self.too_much is not None:
                free = free + self.too_much(times_s, self._hung_in_s, self._radius_mm)
            reading_mm[:] = np.clip(free - setting.zero_mm, -setting.range_mm, setting.range_mm)
            status |= np.where((np.abs(free - setting.zero_mm) > setting.range_mm) | self._pushed, OUT_OF_RANGE, 0)
        # in inches the box counts tenths of a microinch instead of nanometres
        reading_nm = np.rint(reading_mm * (1e7 / MM_PER_INCH if setting.inch else 1e6)).astype(np.int64)
        self._ready.append(Samples(seq, time_us + self.offset_us, reading_nm, status.astype(np.int64)))
