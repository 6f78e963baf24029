"""A ball-bar's box on a bad line. Tests advance the box's own time, so that they need not wait."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from abbe.simulators.ballbar.device import NO_BAR, OUT_OF_RANGE
from abbe.simulators.ballbar.port import BAUD, Received
from abbe.simulators.ballbar.wire import SERIAL_NO, START, WITH_SETTINGS_BCD, BallbarWire, Parser
from abbe.simulators.faults.serial_bytes import Sample, cut, sample_of
from abbe.simulators.faults.serial_line import FaultyLine, Uart
from abbe.simulators.scenario import DEFAULT_PATH, load
from abbe.simulators.world import World

RADIUS_MM = 100.0
_PIECE = 200


@dataclass(frozen=True, slots=True)
class Window:
    """Makes samples ``begin`` to ``end - 1`` of a stream invalid: the box sets status ``bits`` and sends a false reading."""

    begin: int
    end: int
    bits: int = OUT_OF_RANGE

    def applied(self, sample: Sample) -> Sample:
        """Return the sample, made invalid if its number lies in the window."""
        if not self.begin <= sample.seq < self.end:
            return sample
        return replace(sample, status=sample.status | self.bits, reading_nm=0 if self.bits & NO_BAR else 1_000_000)


class _Tapped:
    """The line as the box sees it: records the box's samples, with clock errors and windows applied, before the line spoils them."""

    def __init__(self, box: "FaultyBox", line: FaultyLine) -> None:
        self._box, self._line = box, line

    @property
    def url(self) -> str:
        return self._line.url

    def room(self) -> int:
        return self._line.room()

    def send(self, data: bytes) -> None:
        self._line.send(b"".join(self._box.record(frame) for frame in cut(data)))

    def pump(self) -> None:
        self._line.pump()

    async def open(self, received: Received) -> None:
        await self._line.open(received)

    async def close(self) -> None:
        await self._line.close()


class FaultyBox:
    """A ball-bar's box on a `FaultyLine`.

    Parameters
    ----------
    link : Path
        Stable path at which the host finds the line.
    serial_no, firmware, boot_id : int
        Identity of the box.
    uart : Uart
        Baud rate and parity of the box.
    """

    def __init__(
        self,
        link: Path,
        *,
        serial_no: int = SERIAL_NO,
        firmware: int = WITH_SETTINGS_BCD,
        boot_id: int = 0xCAFE0001,
        uart: Uart | None = None,
    ) -> None:
        self.world = World(load(DEFAULT_PATH))
        self.world.ballbar.mount(RADIUS_MM, self.world.tool_position() + np.array([RADIUS_MM, 0.0, 0.0]), 0.0)
        self.line = FaultyLine(link, uart or Uart(BAUD))
        self.boot_id, self.serial_no = boot_id, serial_no
        self.sent: dict[tuple[int, int], list[Sample]] = {}
        """Every sample that the box sent, by boot id and number of the stream since boot."""
        self.commands: list[int] = []
        self.windows: list[Window] = []
        self.rate_factor = 1.0
        self.ppm = 0.0
        """Rate error of the box's clock, ppm; positive: too fast."""
        self.on_start: Callable[[], None] = lambda: None
        self.before: Callable[[int], bool] = lambda kind: False
        """Called with the type of every command; if it returns True, the box does not get the command."""
        self._streams = 0
        self._late_us = self._taken = 0
        self._first_s = 0.0
        self._parser = Parser()
        self._wire = BallbarWire(
            self.world.ballbar, _Tapped(self, self.line), boot_id, lambda: self.world.time_s, serial_no=serial_no, firmware=firmware
        )

    @property
    def url(self) -> str:
        """URL at which a host reaches the box."""
        return self.line.url

    async def plug(self) -> None:
        """Put the cable in."""
        await self.line.open(self._received)

    async def unplug(self) -> None:
        """Pull the cable; the box has a battery and keeps running."""
        await self.line.close()

    async def run(self, samples: int) -> None:
        """Let the box take samples as fast as the line accepts them; a box that does not stream only advances its time."""
        left = samples
        while left > 0:
            piece, left = min(left, _PIECE), left - _PIECE
            self.advance(piece)
            while self.line.plugged and self.line.room() < _PIECE * 24:  # noqa: ASYNC110 - the terminal does not tell
                await asyncio.sleep(0.001)
            await asyncio.sleep(0)

    def advance(self, samples: int) -> None:
        """Advance the time by ``samples`` periods and send the samples."""
        rate_hz = self.world.ballbar.rate_hz
        self._taken += samples
        # to the middle between two samples, so that rounding cannot add or lose one
        until_s = self._first_s + (self._taken - 0.5) / rate_hz if rate_hz else self.world.time_s + samples * 1e-3
        self.world.advance(until_s)
        self._wire.flush()

    def _begun(self) -> None:
        self._streams += 1
        self._taken = 0
        self._first_s = self.world.time_s + 1.0 / self.world.ballbar.rate_hz
        if self.rate_factor != 1.0:
            self.world.ballbar.rate_hz = round(self.world.ballbar.rate_hz * self.rate_factor)

    def pause(self, seconds: float) -> None:
        """Let the box's clock jump ahead, as if the box had paused between two samples."""
        self._late_us += round(seconds * 1e6)

    def reboot(self) -> None:
        """Restart the box as after a loss of power: new boot id, no stream, factory settings."""
        self.boot_id += 1
        self._streams = self._late_us = 0
        self._wire.restart(self.boot_id)

    def begin_anew(self, rate_hz: int = 1000) -> None:
        """Start a stream on the box itself, as another program would."""
        self.world.ballbar.start(rate_hz, self.world.time_s)
        self._begun()

    def record(self, frame: bytes) -> bytes:
        """Return a frame of the box, with clock errors and windows applied if it is a sample, and record the sample."""
        sample = sample_of(frame)
        if sample is None:
            return frame
        sample = replace(sample, device_us=round(sample.device_us * (1.0 + self.ppm * 1e-6)) + self._late_us)
        for window in self.windows:
            sample = window.applied(sample)
        self.sent.setdefault((self.boot_id, self._streams), []).append(sample)
        return sample.frame()

    def _received(self, data: bytes) -> None:
        kinds = [kind for kind, _ in self._parser.feed(data)]
        if any(self.before(kind) for kind in kinds):
            return
        self._wire.received(data)
        self.commands += kinds
        if START in kinds:
            self._begun()
            asyncio.get_running_loop().call_soon(self.on_start)

    @property
    def stream(self) -> tuple[int, int]:
        """Boot id, and number of the stream since boot."""
        return self.boot_id, self._streams

    @property
    def starts(self) -> int:
        """Number of streams that a host started."""
        return self.commands.count(START)
