"""One machine under measurement with hidden effects: exact kinematics, cups set with the spindle, a mirror that turns with the tool."""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import Bend, Hidden
from abbe.simulators.hidden.plans import Run, standing
from abbe.simulators.hidden.track import Track
from abbe.simulators.truth.machine import Machine, rotate

STREAM_NOISE = 45


class BentMachine:
    """The true machine; hidden effects add to the commanded positions and to the error motions of its carriages."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    def locate(self, q_mm: F, bend: Bend) -> tuple[F, F]:
        """Return the tool's position in workpiece coordinates, (n, 3) mm, and its rotation against the workpiece, (n, 3) rad."""
        geometry, axes = self.machine.geometry, q_mm + bend.drive
        point = np.broadcast_to(geometry.tool_mm, axes.shape)
        turned = np.zeros(axes.shape)
        for chain, tool_side in ((geometry.tool_side, True), (geometry.work_side, False)):
            for axis in reversed(chain):
                shift, angle = self._motions(axis, axes[:, axis])
                shift, angle = shift + bend.shift[axis], angle + bend.angle[axis]
                shift[:, axis] += axes[:, axis]
                pivot = geometry.pivots_mm[axis]
                arm = point - pivot if tool_side else point + shift - pivot
                point = pivot + rotate(angle, arm) + (shift if tool_side else 0.0)
                turned = turned + angle
        return point, turned

    def _motions(self, axis: int, position_mm: F) -> tuple[F, F]:
        return self.machine.motions(axis, position_mm)


class PerfectMachine(BentMachine):
    """The kinematics of `BentMachine` without error motions, to compute the trace of one effect quickly."""

    def _motions(self, axis: int, position_mm: F) -> tuple[F, F]:
        return np.zeros((len(position_mm), 3)), np.zeros((len(position_mm), 3))


@dataclass(frozen=True)
class Rig:
    """A machine and the effects that act on it, including set-up terms."""

    machine: BentMachine
    effects: tuple[Hidden, ...]

    def bend(self, track: Track) -> Bend:
        """Return the sum of all effects on one run."""
        out = Bend.none(track.n)
        for e in self.effects:
            out = out.add(e.bend(track))
        return out

    def reading(self, run: Run) -> F:
        """Return the noise-free readings of a run, (n,) mm."""
        return self.bar(run) if run.track.kind == "bar" else self.laser(run)

    def bar(self, run: Run) -> F:
        """Return the distance from the cup, which was set with the spindle, minus the nominal radius, plus errors of the bar, (n,) mm."""
        bend = self.bend(run.track)
        centre = np.array(run.setup["centre_mm"], dtype=np.float64)
        still = standing(run.track, centre)
        cup = self.machine.locate(centre[None], self.bend(still))[0][0]
        tool = self.machine.locate(run.track.q_mm, bend)[0]
        return np.asarray(np.linalg.norm(tool - cup, axis=1) - run.track.radius_mm + bend.reading)

    def laser(self, run: Run) -> F:
        """Return the change of the path to the point where the beam meets the mirror plane, minus the nominal change, (n,) mm.

        The mirror rotates with the tool, and is square to the beam if the tool is not rotated. A mirror that is aligned at the start of the
        run differs from this by the tool's rotation there; the difference is a mirror tilt.
        """
        track = run.track
        bend = self.bend(track)
        tool, turned = self.machine.locate(track.q_mm, bend)
        nominal = np.array(run.setup["nominal_beam"], dtype=np.float64)
        first, second = across(nominal)
        beam = nominal + bend.beam[0] * first + bend.beam[1] * second
        beam /= np.linalg.norm(beam)
        normal = np.tile(nominal + bend.tilt[0] * first + bend.tilt[1] * second, (track.n, 1))
        normal = rotate(turned, normal)
        path = np.einsum("ij,ij->i", tool - track.q_mm[0], normal) / (normal @ beam)
        return np.asarray(path - path[0] - track.reach_mm + bend.reading - bend.reading[0])


def across(direction: F) -> tuple[F, F]:
    """Return two unit vectors perpendicular to a unit vector and to each other, (3,) each."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = np.cross(direction, helper)
    first /= np.linalg.norm(first)
    return first, np.cross(direction, first)


@dataclass(frozen=True)
class Noise:
    """Noise of the instruments: standard deviation of one reading, and resolution (``*_step_mm``).

    ``coloured``: coloured share of the standard deviation; ``memory``: correlation of this share between successive readings.
    """

    bar_mm: float
    laser_mm: float
    coloured: float = 0.34
    memory: float = 0.72
    bar_step_mm: float = 1e-4
    laser_step_mm: float = 1e-5

    def put(self, exact_mm: F, run: Run, seed: int) -> F:
        """Return the readings of a run, (n,) mm: with noise, the laser zeroed at its first record, and rounded to the resolution."""
        rng = np.random.default_rng([STREAM_NOISE, seed, run.track.number])
        n, bar = len(exact_mm), run.track.kind == "bar"
        size, step = (self.bar_mm, self.bar_step_mm) if bar else (self.laser_mm, self.laser_step_mm)
        white = rng.normal(scale=np.sqrt(1.0 - self.coloured**2), size=n)
        if not bar:
            white -= white[0]  # the laser is zeroed at the first record, including its noise
        drive = rng.normal(scale=self.coloured * np.sqrt(1.0 - self.memory**2), size=n)
        state = float(rng.normal(scale=self.coloured))
        for i, kick in enumerate(drive.tolist()):
            state = self.memory * state + kick
            white[i] += state
        return np.asarray(np.round((exact_mm + size * white) / step) * step)
