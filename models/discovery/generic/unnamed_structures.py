"""Structures without a name: generic effects that compete with the catalogue in the same search; if they win, the verdict is "unknown".

Each structure describes a kind of deviation (a step, a wave, a bump) of any cause. Without these structures, four of five effects outside
the catalogue would get a wrong name. A key names the axis (``"X"``) or the error motion (``"EYX"``: along X in direction Y).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from abbe.models.arrays import F1, F2, F3
from abbe.models.discovery.answer import Localization
from abbe.models.discovery.case import Case
from abbe.models.discovery.generic.scan import PERIODS_S, PITCHES_MM, ScanResult, bumps, bursts, periods, pitches, step_instants
from abbe.models.discovery.localization import localize_signal
from abbe.models.effects.effect import Effect, Form, Parameter, Signal, Values
from abbe.models.effects.path import Path, Places, read_together
from abbe.models.functions.legendre import legendre_values
from abbe.models.geometry.rotation import cross_matrix
from abbe.models.machine import AXES

UM = 1e-3
"""Columns of the signals are in mm per micrometre of strength."""
SMOOTH_ORDERS = (2, 3, 4, 5, 6)
ODD_ORDERS = (1, 2, 3)
"""Order 0 is left out: a jump at every reversal has a name (lost motion), which a structure with order 0 would replace."""
ARM_MM = 300.0
"""Rotations of a slip are stated as displacements at this distance, so that all columns of a slip are in micrometres."""
PREFIX = "unnamed_"
COMPONENTS = tuple(f"E{d}{a}" for a in AXES for d in AXES)
CROSS = tuple(key for key in COMPONENTS if key[1] != key[2])
LOBES = (3, 4, 5, 6)
WIDTHS_MM = (13.0, 24.0)
SOURCE = "generic structure, docs/decisions/0012-discovery.md"
TOP = 6
"""Starts per label that a scan of the residuals keeps."""
CLOCK_S = 30.0
"""Margin on either side of a reported time."""
NO_TEST = "measure again: nothing in the catalogue looks like this"
DEPENDS: dict[str, tuple[str, ...]] = {
    "smooth": ("position",), "odd": ("position", "direction"), "wave": ("position",), "surge": ("time",), "step": ("time",),
    "slip": ("time",), "settling": ("time",), "bump": ("position",), "lobes": ("bar azimuth",), "burst": ("time",),
}  # fmt: skip
Starts = dict[str, dict[str, tuple[float, ...]]]
"""Starts by kind of structure, then by key (for ``"burst"`` by parameter)."""


def smooth(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a smooth deviation: for ``"EYX"`` in direction Y as a function of X, Legendre orders 2 to 6 over the stroke."""
    return read_together(paths, lambda at: _along(key[1], _orders(paths[0], at, key[2], SMOOTH_ORDERS)))


def odd(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns as `smooth` does, but of orders 1 to 3 and multiplied by the direction in which the axis last moved."""

    def deviation(at: Places) -> F3:
        return _along(key[1], at.sign[:, AXES.index(key[2]), None] * _orders(paths[0], at, key[2], ODD_ORDERS))

    return read_together(paths, deviation)


def wave(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a wave with pitch ``pitch_mm``; ``key`` ``"EYX"``: a displacement along Y, as X moves."""
    axis = AXES.index(key[2])
    return read_together(paths, lambda at: _along(key[1], _turns(at.q_mm[:, axis] / values["pitch_mm"])))


def wave_second(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of the second harmonic of `wave`."""
    return wave(paths, key, {"pitch_mm": values["pitch_mm"] / 2.0})


def surge(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a wave in time with ``period_s``: of an axis (``"X"``) or of an instrument's reading (``"bar"``, ``"laser"``)."""
    period = values["period_s"]
    if key in AXES:
        return read_together(paths, lambda at: _along(key, _turns(at.t_s / period)))
    return [UM * (_turns(p.at.t_s / period) - _turns(p.reference.t_s / period)) if p.kind == key else np.zeros((p.n, 2)) for p in paths]


def surge_second(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of the second harmonic of `surge`: a pump, a thermostat or a counterbalance repeats, but not as a sine."""
    return surge(paths, key, {"period_s": values["period_s"] / 2.0})


def step(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return the column of a constant offset of one axis from ``t0_s`` on."""
    return read_together(paths, lambda at: _along(key, (at.t_s >= values["t0_s"]).astype(np.float64)[:, None]))


def slip(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a move of the workpiece side at ``t0_s`` (a clamp gave way): three translations, three rotations."""

    def deviation(at: Places) -> F3:
        turned = -cross_matrix((at.q_mm - paths[0].machine.centre_mm) / ARM_MM)
        moved = np.broadcast_to(np.eye(3), turned.shape)
        return np.asarray(UM * np.concatenate([moved, turned], axis=2) * (at.t_s >= values["t0_s"])[:, None, None])

    return read_together(paths, deviation)


def settling(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return the column of an axis that drifts from ``t0_s`` on and settles with time constant ``tau_s``."""

    def gone(t_s: F1) -> F2:
        return np.asarray(-np.expm1(-np.maximum(t_s - values["t0_s"], 0.0) / values["tau_s"]))[:, None]

    return read_together(paths, lambda at: _along(key, gone(at.t_s)))


def bump(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a deviation, in any direction, near the position at time ``at_s``: Gaussian of standard deviation ``width_mm``."""
    centre = place_at(paths, values["at_s"])

    def deviation(at: Places) -> F3:
        height = np.exp(-0.5 * np.sum((at.q_mm - centre) ** 2, axis=1) / values["width_mm"] ** 2)
        return np.asarray(UM * height[:, None, None] * np.eye(3))

    return read_together(paths, deviation)


def place_at(paths: tuple[Path, ...], at_s: float) -> F1:
    """Commanded position (3,), mm, at a time of the campaign: interpolated in the run that covers or is nearest to this time."""

    def apart(p: Path) -> float:
        return max(float(p.at.t_s[0]) - at_s, at_s - float(p.at.t_s[-1]), 0.0)

    p = min(paths, key=apart)
    return np.array([np.interp(at_s, p.at.t_s, p.at.q_mm[:, k]) for k in range(3)])


def lobes(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of an out-of-round ball: for ``"Z3"`` three lobes around Z (a wave in the bar's azimuth, equal at all latitudes)."""
    polar, number = AXES.index(key[0]), int(key[1:])
    return [UM * _lobed(p.look, polar, number) if p.kind == "bar" else np.zeros((p.n, 2)) for p in paths]


def _lobes_by_latitude(power: int) -> Signal:
    """Make the signal of lobes (`lobes`) whose height goes with a power of the sine of the bar's latitude.

    On a smooth ball, lobes of constant height are impossible: they would meet at the pole. In spherical harmonics of order m their height
    is the cosine of the latitude to the power of m, times a polynomial in its sine; the first two powers approximate it at the latitudes
    that bars reach.
    """

    def signal(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
        polar = AXES.index(key[0])
        return [c * p.look[:, polar, None] ** power for c, p in zip(lobes(paths, key, values), paths, strict=True)]

    return signal


LOBE_FORMS = (Form("latitude", _lobes_by_latitude(1)), Form("latitude squared", _lobes_by_latitude(2)))


def _lobed(look: F2, polar: int, number: int) -> F2:
    a, b = (polar + 1) % 3, (polar + 2) % 3
    azimuth = np.arctan2(look[:, b], look[:, a])
    return np.stack([np.cos(number * azimuth), np.sin(number * azimuth)], axis=1)


def burst(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return columns of a ball-bar's oscillation with ``frequency_hz`` near ``t0_s``, under a Gaussian of sigma ``width_s``."""
    out = []
    for p in paths:
        since = p.at.t_s - values["t0_s"]
        near = np.exp(-0.5 * (since / values["width_s"]) ** 2)[:, None] * float(p.kind == "bar")
        out.append(np.asarray(UM * near * _turns(since * values["frequency_hz"])))
    return out


def _orders(p: Path, at: Places, axis: str, orders: tuple[int, ...]) -> F2:
    a = AXES.index(axis)
    return legendre_values(at.q_mm[:, a], p.machine.stroke_mm[a], max(orders))[:, list(orders)]


def _turns(turns: F1) -> F2:
    return np.stack([np.cos(2 * np.pi * turns), np.sin(2 * np.pi * turns)], axis=1)


def _along(direction: str, columns: F2) -> F3:
    out = np.zeros((len(columns), 3, columns.shape[1]))
    out[:, AXES.index(direction), :] = UM * columns
    return out


SIGNALS: dict[str, Signal] = {
    "unnamed_smooth": smooth, "unnamed_odd": odd, "unnamed_wave": wave, "unnamed_surge": surge, "unnamed_step": step,
    "unnamed_slip": slip, "unnamed_settling": settling, "unnamed_bump": bump, "unnamed_lobes": lobes, "unnamed_burst": burst,
}  # fmt: skip


def is_unnamed(name: str) -> bool:
    """Whether an effect is a structure outside the catalogue, by its name."""
    return name.startswith(PREFIX)


def generic_rivals(
    case: Case, residuals: Mapping[str, F1] | None = None, sigma_mm: Mapping[str, float] | None = None
) -> tuple[Effect, ...]:
    """Return the unnamed structures as effects, with starts for this campaign.

    Parameters
    ----------
    residuals : dict, optional
        Whitened residuals of runs by label, shape (n,) each, zero at invalid readings. A scan of them finds the starts, so call again after
        effects are added to the model. Without residuals the starts are a coarse grid.
    sigma_mm : dict, optional
        Noise of one reading of "bar" and "laser"; only needed with residuals.

    Returns
    -------
    tuple of Effect
        Names start with ``unnamed_``; strengths are micrometres.
    """
    runs = case.of("identify") or case.of("identify", "holdout")
    paths = tuple(r.path for r in runs)
    if residuals is None or sigma_mm is None:
        starts = _coarse(paths)
    else:
        kept = tuple(p for p in paths if p.label in residuals)
        starts = _scanned(ScanResult(kept, tuple(residuals[p.label] for p in kept), tuple(sigma_mm[p.kind] for p in kept)))
    bar = any(p.kind == "bar" for p in paths)
    return tuple(e for e in _all(starts, paths) if bar or e.name not in ("unnamed_lobes", "unnamed_burst"))


def location_of(effect: Effect, key: str, values: Values, case: Case) -> Localization:
    """Locate an unnamed structure from its parameters (time, position, period, lobes) and its columns (tests, axes).

    Parameters
    ----------
    values : fitted non-linear parameters of ``effect``.
    """
    paths = tuple(r.path for r in case.of("identify", "holdout"))
    columns = effect.signal(paths, key, values)
    base = localize_signal(paths, tuple(np.linalg.norm(c, axis=1) for c in columns))
    located: dict[str, object] = {"tests": base.tests, "runs": base.runs}
    letters = key[1:] if key[:1] == "E" else key
    located["axes"] = tuple(a for a in AXES if a in letters) or base.axes
    kind = effect.name.removeprefix(PREFIX)
    if kind in ("step", "slip", "settling"):
        later = 3.0 * values.get("tau_s", 0.0)
        located["time_s"] = (values["t0_s"] - CLOCK_S, values["t0_s"] + CLOCK_S + later)
    elif kind == "burst":
        located["time_s"] = (values["t0_s"] - 2.0 * values["width_s"], values["t0_s"] + 2.0 * values["width_s"])
    elif kind == "surge":
        located["period_s"] = values["period_s"]
    elif kind == "wave":
        located["period_mm"] = values["pitch_mm"]
    elif kind == "lobes":
        located |= {"angular_lobes": int(key[1:]), "axes": (), "tests": base.tests}
    elif kind == "bump":
        x, y, z = place_at(paths, values["at_s"])
        located |= {"position_mm": (float(x), float(y), float(z)), "radius_mm": 2.0 * values["width_mm"]}
    return Localization(**located, depends_on=DEPENDS[kind])  # type: ignore[arg-type]


def _scanned(scanned: ScanResult) -> Starts:
    instants = step_instants(scanned, TOP)
    t0, width, hertz = bursts(scanned, TOP)
    return {
        "step": instants, "slip": {"": instants[""]}, "settling": {k: instants[k][:3] for k in AXES}, "surge": periods(scanned, TOP),
        "wave": pitches(scanned, TOP), "bump": {"": bumps(scanned, WIDTHS_MM, 2 * TOP)},
        "burst": {"t0_s": t0[:4], "width_s": width[:3], "frequency_hz": hertz[:4]},
    }  # fmt: skip


def _coarse(paths: tuple[Path, ...]) -> Starts:
    """Return starts on a coarse grid: times within runs, periods, pitches, and positions along the paths."""
    t = np.concatenate([np.linspace(p.at.t_s[0], p.at.t_s[-1], 6) for p in paths])
    instants = tuple(float(v) for v in t + 0.5)
    places = tuple(float(v) for p in _apart(paths) for v in np.linspace(p.at.t_s[0], p.at.t_s[-1], 24))
    bars = [p for p in paths if p.kind == "bar"]
    middles = tuple(float(v) for p in bars for v in np.linspace(p.at.t_s[0], p.at.t_s[-1], 8))
    clock = max(p.at.t_s[-1] for p in paths) - min(p.at.t_s[0] for p in paths)
    lines = min(int(clock * 2.0 * (1.0 / 25.0 - 1.0 / 80.0)) + 2, 60)
    period = tuple(float(1.0 / f) for f in np.linspace(1.0 / 80.0, 1.0 / 25.0, lines))
    pitch = tuple(float(1.0 / f) for f in np.linspace(1.0 / PITCHES_MM[1], 1.0 / 10.0, 20))
    return {
        "step": dict.fromkeys(AXES, instants), "slip": {"": instants[::2]}, "settling": dict.fromkeys(AXES, instants[::6]),
        "surge": dict.fromkeys(("X", "Y", "Z", "bar", "laser"), period), "wave": dict.fromkeys(CROSS, pitch), "bump": {"": places},
        "burst": {"t0_s": middles or (0.0,), "width_s": (1.5,), "frequency_hz": (1.0,)},
    }  # fmt: skip


def _apart(paths: tuple[Path, ...]) -> tuple[Path, ...]:
    """Return one run of every different path: runs back, or at another feed, pass the same positions."""
    distinct: dict[tuple[float, ...], Path] = {}
    for p in paths:
        distinct.setdefault((*p.centre_mm, p.radius_mm, *np.round(np.ptp(p.at.q_mm, axis=0)), *np.round(p.look[0], 2) ** 2), p)
    return tuple(distinct.values())


def _all(starts: Starts, paths: tuple[Path, ...]) -> list[Effect]:
    end = max(float(p.at.t_s[-1]) for p in paths)
    kinds = {p.kind for p in paths}
    out = [
        _effect("smooth", "smooth function of one axis", COMPONENTS, (), absorbed_by=("rigid21",)),
        # Along the axis itself this has a name: backlash that depends on the position.
        _effect("odd", "function of one axis that changes its sign with the direction", CROSS, ()),
        _effect("lobes", "ball out of round", tuple(f"{a}{n}" for a in AXES for n in LOBES), (), forms=LOBE_FORMS),
    ]
    clock, tau = (0.0, end), Parameter("tau_s", "s", 20.0, 900.0, 120.0, SOURCE, (120.0,))
    # An effect has one set of starts for all its keys, so kinds with starts of their own for each key become one effect per key.
    for key in AXES:
        out.append(_effect("step", "step of one axis", (key,), (_par("t0_s", clock, starts["step"][key]),)))
        out.append(_effect("settling", "one axis wanders off", (key,), (_par("t0_s", clock, starts["settling"][key]), tau)))
    out.append(_effect("slip", "workpiece clamping gave way", ("",), (_par("t0_s", clock, starts["slip"][""]),)))
    for key in (*AXES, *sorted(kinds)):
        shortest = max(PERIODS_S[0], _resolved_s([p for p in paths if key in (*AXES, p.kind)]))
        resolved = tuple(v for v in starts["surge"][key] if v >= shortest)
        period = _par("period_s", (min(shortest, PERIODS_S[1]), PERIODS_S[1]), resolved)
        out.append(_effect("surge", "wave in time", (key,), (period,), forms=(Form("second harmonic", surge_second),)))
    for key in CROSS:
        pitch = _par("pitch_mm", PITCHES_MM, starts["wave"][key])
        out.append(_effect("wave", "wave across the motion of one axis", (key,), (pitch,), forms=(Form("second harmonic", wave_second),)))
    width = Parameter("width_mm", "mm", 8.0, 45.0, 20.0, SOURCE, WIDTHS_MM)
    out.append(_effect("bump", "bump at one place", ("",), (_par("at_s", clock, starts["bump"][""]), width)))
    b = starts["burst"]
    burst = (
        _par("t0_s", clock, b["t0_s"]),
        _par("width_s", (0.15, 6.0), b["width_s"]),
        _par("frequency_hz", (0.05, 12.0), b["frequency_hz"]),
    )
    out.append(_effect("burst", "short disturbance of the reading", ("",), burst))
    return [e for e in out if all(p.starts for p in e.shape)]


def _resolved_s(paths: Sequence[Path]) -> float:
    """Shortest period, s, that the most densely sampled run resolves: two sampling intervals."""
    steps = [float(np.median(np.diff(p.at.t_s))) for p in paths if p.n > 1]
    return 2.0 * min(steps, default=np.inf)


def _par(name: str, bounds: tuple[float, float], starts: tuple[float, ...]) -> Parameter:
    kept = tuple(dict.fromkeys(float(np.clip(v, *bounds)) for v in starts))
    return Parameter(name, name.rsplit("_", 1)[1], bounds[0], bounds[1], kept[0] if kept else bounds[0], SOURCE, kept)


def _size(coefficients: F1, values: Values) -> float:
    return float(np.linalg.norm(coefficients))


def _effect(
    kind: str, title: str, keys: tuple[str, ...], shape: tuple[Parameter, ...], *,
    absorbed_by: tuple[str, ...] = (), forms: tuple[Form, ...] = (),
) -> Effect:  # fmt: skip
    name = PREFIX + kind
    return Effect(
        name=name, title=title, family="structure", keys=keys, unit="um", per_unit=1.0, typical=(0.5, 30.0), shape=shape,
        signal=SIGNALS[name], strength=_size, needs="", signature="depends on " + " and ".join(DEPENDS[kind]), remedy="mechanics",
        remedy_text=NO_TEST, source=SOURCE, forms=forms, absorbed_by=absorbed_by,
    )  # fmt: skip
