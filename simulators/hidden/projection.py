"""The part of a hidden effect's trace that the present model cannot absorb, by finite differences of the simulated machine."""

from dataclasses import dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import Bend
from abbe.simulators.hidden.plans import Run
from abbe.simulators.hidden.rig import PerfectMachine, across

SPLINES = 12
STEP = 1e-6
TINY = 1e-11


@dataclass(frozen=True)
class Model:
    """The present model, in which the effect is missing: ``level`` rigid6 or rigid21, and the set-up terms that it fits."""

    level: str
    terms: frozenset[str]


def splines(position_mm: F, low_mm: float, high_mm: float, count: int = SPLINES) -> F:
    """Return the values of cubic B-splines on even knots over a stroke, (n, count)."""
    cells = count - 3
    at = np.clip((position_mm - low_mm) / (high_mm - low_mm) * cells, 0.0, cells - 1e-9)
    cell = at.astype(int)
    t = at - cell
    parts = ((1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3)
    out = np.zeros((len(at), count))
    for k, value in enumerate(parts):
        out[np.arange(len(at)), cell + k] = value / 6.0
    return out


def pushed(machine: PerfectMachine, q_mm: F, carriage: int, component: int) -> F:
    """Return the displacement of the tool per unit of an error motion (mm per mm, or mm per rad), (n, 3)."""
    bend = Bend.none(len(q_mm))
    target = bend.shift if component < 3 else bend.angle
    target[carriage, :, component % 3] = STEP
    return np.asarray((machine.locate(q_mm, bend)[0] - machine.locate(q_mm, Bend.none(len(q_mm)))[0]) / STEP)


def motion_columns(machine: PerfectMachine, run: Run, carriage: int, component: int, at: F, at_reference: F) -> F:
    """Return the readings of a run per unit of k functions of one error motion, (n, k).

    ``at`` (n, k): values of the functions on the run; ``at_reference`` (k,): values at the run's `reference_mm`.
    """
    track = run.track
    moved = np.einsum("ij,ij->i", track.look, pushed(machine, track.q_mm, carriage, component))
    if track.kind == "bar":
        centre = np.array(run.setup["centre_mm"], dtype=np.float64)[None]
        still = track.look @ pushed(machine, centre, carriage, component)[0]
        return np.asarray(moved[:, None] * at - still[:, None] * at_reference)
    out = moved[:, None] * at
    if component >= 3:  # the mirror turns with the tool
        lever = (track.q_mm - track.q_mm[0]) @ np.cross(np.eye(3)[component - 3], track.look[0])
        out = out + lever[:, None] * at
    return np.asarray(out - out[0])


def reference_mm(run: Run) -> F:
    """Return the position of the machine when the reading was zeroed, (3,) mm."""
    return np.array(run.setup["centre_mm"], dtype=np.float64) if run.track.kind == "bar" else run.track.q_mm[0]


def smooth_columns(machine: PerfectMachine, run: Run, level: str) -> F:
    """Return the readings of a run per unit of each coefficient of the error motions, mm per mm or mm per rad, shape (n, k).

    ``level``: rigid21 (six motions per axis, as splines) or rigid6 (scales and squareness).
    """
    track, reference = run.track, reference_mm(run)
    out = []
    for a in range(3):
        low, high = float(track.low_mm[a]), float(track.high_mm[a])
        span = high - low
        if level == "rigid21":
            at = splines(track.q_mm[:, a], low, high)
            start = splines(reference[a : a + 1], low, high)[0]
            out += [motion_columns(machine, run, a, c, at, start) for c in range(6)]
        else:
            line, start = (track.q_mm[:, a : a + 1] - low) / span, (reference[a : a + 1] - low) / span
            out += [motion_columns(machine, run, a, c, line, start) for c in ((0,), (0, 1), (0, 1, 2))[a]]
    return np.hstack(out)


def setup_columns(runs: list[Run], terms: frozenset[str]) -> F:
    """Return the readings of all runs per unit of each set-up term, mm per mm or mm per rad.

    Terms: a centre for each bar set-up, one bar length, a mirror tilt for each laser set-up, a zero for each laser run (always included).
    """
    rows = np.cumsum([0, *(r.track.n for r in runs)])
    pieces: dict[str, list[tuple[int, F]]] = {}
    for i, run in enumerate(runs):
        track = run.track
        if track.kind == "bar":
            if "setup_centre_offset" in terms:
                pieces.setdefault(f"centre {track.setup}", []).append((i, track.look))
            if "bar_length_error" in terms:
                pieces.setdefault("length", []).append((i, np.ones((track.n, 1))))
        else:
            pieces.setdefault(f"zero {run.run_id}", []).append((i, np.ones((track.n, 1))))
            if "mirror_tilt" in terms:
                pieces.setdefault(f"tilt {track.setup}", []).append((i, tilt_columns(run)))
    out = []
    for parts in pieces.values():
        block = np.zeros((rows[-1], parts[0][1].shape[1]))
        for i, values in parts:
            block[rows[i] : rows[i + 1]] = values
        out.append(block)
    return np.hstack(out) if out else np.zeros((rows[-1], 0))


def tilt_columns(run: Run) -> F:
    """Return the readings per rad of mirror tilt, mm, (n, 2)."""
    first, second = across(run.track.look[0])
    return np.asarray((run.track.q_mm - run.track.q_mm[0]) @ np.stack([first, second], axis=1))


@dataclass(frozen=True)
class Projector:
    """Columns of the present model over all fitted runs, divided by the noise and normalised; inverse of their normal matrix; 1 / noise."""

    columns: F
    inverse: F
    weight: F

    def left(self, signal_mm: F) -> F:
        """Return the part of signals (n, k) mm that the model cannot absorb, in standard deviations of one reading."""
        white = signal_mm * self.weight[:, None]
        out = white - self.columns @ (self.inverse @ (self.columns.T @ white))
        return np.asarray(out - self.columns @ (self.inverse @ (self.columns.T @ out)))


def projector(machine: PerfectMachine, runs: list[Run], model: Model, bar_mm: float, laser_mm: float) -> Projector:
    """Return the projector of the present model on the runs to which it may be fitted."""
    smooth = np.vstack([smooth_columns(machine, r, model.level) for r in runs])
    columns = np.hstack([smooth, setup_columns(runs, model.terms)])
    weight = np.concatenate([np.full(r.track.n, 1.0 / (bar_mm if r.track.kind == "bar" else laser_mm)) for r in runs])
    columns *= weight[:, None]
    size = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    columns /= np.where(size > 0.0, size, 1.0)
    values, vectors = np.linalg.eigh(columns.T @ columns)
    kept = values > TINY * values[-1]
    return Projector(columns, (vectors[:, kept] / values[kept]) @ vectors[:, kept].T, weight)
