"""A hidden effect in the simulated world of the devices, followed sample by sample on the world's clock."""

from dataclasses import asdict, dataclass

import numpy as np

from abbe.simulators.arrays import F
from abbe.simulators.hidden import drive, outside, structure, thermal
from abbe.simulators.hidden.effect import UM, Hidden, effect_names
from abbe.simulators.hidden.instrument import AIR_PPM_PER_K, DEAD_PATH_MM, air_rise
from abbe.simulators.hidden.track import NEVER_MM, Track
from abbe.simulators.scenario import HiddenConfig, ScenarioError

MOVES = frozenset({
    "backlash_position_dependent", "reversal_spike", "cyclic_error", "stick_slip", "vibration", "lateral_play", "nonrigid_bed",
    "straightness", "positioning_nonlinear", "axis_thermal_growth", "spindle_thermal_drift", "squareness_thermal", "local_bump",
    "counterbalance_surge", "encoder_count_loss",
})  # fmt: skip
"""Effects that move the tool; they act on every instrument."""
READS = frozenset({"laser_cosine", "air_refraction", "dead_path", "bar_length_error", "bar_thermal"})
"""Effects of an instrument alone."""
NEEDED = {
    "backlash_position_dependent": ("k",), "reversal_spike": ("d0_mm", "p"), "cyclic_error": ("pitch_mm", "ph1", "r2", "ph2"),
    "stick_slip": ("period_mm", "v_c"), "vibration": ("f_hz",), "nonrigid_bed": ("other",), "straightness": ("seed",),
    "positioning_nonlinear": ("seed",), "axis_thermal_growth": ("tau_s", "x_fixed"), "spindle_thermal_drift": ("tau_s",),
    "squareness_thermal": ("tau_s",), "local_bump": ("cx", "cy", "cz", "w_mm"), "counterbalance_surge": ("period_s", "phase"),
    "encoder_count_loss": ("t0_s",), "air_refraction": ("period_s", "phase"), "bar_thermal": ("tau_s",),
}  # fmt: skip
"""Parameters that an effect needs besides ``strength``."""
VERTICAL = 2
PARTS = (drive, outside, structure, thermal)
"""Modules that are imported so that their effects are registered."""


def live_of(config: HiddenConfig, low_mm: F, high_mm: F) -> "Live | None":
    """Return the hidden effect of a scenario, or None.

    Raises
    ------
    ScenarioError
        The effect or its key is unknown, or a parameter is missing.
    """
    if not config.name:
        return None
    e = Hidden(config.name, config.key, dict(config.parameters), config.wild, stream=config.wild)
    wrong = problem(e)
    if wrong:
        raise ScenarioError(wrong)
    return Live(e, low_mm, high_mm)


def problem(e: Hidden) -> str | None:
    """Return in one line the fault of a scenario's hidden effect, or None."""
    if e.name not in MOVES | READS:
        known = "unknown effect" if e.name not in effect_names() else "the simulated devices do not support this effect"
        return f"hidden.name: {e.name!r}: {known}; choose one of {', '.join(sorted(MOVES | READS))}"
    lacking = [p for p in ("strength", *NEEDED.get(e.name, ())) if p not in e.parameters]
    if lacking:
        return f"hidden.parameters: {e.name} needs {', '.join(lacking)}"
    probe = Live(e, np.zeros(3), np.full(3, 100.0))
    try:
        probe.displacement(np.array([0.0, 1.0]), np.array([[1.0, 2.0, 3.0], [2.0, 3.0, 4.0]]))
    except (KeyError, IndexError, ValueError):
        return f"hidden.key: {e.key!r} is not a key of {e.name}"
    return None


@dataclass
class Live:
    """One effect that follows the machine sample by sample: it remembers directions, reversals, travel and the state of lost motion."""

    effect: Hidden
    low_mm: F
    high_mm: F

    def __post_init__(self) -> None:
        self._last_s = 0.0
        self._last_mm: F | None = None
        self._sign = np.ones(3)  # a machine that homed towards its positive ends last moved in + direction
        self._since = np.full(3, NEVER_MM)
        self._travelled = np.zeros(3)
        self._carriage_mm: float | None = None

    def displacement(self, times_s: F, driven_mm: F) -> F:
        """Return the tool's displacement by the effect, (n, 3) mm, at drive positions (n, 3) mm and times after those of the last call."""
        if self.effect.name not in MOVES:
            return np.zeros(driven_mm.shape)
        track = self._track(times_s, driven_mm)
        if self.effect.name == "backlash_position_dependent":
            out = np.zeros(driven_mm.shape)
            out[:, self.effect.axis] = self._lost(driven_mm[:, self.effect.axis])
            return out
        bend = self.effect.bend(track)
        return np.asarray(bend.drive + bend.shift.sum(axis=0))

    def _track(self, times_s: F, driven_mm: F) -> Track:
        n = len(times_s)
        before = driven_mm[0] if self._last_mm is None else self._last_mm
        step = np.diff(np.vstack([before, driven_mm]), axis=0)
        gap = np.maximum(np.diff(np.concatenate([[self._last_s], times_s])), 1e-6)
        sign, since, travelled = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
        for i in range(n):
            way = np.where(np.abs(step[i]) > 1e-9, np.sign(step[i]), self._sign)
            self._since = np.where(way != self._sign, 0.0, self._since) + np.abs(step[i])
            self._sign, self._travelled = way, self._travelled + np.abs(step[i])
            sign[i], since[i], travelled[i] = way, self._since, self._travelled
        self._last_s, self._last_mm = float(times_s[-1]), driven_mm[-1].copy()
        zero = np.zeros((n, 3))
        speed = np.linalg.norm(step, axis=1) / gap
        feed = 60.0 * float(np.median(speed[speed > 0.0])) if np.any(speed > 0.0) else 1000.0
        return Track(
            "live", "", driven_mm, times_s, step / gap[:, None], zero, sign, since, travelled, zero, np.zeros(n), 0.0, 0.0,
            self.low_mm, self.high_mm, VERTICAL, feed, 0,
        )  # fmt: skip

    def _lost(self, driven_mm: F) -> F:
        """Return carriage minus drive position, (n,) mm, for lost motion whose width varies along the axis."""
        e, a = self.effect, self.effect.axis
        low, high = self.low_mm[a], self.high_mm[a]
        half = 0.5 * e["strength"] * UM * (1.0 + e["k"] * (2.0 * driven_mm - low - high) / (high - low))
        at = float(driven_mm[0] - half[0]) if self._carriage_mm is None else self._carriage_mm
        out = np.empty(len(driven_mm))
        for i, (x, h) in enumerate(zip(driven_mm.tolist(), half.tolist(), strict=True)):
            at = min(max(at, x - h), x + h)
            out[i] = at - x
        self._carriage_mm = at
        return out

    def laser_mm(self, time_s: float, since_zero_s: float, path_mm: float) -> float:
        """Return the error of a laser reading, mm, at an instant; ``since_zero_s``: time since the zero; ``path_mm``: measured path."""
        e = self.effect
        if e.name == "air_refraction":
            return float(AIR_PPM_PER_K * 1e-6 * air_rise(e, np.array([time_s]))[0] * path_mm)
        if e.name == "dead_path":
            return AIR_PPM_PER_K * 1e-6 * DEAD_PATH_MM * e["strength"] * since_zero_s / 3600.0
        return 0.0

    def bar_mm(self, times_s: F, hung_in_s: float, radius_mm: float) -> F:
        """Return the error of the ball-bar's readings at n instants, (n,) mm, for a bar mounted at ``hung_in_s``."""
        n = len(times_s)
        if self.effect.name != "bar_thermal":
            return np.zeros(n)
        zero = np.zeros((n, 3))
        track = Track(
            "bar", "", zero, times_s, zero, zero, zero, zero, zero, zero, np.zeros(n), hung_in_s, hung_in_s,
            self.low_mm, self.high_mm, VERTICAL, 0.0, 0, radius_mm,
        )  # fmt: skip
        return self.effect.bend(track).reading

    def describe(self) -> dict[str, object]:
        """Return name, key, parameters and ``wild`` of the effect, for the truth report."""
        whole = asdict(self.effect)
        return {name: whole[name] for name in ("name", "key", "parameters", "wild")}
