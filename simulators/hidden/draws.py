"""Random draws of a case: the machine, its set-ups and measurements, and the effects that are hidden in it."""

from dataclasses import dataclass, replace

import numpy as np

from abbe.simulators.hidden.effect import AXES, Hidden
from abbe.simulators.hidden.plans import Machinery
from abbe.simulators.hidden.projection import Model
from abbe.simulators.hidden.rig import Noise
from abbe.simulators.scenario import MachineConfig, Magnitudes, Pair, Pivots, Scenario, Strokes
from abbe.simulators.truth.draws import draw_machine
from abbe.simulators.truth.machine import Geometry, Machine

KINDS = {"single": 75, "double": 30, "null": 50, "unknown": 18}
PLAN_WEIGHTS = {"full": 88, "one_way": 20, "minimal": 18, "one_radius": 16, "ballbar": 12, "one_feed": 11, "laser": 8}
MOTIONS = (0.22, 0.55)
"""Size of the error motions, smallest and largest, as a fraction of those in the whole-machine scenarios."""
TERMS = ("setup_centre_offset", "bar_length_error", "mirror_tilt")
CHAINS: dict[str, tuple[float, dict[str, tuple[float, float, float]], str]] = {
    "w-X-b-Y-Z-t": (700.0, {"X": (350.0, 250.0, -150.0), "Y": (0.0, 0.0, 260.0), "Z": (0.0, 0.0, 260.0)}, "Y"),
    "w-b-X-Y-Z-t": (600.0, {"X": (0.0, 320.0, 260.0), "Y": (0.0, 320.0, 260.0), "Z": (0.0, 320.0, 260.0)}, "Z"),
    "w-X-Y-b-Z-t": (800.0, {"X": (400.0, 250.0, -230.0), "Y": (400.0, 250.0, -150.0), "Z": (0.0, 320.0, 260.0)}, "Z"),
    "w-Y-b-X-Z-t": (700.0, {"X": (0.0, 320.0, 260.0), "Y": (350.0, 250.0, -150.0), "Z": (0.0, 320.0, 260.0)}, "Z"),
}
COMPONENTS = tuple(f"E{d}{a}" for a in AXES for d in AXES if d != a)
ANGLES = tuple(f"E{r}{a}" for a in AXES for r in "ABC")
CATALOGUE: dict[str, tuple[tuple[str, ...], str, float, Pair]] = {
    # name: keys, unit, first guess of the strength, limits of its size
    "backlash": (tuple(AXES), "um", 3.0, (0.05, 30.0)),
    "backlash_position_dependent": (tuple(AXES), "um", 3.0, (0.05, 30.0)),
    "reversal_spike": (tuple(AXES), "um", 2.0, (0.05, 15.0)),
    "cyclic_error": (tuple(AXES), "um", 2.0, (0.05, 8.0)),
    "servo_mismatch": (tuple(AXES), "ms", 0.1, (0.005, 0.6)),
    "contour_lag": (("",), "ms", 15.0, (3.0, 35.0)),
    "stick_slip": (tuple(AXES), "um", 3.0, (0.1, 6.0)),
    "vibration": (tuple(AXES), "um", 1.0, (0.1, 4.0)),
    "lateral_play": (COMPONENTS, "um", 2.0, (0.05, 12.0)),
    "nonrigid_bed": (COMPONENTS, "um", 10.0, (0.5, 20.0)),
    "ram_sag": (("",), "um", 30.0, (1.0, 60.0)),
    "straightness": (COMPONENTS, "um", 5.0, (0.2, 15.0)),
    "positioning_nonlinear": (tuple(AXES), "um", 5.0, (0.2, 20.0)),
    "angular_error": (ANGLES, "urad", 20.0, (1.0, 80.0)),
    "axis_thermal_growth": (tuple(AXES), "K", 3.0, (0.2, 8.0)),
    "spindle_thermal_drift": (tuple(AXES), "um", 20.0, (1.0, 60.0)),
    "squareness_thermal": (("XY", "ZX", "YZ"), "urad", 20.0, (1.0, 60.0)),
    "bar_thermal": (("",), "K", 2.0, (0.1, 6.0)),
    "bar_length_error": (("",), "um", 4.0, (0.2, 15.0)),
    "setup_centre_offset": (("",), "um", 5.0, (0.2, 30.0)),
    "mirror_tilt": (("",), "urad", 100.0, (5.0, 800.0)),
    "laser_cosine": (("",), "mrad", 2.0, (0.2, 5.0)),
    "air_refraction": (("",), "K", 2.0, (0.2, 6.0)),
    "dead_path": (("",), "K/h", 3.0, (0.2, 8.0)),
    "beam_outliers": (("",), "um", 5.0, (0.2, 60.0)),
}
OUTSIDE: dict[str, tuple[tuple[str, ...], str, float, Pair]] = {
    "clamp_slip": (("",), "urad", 30.0, (1.0, 100.0)),
    "encoder_count_loss": (tuple(AXES), "um", 4.0, (0.1, 20.0)),
    "local_bump": (tuple(AXES), "um", 4.0, (0.2, 25.0)),
    "ball_form": (("",), "um", 3.0, (0.2, 8.0)),
    "interference_burst": (("",), "um", 3.0, (0.2, 10.0)),
    "counterbalance_surge": (("",), "um", 2.0, (0.1, 8.0)),
}
GEOMETRY = frozenset({"straightness", "positioning_nonlinear", "angular_error"})
TURN = (0.0, 2.0 * np.pi)
LEADS_MM = [5.0, 8.0, 10.0, 12.0, 12.7, 15.0, 16.0, 20.0, 25.0]
RANGES: dict[str, dict[str, Pair]] = {
    "backlash_position_dependent": {"k": (0.5, 1.0)},
    "reversal_spike": {"d0_mm": (0.15, 1.0), "p": (0.0, 0.8)},
    "cyclic_error": {"ph1": TURN, "r2": (0.0, 0.4), "ph2": TURN},
    "stick_slip": {"period_mm": (0.05, 0.3), "v_c": (1.0, 4.0)},
    "vibration": {"f_hz": (5.0, 60.0)},
    "ram_sag": {"beta": (0.5, 1.0)},
    "axis_thermal_growth": {"tau_s": (1200.0, 7200.0)},
    "spindle_thermal_drift": {"tau_s": (1200.0, 6000.0)},
    "squareness_thermal": {"tau_s": (1200.0, 6000.0)},
    "bar_thermal": {"tau_s": (400.0, 1200.0)},
    "air_refraction": {"period_s": (5000.0, 14000.0), "phase": TURN},
    "beam_outliers": {"rate": (0.01, 0.04)},
    "ball_form": {"phase": TURN},
    "interference_burst": {"width_s": (1.0, 4.0), "f_hz": (0.5, 3.0)},
    "counterbalance_surge": {"period_s": (25.0, 80.0), "phase": TURN},
    "local_bump": {"w_mm": (12.0, 30.0)},
}
RANDOM = frozenset({"stick_slip", "vibration", "beam_outliers", "interference_burst"})
"""Effects whose phase or place is unpredictable."""
ONE_SIGN = RANDOM | {"reversal_spike", "cyclic_error", "contour_lag", "ram_sag", "straightness", "positioning_nonlinear", "angular_error",
    "bar_thermal", "setup_centre_offset", "mirror_tilt", "laser_cosine", "air_refraction", "axis_thermal_growth", "local_bump", "ball_form",
    "clamp_slip", "encoder_count_loss", "counterbalance_surge"}  # fmt: skip


@dataclass(frozen=True)
class Setting:
    """A case without its hidden effects: plan, present model, true machine and its nominal geometry (``document``), set-up terms, noise."""

    seed: int
    kind: str
    plan: str
    model: Model
    chain: str
    config: MachineConfig
    machine: Machine
    machinery: Machinery
    setup: tuple[Hidden, ...]
    noise: Noise
    sensors: bool
    document: dict[str, object]


def draw_setting(seed: int, kind: str, forbidden: frozenset[str]) -> Setting:
    """Draw the setting of a case; ``forbidden``: set-up terms that the present model must not include, because they are hidden effects."""
    rng = np.random.default_rng([50, seed])
    plan = str(rng.choice(list(PLAN_WEIGHTS), p=np.array(list(PLAN_WEIGHTS.values())) / sum(PLAN_WEIGHTS.values())))
    level = "rigid21" if rng.random() < 0.62 else "rigid6"
    chain = str(rng.choice(list(CHAINS)))
    terms = set(TERMS) - forbidden
    if not forbidden and rng.random() < 1.0 / 3.0:
        terms.discard(str(rng.choice(TERMS)))
    config, vertical = config_of(chain)
    rest = np.where(rng.random(3) < 0.5, -1.0, 1.0)
    machine = true_machine(seed, config, level, float(np.exp(rng.uniform(*np.log(MOTIONS)))))
    geometry = machine.geometry
    bar_mm = 1e-3 * float(rng.choice([0.25, 0.4, 0.6]))
    sizes = (rng.uniform(2.0, 30.0), rng.normal(scale=1.5), rng.uniform(30.0, 300.0))
    streams = rng.integers(1, 2**30, size=len(TERMS)).tolist()
    setup = tuple(
        Hidden(name, "", {"strength": float(size)}, stream=stream)
        for name, size, stream in zip(TERMS, sizes, streams, strict=True)
        if name in terms
    )
    noise = Noise(bar_mm, 0.6 * bar_mm, float(rng.uniform(0.3, 0.4)), float(rng.uniform(0.6, 0.8)))
    document: dict[str, object] = {"chain": chain, "vertical_axis": vertical}
    for name in ("stroke_mm", "pivots_mm"):
        document[name] = {a: list(getattr(getattr(config, name), a)) for a in AXES}
    machinery = Machinery(geometry.low_mm, geometry.high_mm, AXES.index(vertical), rest)
    sensors = bool(rng.random() < 0.62)
    return Setting(
        seed, kind, plan, Model(level, frozenset(terms)), chain, config, machine, machinery, setup, noise, sensors, document
    )  # fmt: skip


def config_of(chain: str) -> tuple[MachineConfig, str]:
    """Return the nominal machine of a chain and its vertical axis."""
    stroke_x, pivots, vertical = CHAINS[chain]
    return MachineConfig(chain, Strokes((0.0, stroke_x), (0.0, 500.0), (0.0, 450.0)), Pivots(**pivots), (0.0, 0.0, 0.0)), vertical


def true_machine(seed: int, config: MachineConfig, level: str, size: float) -> Machine:
    """Draw a true machine with error motions ``size`` times the default `Magnitudes`; level ``rigid6``: scales and squareness only."""
    usual = Magnitudes()
    if level == "rigid6":
        size = 0.0
    motions = {n: _times(getattr(usual, n), size) for n in ("positioning_rms_um", "straightness_rms_um", "angle_rms_urad")}
    sizes = replace(usual, **motions, angle_slope_sd_urad=size * usual.angle_slope_sd_urad)  # type: ignore[arg-type]
    scenario = Scenario(seed=seed, machine=config, magnitudes=sizes)
    return Machine(Geometry(config), draw_machine(scenario))


def _times(pair: Pair, factor: float) -> Pair:
    return pair[0] * factor, pair[1] * factor


def draw_hidden(rng: np.random.Generator, name: str, setting: Setting, span_s: Pair, wild: bool) -> Hidden:
    """Draw one effect, with a first guess of its strength; ``span_s``: first and last instant of the campaign."""
    keys, _, guess, _ = (CATALOGUE | OUTSIDE)[name]
    key = str(rng.choice(list(keys)))
    sign = 1.0 if name in ONE_SIGN or rng.random() < 0.5 else -1.0
    if name in ("backlash", "backlash_position_dependent"):
        sign = -1.0 if rng.random() < 0.15 else 1.0
    more = _parameters(rng, name, key, setting, span_s)
    seed = int(rng.integers(1, 2**30))
    return Hidden(name, key, {"strength": sign * guess, **more}, seed if wild else 0, stream=seed)


def _parameters(rng: np.random.Generator, name: str, key: str, setting: Setting, span_s: Pair) -> dict[str, float]:
    """Draw all parameters of an effect but its strength."""
    out = {p: float(rng.uniform(*limits)) for p, limits in RANGES.get(name, {}).items()}
    if name == "backlash_position_dependent":
        out["k"] *= float(rng.choice([-1.0, 1.0]))
    elif name == "cyclic_error":
        out["pitch_mm"] = float(rng.choice(LEADS_MM)) * (1.0 + 1e-4 * float(rng.normal()))
    elif name == "nonrigid_bed":
        out["other"] = float(3 - AXES.index(key[1]) - AXES.index(key[2]))
    elif name in GEOMETRY:
        out["seed"] = float(rng.integers(1, 2**30))
    elif name == "axis_thermal_growth":
        a = AXES.index(key)
        out["x_fixed"] = float(rng.choice([setting.machinery.low_mm[a], setting.machinery.high_mm[a]]))
    elif name == "ball_form":
        out["lobes"] = float(rng.integers(3, 6))
    if name in ("clamp_slip", "encoder_count_loss", "interference_burst"):
        out["t0_s"] = float(rng.uniform(*span_s))
    return out
