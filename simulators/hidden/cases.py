"""One sealed case: effects sized by their visibility, runs with readings, and the truth by which an answer is judged.

The trace of an effect is its part of the readings. Rivals of a hidden effect are named effects that the readings cannot distinguish from
it; they are found from the textbook traces of all named effects, to first order.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden import drive, instrument, outside, structure, thermal
from abbe.simulators.hidden.draws import CATALOGUE, GEOMETRY, OUTSIDE, RANDOM, TERMS, Setting, draw_hidden, draw_setting
from abbe.simulators.hidden.effect import AXES, Hidden
from abbe.simulators.hidden.plans import Run, runs_of
from abbe.simulators.hidden.projection import Model, Projector, motion_columns, projector, reference_mm, tilt_columns
from abbe.simulators.hidden.rig import BentMachine, PerfectMachine, Rig
from abbe.simulators.hidden.track import Track

INDISTINCT = 20.0
"""A rival cannot be distinguished from the effect if its best trace leaves a chi-square below this."""
COMPONENTS = "XYZABC"
DRIFT_S = (1500.0, 3000.0, 6000.0)
Function = Callable[[Track], F]
"""Returns a quantity at every reading of a run, (n,)."""


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
        """Return the readings, mm, of displacements along an axis, one column per function; a function must be 0 where a cup is set up."""
        return self.stack(lambda r: _zeroed(r, r.track.look[:, direction, None] * np.stack([f(r.track) for f in functions], axis=1)))

    def warming(self, direction: int, arm: Callable[[F], F], taus: tuple[float, ...] = DRIFT_S) -> Iterator[F]:
        """Yield the readings of a displacement along an axis that grows as 1 - exp(-t / tau), for each time constant tau (s).

        ``arm``: final displacement at positions, shape (n, 3).
        """
        for tau in taus:
            yield self.stack(lambda r, tau=tau: _warm(r, direction, arm, tau))  # type: ignore[misc]

    def of_instruments(self, bar: Function | None, laser: Function | None) -> F:
        """Return the readings of an effect of the instruments themselves; None: this instrument is not affected."""
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
    """Return the labels of rivals that reduce the rest ``left`` (n,) of an effect to a chi-square below `INDISTINCT`."""
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


ALL_EFFECTS = (drive, instrument, outside, structure, thermal)
"""Modules that are imported so that their effects are registered."""
SNR_LOCAL = (0.6, 8.0)
TOUCHED = 0.1
"""A reading is touched if the part of the effect that the model cannot absorb, divided by the noise, exceeds this fraction of its
maximum."""
ADDED = {
    "one_way": ["opposite_direction"], "one_feed": ["second_feed"], "one_radius": ["second_radius"], "ballbar": ["laser_diagonals"],
    "laser": ["ballbar"], "minimal": ["opposite_direction", "second_feed", "second_radius", "planar_circles", "laser_diagonals"],
}  # fmt: skip
BEYOND = ["second_tool_length", "single_axis_laser", "angular_interferometer", "longer_session", "reference_length"]


@dataclass(frozen=True)
class Visibility:
    """Visibility of an effect: rms in µm; ``snr_*`` and ``left`` (n,) in standard deviations of one reading.

    All but ``raw_rms_um`` count only the part that the present model cannot absorb. ``share_touched``: share of readings that this part
    touches.
    """

    raw_rms_um: float
    separable_rms_um: float
    snr_local: float
    snr_total: float
    share_touched: float
    left: F


@dataclass(frozen=True)
class Case:
    """A finished case: noise-free readings with and without the hidden effects, and the facts about each effect."""

    name: str
    setting: Setting
    runs: list[Run]
    effects: tuple[Hidden, ...]
    clean_mm: dict[str, F]
    without_mm: dict[str, F]
    facts: list[dict[str, object]]
    gap_um: float


def make_case(name: str, seed: int, kind: str, *, wild: bool = True) -> Case:
    """Draw a case of a kind: single, double, null or unknown. Equal arguments give equal cases; ``wild``: see `Hidden.wild`."""
    rng = np.random.default_rng([51, seed])
    for attempt in range(50):
        names = _names(rng, kind)
        setting = draw_setting(seed * 64 + attempt, kind, frozenset(names) & frozenset(TERMS))
        if setting.model.level == "rigid21" and GEOMETRY & set(names):
            continue
        if "ram_sag" in names and setting.document["vertical_axis"] != "Y":  # a ram that hangs straight down does not sag
            continue
        runs = runs_of(setting.plan, setting.machinery)
        case = _filled(name, setting, runs, names, rng, wild)
        if case is not None:
            return case
    raise RuntimeError(f"seed {seed}: no effect of this kind leaves a trace")


def _names(rng: np.random.Generator, kind: str) -> list[str]:
    pool = list(OUTSIDE if kind == "unknown" else CATALOGUE)
    return [str(n) for n in rng.choice(pool, {"single": 1, "double": 2, "null": 0, "unknown": 1}[kind], replace=False)]


def _filled(name: str, setting: Setting, runs: list[Run], names: list[str], rng: np.random.Generator, wild: bool) -> Case | None:
    """Return the case with effects of these names; None if one of them leaves no trace in the runs."""
    perfect = PerfectMachine(setting.machine)
    fitted = [r for r in runs if r.role == "identify"]
    model_space = projector(perfect, fitted, setting.model, setting.noise.bar_mm, setting.noise.laser_mm) if names else None
    effects, facts = [], []
    for effect_name in names:
        assert model_space is not None
        span = (float(runs[0].track.t_s[0]), float(runs[-1].track.t_s[-1]))
        hidden = _located(rng, draw_hidden(rng, effect_name, setting, span, wild), fitted)
        sized = _sized(hidden, float(np.exp(rng.uniform(*np.log(SNR_LOCAL)))), perfect, fitted, model_space)
        if sized is None:
            return None
        hidden, seen = sized
        effects.append(hidden)
        facts.append(_fact(hidden, seen, setting, perfect, fitted, model_space))
    true, with_setup = BentMachine(setting.machine), setting.setup
    without = {r.run_id: Rig(true, with_setup).reading(r) for r in runs}
    clean = {r.run_id: Rig(true, (*with_setup, *effects)).reading(r) for r in runs} if effects else without
    moved = np.concatenate([clean[r.run_id] - without[r.run_id] for r in fitted])
    return Case(name, setting, runs, tuple(effects), clean, without, facts, 1e3 * float(np.sqrt(np.mean(moved**2))))


def _located(rng: np.random.Generator, e: Hidden, runs: list[Run]) -> Hidden:
    """Return the effect with its place or time, if any, moved into one of the runs, so that the runs can show the effect."""
    run = runs[int(rng.integers(len(runs)))]
    at = int(rng.integers(run.track.n // 10, run.track.n - run.track.n // 10))
    if e.name == "local_bump":
        place = dict(zip(("cx", "cy", "cz"), (float(v) for v in run.track.q_mm[at]), strict=True))
        return replace(e, parameters={**e.parameters, **place})
    if "t0_s" in e.parameters:
        bars = [r for r in runs if r.track.kind == "bar"]
        if e.name == "interference_burst" and bars:
            run = bars[int(rng.integers(len(bars)))]
        return replace(e, parameters={**e.parameters, "t0_s": float(run.track.t_s[min(at, run.track.n - 10)])})
    return e


def _sized(
    e: Hidden, wanted: float, perfect: PerfectMachine, runs: list[Run], model_projector: Projector
) -> tuple[Hidden, Visibility] | None:
    """Scale an effect to the wanted ``snr_local`` within its physical limits; return effect and visibility, None if there is no trace."""
    low, high = (CATALOGUE | OUTSIDE)[e.name][3]
    seen = visibility(e, perfect, runs, model_projector)
    if seen.raw_rms_um < 1e-6:
        return None
    power = 0.5 if e.name == "contour_lag" else 1.0
    factor = (wanted / max(seen.snr_local, 1e-9)) ** power
    size = float(np.clip(abs(e["strength"]) * factor, low, high))
    sized = e.scaled(float(np.copysign(size, e["strength"])))
    return sized, visibility(sized, perfect, runs, model_projector)


def visibility(e: Hidden, perfect: PerfectMachine, runs: list[Run], model_projector: Projector) -> Visibility:
    """Return the visibility of an effect in runs to which the present model is fitted.

    Both ratios concern the part that the model cannot absorb: ``snr_total`` is its norm, ``snr_local`` its rms where it is noticeable,
    divided by the noise.
    """
    without, with_it = Rig(perfect, ()), Rig(perfect, (e,))
    trace = np.concatenate([with_it.reading(r) - without.reading(r) for r in runs])
    left = model_projector.left(trace[:, None])[:, 0]
    touched = np.abs(left) > TOUCHED * np.max(np.abs(left), initial=0.0)
    local = float(np.sqrt(np.mean(left[touched] ** 2))) if touched.any() else 0.0
    separable = 1e3 * float(np.sqrt(np.mean((left / model_projector.weight) ** 2)))
    raw = 1e3 * float(np.sqrt(np.mean(trace**2)))
    return Visibility(raw, separable, local, float(np.linalg.norm(left)), float(np.mean(touched)), left)


def _fact(
    e: Hidden, seen: Visibility, setting: Setting, perfect: PerfectMachine, runs: list[Run], model_projector: Projector
) -> dict[str, object]:
    """Return the entry of the sealed file for one effect."""
    fitted = FittedRuns(perfect, runs, setting.model)
    known = e.name in CATALOGUE
    alike = [] if e.name in RANDOM else indistinct(fitted, model_projector, seen.left, e.label)
    parameters: dict[str, object] = {**e.parameters, "wild": e.wild}
    return {
        "predictable": e.name not in RANDOM, "separated_by": _separated(e, setting, perfect, alike) if known else {}, "label": e.label,
        "name": e.name, "key": e.key or None, "unit": (CATALOGUE | OUTSIDE)[e.name][1], "in_catalogue": known, "parameters": parameters,
        "raw_rms_um": seen.raw_rms_um, "separable_rms_um": seen.separable_rms_um, "snr_local": seen.snr_local, "snr_total": seen.snr_total,
        "share_touched": seen.share_touched, "where": where(e, setting), "aliases": alike if known else [],
        "explained_by_catalogue": [] if known else alike,
    }  # fmt: skip


def _separated(e: Hidden, setting: Setting, perfect: PerfectMachine, aliases: list[str]) -> dict[str, list[str]]:
    """Return the measurements that would separate each alias from the effect: those of plan ``full`` if they suffice, else `BEYOND`."""
    if not aliases:
        return {}
    still: list[str] = aliases
    if setting.plan in ADDED:
        runs = [r for r in runs_of("full", setting.machinery) if r.role == "identify"]
        model_projector = projector(perfect, runs, setting.model, setting.noise.bar_mm, setting.noise.laser_mm)
        seen = visibility(e, perfect, runs, model_projector)
        still = indistinct(FittedRuns(perfect, runs, setting.model), model_projector, seen.left, e.label)
    return {alias: list(BEYOND if alias in still else ADDED[setting.plan]) for alias in aliases}


def where(e: Hidden, setting: Setting) -> dict[str, object]:
    """Return the axis, time or place to which an effect outside the catalogue is confined; empty for other effects."""
    p = e.parameters
    if e.name in ("clamp_slip", "encoder_count_loss"):
        axis: dict[str, object] = {"axis": e.key} if e.key else {}
        return {**axis, "time_s": [p["t0_s"] - 60.0, p["t0_s"] + 60.0]}
    if e.name == "interference_burst":
        return {"tests": ["ballbar"], "time_s": [p["t0_s"] - 2.0 * p["width_s"], p["t0_s"] + 2.0 * p["width_s"]]}
    if e.name == "local_bump":
        return {"position_mm": [p["cx"], p["cy"], p["cz"]], "radius_mm": 2.0 * p["w_mm"]}
    if e.name == "ball_form":
        return {"tests": ["ballbar"], "angular_lobes": int(p["lobes"])}
    return {"axis": "vertical", "period_s": p["period_s"]} if e.name == "counterbalance_surge" else {}
