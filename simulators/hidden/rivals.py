"""Rivals of a hidden effect: first-order textbook traces of every named effect, and those that are indistinguishable from it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden.effect import AXES
from abbe.simulators.hidden.plans import Run
from abbe.simulators.hidden.projection import Model, Projector, motion_columns, reference_mm, tilt_columns
from abbe.simulators.hidden.rig import PerfectMachine
from abbe.simulators.hidden.track import Track

INDISTINCT = 20.0
"""Chi-square deficit of a rival's best trace below which it is indistinguishable from the effect."""
COMPONENTS = "XYZABC"
DRIFT_S = (1500.0, 3000.0, 6000.0)
Function = Callable[[Track], F]
"""Returns the value of some quantity at every reading of a run, (n,)."""


@dataclass(frozen=True)
class FittedRuns:
    """The runs to fit, a perfect machine, and the present model."""

    machine: PerfectMachine
    runs: list[Run]
    model: Model

    def stack(self, of_run: Callable[[Run], F]) -> F:
        """Stack the columns (n, k) of all runs, one run below the other."""
        return np.vstack([of_run(r) for r in self.runs])

    def moved(self, direction: int, *functions: Function) -> F:
        """Return one column of readings for each function: it displaces the tool along one axis, and is zero while the cup is set up."""
        return self.stack(lambda r: _zeroed(r, r.track.look[:, direction, None] * np.stack([f(r.track) for f in functions], axis=1)))

    def warming(self, direction: int, arm: Callable[[F], F], taus: tuple[float, ...] = DRIFT_S) -> Iterator[F]:
        """Yield, for each tau (s), the readings of a displacement along one axis: ``arm(position (n, 3))`` times 1 - exp(-t / tau)."""
        for tau in taus:
            yield self.stack(lambda r, tau=tau: _warm(r, direction, arm, tau))  # type: ignore[misc]

    def of_instruments(self, bar: Function | None, laser: Function | None) -> F:
        """Return the readings of an effect of the instruments themselves; None: the effect leaves this instrument alone."""
        return self.stack(lambda r: _instrument(r, bar if r.track.kind == "bar" else laser))

    def motion(self, carriage: int, component: int) -> F:
        """Return the readings of a smooth error motion: one column for each Legendre polynomial 2 to 5 of the position."""
        return self.stack(lambda r: self._motion(r, carriage, component))

    def _motion(self, run: Run, carriage: int, component: int) -> F:
        track = run.track
        low, high = float(track.low_mm[carriage]), float(track.high_mm[carriage])
        at, start = (_legendre((2.0 * x - low - high) / (high - low)) for x in (track.q_mm[:, carriage], reference_mm(run)[carriage, None]))
        return motion_columns(self.machine, run, carriage, component, at, start[0])


def _legendre(place: F) -> F:
    x = place
    return np.stack([1.5 * x**2 - 0.5, 2.5 * x**3 - 1.5 * x, (35 * x**4 - 30 * x**2 + 3) / 8, (63 * x**5 - 70 * x**3 + 15 * x) / 8], axis=1)


def _zeroed(run: Run, columns: F) -> F:
    return columns if run.track.kind == "bar" else np.asarray(columns - columns[0])


def _warm(run: Run, direction: int, arm: Callable[[F], F], tau_s: float) -> F:
    track = run.track
    moved = arm(track.q_mm) * -np.expm1(-track.t_s / tau_s)
    if track.kind == "laser":
        return np.asarray((track.look[:, direction] * (moved - moved[0]))[:, None])
    still = float(arm(reference_mm(run)[None])[0]) * -np.expm1(-track.set_s / tau_s)
    return np.asarray((track.look[:, direction] * (moved - still))[:, None])


def _instrument(run: Run, of: Function | None) -> F:
    values = np.zeros(run.track.n) if of is None else of(run.track)
    return _zeroed(run, values[:, None])


def _fraction(track: Track, axis: int) -> F:
    return np.asarray((track.q_mm[:, axis] - track.low_mm[axis]) / (track.high_mm[axis] - track.low_mm[axis]))


def traces(fitted: FittedRuns) -> Iterator[tuple[str, F]]:
    """Yield label and columns of the traces of all predictable effects that the present model lacks; traces may share a label."""
    low, high = fitted.runs[0].track.low_mm, fitted.runs[0].track.high_mm
    for a, axis in enumerate(AXES):
        yield from _drive(fitted, a, axis)
        for fixed in (float(low[a]), float(high[a])):
            for columns in fitted.warming(a, _from(a, fixed)):
                yield f"axis_thermal_growth:{axis}", columns
        for columns in fitted.warming(a, lambda q: np.ones(len(q))):
            yield f"spindle_thermal_drift:{axis}", columns
        yield from _slides(fitted, a, axis)
    for plane, (carriage, d) in {"XY": (1, 0), "ZX": (2, 0), "YZ": (2, 1)}.items():
        for columns in fitted.warming(d, _from(carriage, 0.0)):
            yield f"squareness_thermal:{plane}", columns
    yield from _instruments(fitted)
    if fitted.model.level == "rigid6":
        yield from _motions(fitted)


def _from(axis: int, fixed_mm: float) -> Callable[[F], F]:
    return lambda q: np.asarray(q[:, axis] - fixed_mm)


def _slides(fitted: FittedRuns, a: int, axis: str) -> Iterator[tuple[str, F]]:
    for d in (d for d in range(3) if d != a):
        yield f"lateral_play:E{AXES[d]}{axis}", fitted.moved(d, lambda t: 0.5 * t.sign[:, a])
        yield f"nonrigid_bed:E{AXES[d]}{axis}", np.vstack([_bed(fitted, r, a, d) for r in fitted.runs])


def _motions(fitted: FittedRuns) -> Iterator[tuple[str, F]]:
    for a, axis in enumerate(AXES):
        for c in range(6):
            name = "angular_error" if c >= 3 else "positioning_nonlinear" if c == a else "straightness"
            key = axis if c == a else f"E{COMPONENTS[c]}{axis}"
            yield f"{name}:{key}", fitted.motion(a, c)


def _drive(fitted: FittedRuns, a: int, axis: str) -> Iterator[tuple[str, F]]:
    yield f"backlash:{axis}", fitted.moved(a, lambda t: -0.5 * t.sign[:, a])
    for k in (-0.75, 0.75):
        yield f"backlash_position_dependent:{axis}", fitted.moved(a, partial(_uneven, a, k))
    for d0 in (0.25, 0.5, 0.9):
        yield f"reversal_spike:{axis}", fitted.moved(a, partial(_spike, a, d0))
    for lead in (5.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0):
        yield f"cyclic_error:{axis}", fitted.moved(a, *(partial(_wave, a, lead, part) for part in (0.0, 0.25)))
    yield f"servo_mismatch:{axis}", fitted.moved(a, lambda t: -t.v_mm_s[:, a])


def _uneven(a: int, k: float, track: Track) -> F:
    return np.asarray(-0.5 * track.sign[:, a] * (1.0 + k * (2.0 * _fraction(track, a) - 1.0)))


def _spike(a: int, d0_mm: float, track: Track) -> F:
    if track.course is None:
        return track.zeros()
    x = np.minimum(track.since_mm[:, a] / d0_mm, 50.0)
    return np.asarray(track.sign[:, a] * (track.feed_mm_min / 1000.0) ** 0.5 * np.expm1(-10.0 * x) * np.exp(-(x**1.2)))


def _wave(a: int, lead_mm: float, part: float, track: Track) -> F:
    return np.asarray(np.sin(2.0 * np.pi * (track.q_mm[:, a] / lead_mm + part)))


def _bed(fitted: FittedRuns, run: Run, a: int, d: int) -> F:
    other = 3 - a - d
    low, high = run.track.low_mm, run.track.high_mm

    def at(q: F) -> F:
        part = (q - low) / (high - low)
        return np.asarray((np.sin(np.pi * part[:, a]) * (2.0 * part[:, other] - 1.0))[:, None])

    return motion_columns(fitted.machine, run, a, d, at(run.track.q_mm), at(reference_mm(run)[None])[0])


def _instruments(fitted: FittedRuns) -> Iterator[tuple[str, F]]:
    yield "contour_lag", fitted.stack(_lag)
    for tau in (500.0, 1000.0):
        yield "bar_thermal", fitted.of_instruments(lambda t, tau=tau: t.radius_mm * np.exp(-(t.t_s - t.set_s) / tau), None)  # type: ignore[misc]
    yield "laser_cosine", fitted.of_instruments(None, lambda t: t.reach_mm)
    for period in (5000.0, 8000.0, 12000.0):
        waves = [lambda t, f=f, p=period: f(2.0 * np.pi * t.t_s / p) * t.reach_mm for f in (np.sin, np.cos)]
        yield "air_refraction", np.hstack([fitted.of_instruments(None, w) for w in waves])
    yield "dead_path", fitted.of_instruments(None, lambda t: t.t_s - t.t_s[0])
    for beta in (0.6, 0.9):
        yield "ram_sag", fitted.stack(lambda r, beta=beta: _ram(fitted, r, beta))  # type: ignore[misc]
    if "bar_length_error" not in fitted.model.terms:
        yield "bar_length_error", fitted.of_instruments(lambda t: np.ones(t.n), None)
    for name, kind in (("setup_centre_offset", "bar"), ("mirror_tilt", "laser")):
        if name not in fitted.model.terms:
            yield name, _per_setup(fitted, kind)


def _lag(run: Run) -> F:
    t = run.track
    if t.course is None:
        return np.zeros((t.n, 1))
    inward = np.einsum("ij,ij->i", t.look, t.a_mm_s2) + 0.5 * np.einsum("ij,ij->i", t.v_mm_s, t.v_mm_s) / t.radius_mm
    return np.asarray(inward[:, None])


def _ram(fitted: FittedRuns, run: Run, beta: float) -> F:
    track = run.track
    down = 1 if track.vertical == 2 else track.vertical
    span = float(track.high_mm[2] - track.low_mm[2])

    def sink(q: F) -> F:
        high = 2.0 * (q[:, down] - track.low_mm[down]) / (track.high_mm[down] - track.low_mm[down]) - 1.0
        z = (q[:, 2] - track.low_mm[2]) / span
        return np.stack([-z * z * (1.0 + beta * high), 2.0 * z / span * (1.0 + beta * high)], axis=1)

    at, still = sink(track.q_mm), sink(reference_mm(run)[None])[0]
    both = [motion_columns(fitted.machine, run, 2, c, at[:, k : k + 1], still[k : k + 1]) for k, c in ((0, down), (1, 3))]
    return both[0] + both[1]


def _per_setup(fitted: FittedRuns, kind: str) -> F:
    setups = sorted({r.track.setup for r in fitted.runs if r.track.kind == kind})

    def block(run: Run) -> F:
        own = run.track.look if kind == "bar" else tilt_columns(run)
        out = np.zeros((run.track.n, own.shape[1] * len(setups)))
        if run.track.kind == kind:
            k = setups.index(run.track.setup) * own.shape[1]
            out[:, k : k + own.shape[1]] = own
        return out

    return fitted.stack(block)


def indistinct(fitted: FittedRuns, projector: Projector, left: F, own: str) -> list[str]:
    """Return the labels of rivals that explain an effect's remainder ``left`` (n,) so well that its chi-square falls below `INDISTINCT`."""
    labels, blocks = zip(*traces(fitted), strict=True)
    raw = np.hstack(blocks) * projector.weight[:, None]
    kept = projector.columns.T @ raw
    products = raw.T @ raw - kept.T @ (projector.inverse @ kept)
    with_effect = raw.T @ left  # ``left`` is already orthogonal to the present model
    size = np.einsum("ij,ij->j", raw, raw)
    edges = np.cumsum([0, *(b.shape[1] for b in blocks)])
    out: list[str] = []
    total = float(left @ left)
    for label, first, last in zip(labels, edges[:-1], edges[1:], strict=True):
        here = slice(first, last)
        if label == own or label in out or not np.any(products.diagonal()[here] > 1e-9 * np.maximum(size[here], 1e-30)):
            continue
        explained = float(with_effect[here] @ np.linalg.pinv(products[here, here], rcond=1e-9) @ with_effect[here])
        if total - explained < INDISTINCT:
            out.append(label)
    return out
