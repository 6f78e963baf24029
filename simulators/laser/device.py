"""The laser displacement meter as a state machine: mounting, zero, beam loss, output samples. No bytes; mm and laser seconds."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.scenario import Magnitudes
from abbe.simulators.truth.draws import STREAM_LASER_NOISE, STREAM_MIRROR, Draws, generator
from abbe.simulators.truth.machine import rotate
from abbe.simulators.truth.surroundings import Air, AirState

RATE_HZ = 20

Locate = Callable[[F, F], F]
"""Maps times (n,) s and axis positions (n, 3) mm to actual tool positions (n, 3) mm."""
Turned = Callable[[F], F]
"""Maps axis positions (n, 3) mm to rotations of the tool against the workpiece (n, 3) rad."""


class LaserResult(IntEnum):
    """Result of a command, as in the register CMD_RESULT."""

    OK = 0
    BAD_ARGUMENT = 1
    BLOCKED = 2


@dataclass(frozen=True, slots=True)
class Output:
    """One output sample; all fields belong to the same instant."""

    count: int
    time_s: float
    displacement_mm: float
    signal_permille: int
    status: int
    air: AirState


@dataclass(frozen=True, slots=True)
class Mount:
    """Laser and mirror as set up, in workpiece axes.

    ``beam``: true unit vector, away from the laser; ``normal``: normal of the mirror before the tool turns; ``zero_mm``: zero position.
    """

    beam: F
    normal: F
    zero_mm: F

    def displacement(self, position_mm: F, turned_rad: F) -> F:
        """Return the distance along the beam from the zero to the points where the true beam meets the mirror plane, (n,) mm.

        ``position_mm``, ``turned_rad`` (n, 3): place and rotation of the tool, with which the mirror turns.
        """
        normal = rotate(turned_rad, np.broadcast_to(self.normal, position_mm.shape))
        along: F = np.einsum("ij,ij->i", normal, position_mm - self.zero_mm) / (normal @ self.beam)
        return along


class LaserDevice:
    """Makes one output sample every 1/20 s of its own time; samples are computed when read."""

    def __init__(self, draws: Draws, sizes: Magnitudes, air: Air, locate: Locate, turned: Turned) -> None:
        self._draws, self._sizes, self._air, self._locate, self._turned = draws, sizes, air, locate, turned
        self._mount: Mount | None = None
        self._mounts = 0
        self._signal = 0
        self._blocked = False
        self._lost = True  # latched; no mirror at power-on
        self._zeroed = False
        self._compensating = False
        self._zero_s = 0.0
        self.too_much: Callable[[float, float, float], float] | None = None
        """Hidden effect: maps the instant (s), the time since the zero (s) and the path (mm) to the error of a reading (mm)."""
        self._pending: tuple[int, float, F] | None = None
        self._output = Output(0, 0.0, 0.0, 0, 0b10001, air.at(0.0))

    # ---- time ----------------------------------------------------------------------------------------------------

    @staticmethod
    def tick_before(time_s: float) -> int:
        """Return the number of the last output sample at or before an instant."""
        return int(np.floor(time_s * RATE_HZ + 1e-6))

    def record(self, count: int, time_s: float, axes_mm: F) -> None:
        """Note the axis positions (3,) mm at an output instant."""
        self._pending = (count, time_s, axes_mm)

    def output(self) -> Output:
        """Return the newest output sample."""
        if self._pending is not None:
            count, time_s, axes_mm = self._pending
            self._pending = None
            self._output = self._measure(count, time_s, axes_mm)
        return self._output

    def _measure(self, count: int, time_s: float, axes_mm: F) -> Output:
        air = self._air.at(time_s)
        output = replace(self._output, count=count, time_s=time_s, air=air, signal_permille=self._signal_now(), status=self._status())
        if self._mount is None or self._lost or not self._zeroed:
            return output
        position = self._locate(np.array([time_s]), axes_mm[None, :])
        # one generator per sample: a reading does not depend on which other samples were read
        noise = generator(self._draws.seed, STREAM_LASER_NOISE, count).normal() * self._draws.laser_noise_mm
        path = float(self._mount.displacement(position, self._turned(axes_mm[None, :]))[0])
        if not self._compensating:
            path *= 1.0 + air.refractivity
        if self.too_much is not None:
            path += self.too_much(time_s, time_s - self._zero_s, path)
        return replace(output, displacement_mm=path + noise)

    def _signal_now(self) -> int:
        return 0 if self._mount is None or self._blocked else self._signal

    def _status(self) -> int:
        bits = (self._lost, self._signal_now() < 200, self._zeroed, self._compensating, self._mount is None)
        return sum(1 << i for i, bit in enumerate(bits) if bit)

    # ---- people --------------------------------------------------------------------------------------------------

    def mount(self, beam: F, position_mm: F) -> None:
        """Set up laser and mirror at the tool position (3,), beam along ``beam``; clears the beam-lost latch unless the beam is blocked."""
        self.output()
        nominal = beam / np.linalg.norm(beam)
        rng = generator(self._draws.seed, STREAM_MIRROR, self._mounts)
        self._mounts += 1
        true_beam = nominal + _sideways(rng, nominal, self._sizes.beam_misalignment_urad)
        tilt = _sideways(rng, nominal, self._sizes.mirror_tilt_urad)
        self._mount = Mount(true_beam / np.linalg.norm(true_beam), nominal + tilt, position_mm.copy())
        self._signal = round(960.0 - 0.8e6 * float(np.linalg.norm(tilt)))
        self._lost, self._zeroed = self._blocked, False

    def unmount(self) -> None:
        """Take the mirror away."""
        self.output()
        self._mount, self._lost, self._zeroed = None, True, False

    def block(self, *, blocked: bool) -> None:
        """Block the beam, which loses counts at once, or free it."""
        self.output()
        self._blocked = blocked
        if blocked:
            self._lost, self._zeroed = True, False

    def weaken(self, permille: int) -> None:
        """Set a weaker signal, as from a dirty mirror; the laser still counts."""
        self.output()
        self._signal = permille

    # ---- commands ------------------------------------------------------------------------------------------------

    def zero(self, position_mm: F) -> LaserResult:
        """Make the present tool position (3,) mm the zero; refused while the beam is blocked or its loss is not cleared."""
        self.output()
        if self._mount is None or self._blocked or self._lost:
            return LaserResult.BLOCKED
        self._mount = replace(self._mount, zero_mm=position_mm.copy())
        self._zero_s = self._output.time_s
        self._zeroed = True
        return LaserResult.OK

    def clear(self) -> LaserResult:
        """Clear the beam-lost latch; the zero is gone with the lost counts."""
        self.output()
        if self._mount is None or self._blocked:
            return LaserResult.BLOCKED
        if self._lost:
            self._lost, self._zeroed = False, False
        return LaserResult.OK

    def compensate(self, argument: int) -> LaserResult:
        """Switch environmental compensation off (0) or on (1)."""
        self.output()
        if argument not in (0, 1):
            return LaserResult.BAD_ARGUMENT
        self._compensating = argument == 1
        return LaserResult.OK


def _sideways(rng: np.random.Generator, direction: F, size_urad: tuple[float, float]) -> F:
    """Return a small random vector perpendicular to a unit vector; its length is drawn uniformly within ``size_urad``."""
    across = rng.normal(size=3)
    across -= direction * (direction @ across)
    vector: F = across / np.linalg.norm(across) * rng.uniform(*size_urad) * 1e-6
    return vector
