"""One sealed case: effects sized by their visibility, runs with readings, and the truth by which an answer is judged."""

from dataclasses import dataclass, replace

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden import drive, instrument, outside, structure, thermal
from abbe.simulators.hidden.draws import CATALOGUE, GEOMETRY, OUTSIDE, RANDOM, TERMS, Setting, draw_hidden, draw_setting
from abbe.simulators.hidden.effect import Hidden
from abbe.simulators.hidden.plans import Run, runs_of
from abbe.simulators.hidden.projection import Projector, projector
from abbe.simulators.hidden.rig import BentMachine, PerfectMachine, Rig
from abbe.simulators.hidden.rivals import FittedRuns, indistinct

ALL_EFFECTS = (drive, instrument, outside, structure, thermal)
"""Imported so that their effects are registered."""
SNR_LOCAL = (0.6, 8.0)
TOUCHED = 0.1
"""A reading is touched if what the model cannot absorb of the effect, over the noise, exceeds this fraction of its maximum."""
ADDED = {
    "one_way": ["opposite_direction"], "one_feed": ["second_feed"], "one_radius": ["second_radius"], "ballbar": ["laser_diagonals"],
    "laser": ["ballbar"], "minimal": ["opposite_direction", "second_feed", "second_radius", "planar_circles", "laser_diagonals"],
}  # fmt: skip
BEYOND = ["second_tool_length", "single_axis_laser", "angular_interferometer", "longer_session", "reference_length"]


@dataclass(frozen=True)
class Visibility:
    """How visible an effect is: rms in µm; ``snr_*`` and ``left`` (n,) in standard deviations of one reading.

    All but ``raw_rms_um`` count only the part that the present model cannot absorb. ``share_touched``: share of readings that it touches.
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
    """Return the effect; its place or time, if it has one, is moved into one of the runs, so that they can show it."""
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
    """Scale an effect to the wanted ``snr_local`` within its physical limits; return it and its visibility, None if it leaves no trace."""
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

    Of the part that the model cannot absorb, over the noise, ``snr_total`` is the norm, ``snr_local`` the rms where it is noticeable.
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
    """Return which further measurements would tell each alias from the effect: those of plan full if they suffice, else `BEYOND`."""
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
