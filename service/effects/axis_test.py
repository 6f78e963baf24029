"""A positioning test of one axis: its repeats reveal a slow drift, but not which of several components drifts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Discovery, Gap, Localization, NamedEffect, NextTest, Significance
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.repeats import RepeatDrift, repeat_drift
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path

AXES = "XYZ"
NEAR_MM = 0.05
"""Positions closer than this count as repeated visits of one position."""


def _no_columns(paths: tuple[Path, ...], key: str, values: Values) -> list[F2]:
    """Return no columns: only repeats show this effect, and it contributes nothing to other campaigns."""
    return [np.zeros((p.n, 0)) for p in paths]


def _no_strength(coefficients: F1, values: Values) -> float:
    return 0.0


SLOW_DRIFT = Effect(
    name="slow_drift",
    title="slow drift, alike at all positions, of axis",
    family="thermal",
    keys=tuple(AXES),
    unit="um",
    per_unit=1.0,
    typical=(1.0, 100.0),
    shape=(),
    signal=_no_columns,
    strength=_no_strength,
    needs="a positioning test of one axis with each position visited three times or more from the same side",
    signature="all positions read less (or more) from visit to visit, by the same amount, in both directions",
    remedy="warm up or sensor",
    remedy_text="warm up axis and sensor until repeats agree, mount the sensor short and stiff, then test again; no table can correct it",
    source="ISO 230-2 (repeatability); ISO 230-3 (thermal drift)",
    separated_by={"dead_path": ("reference_length",), "axis_thermal_growth": ("longer_session",)},
)


def is_axis_test(case: Case) -> bool:
    """Whether a campaign consists only of a positioning test of one axis in one set-up."""
    paths = [r.path for r in case.runs]
    beams = {tuple(np.round(np.abs(p.look[0]), 9)) for p in paths}
    return {p.test for p in paths} == {"laser_linear"} and len({p.setup for p in paths}) == 1 and len(beams) == 1


def axis_drift(case: Case) -> Discovery | None:
    """Search the repeats of an axis test for a common drift; None if no position has enough visits.

    The identify runs are fitted. The holdout runs are predicted from the mean of each position and the extrapolated drift.
    """
    place, t, reading = _identify_readings(case)
    drift = repeat_drift(place, t, reading)
    if drift is None:
        return None
    span = _drift_at(drift, t)
    judged = [r for r in case.runs if r.deviation_mm is not None]
    before = {r.path.label: _residual_mm(r, place, reading, None) for r in judged}
    after = {r.path.label: _residual_mm(r, place, reading - drift.drift_mm, span) for r in judged} if drift.named else before
    axis = AXES[int(np.argmax(np.abs(case.runs[0].path.look[0])))]
    location = Localization(tests=("laser_linear",), axes=(axis,), depends_on=("time",))
    table = (Significance("time", f"drift alike at all positions explains {drift.share:.0%} of the repeat variance", drift.share, drift.p),)
    predicted = {
        r.path.label: _predicted(r, place, reading - drift.drift_mm * drift.named, span if drift.named else None) for r in case.runs
    }
    return Discovery(
        verdict="named" if drift.named else "none",
        effects=(_named(drift, axis, location),) if drift.named else (),
        location=Localization(tests=("laser_linear",), axes=(axis,) if drift.named else (), table=table),
        next_test=_next(axis) if drift.named else None,
        gaps={role: _gap(role, judged, before, after, drift) for role in sorted({r.role for r in judged})},
        residual_before_mm=before,
        residual_after_mm=after,
        predicted_mm=predicted,
        predicted_before_mm={r.path.label: _predicted(r, place, reading, None) for r in case.runs},
        noise_mm={"laser": drift.after_mm if drift.named else drift.before_mm},
        p_value=drift.p,
        theta_names=(),
        theta=np.zeros(0),
        theta_covariance=np.zeros((0, 0)),
        confounded_with=(f"spindle_thermal_drift:{axis}", "dead_path", f"axis_thermal_growth:{axis}") if drift.named else (),
    )


def drift_at(case: Case) -> dict[str, F1]:
    """Return the drift found by `axis_drift` at every reading of each run, mm, by run label; linearly extrapolated after fitted runs."""
    place, t, reading = _identify_readings(case)
    drift = repeat_drift(place, t, reading)
    return {} if drift is None else {r.path.label: _extrapolated(_drift_at(drift, t), r.path.at.t_s) for r in case.runs}


def _identify_readings(case: Case) -> tuple[F1, F1, F1]:
    """Return the place, time and reading of the identify runs in chronological order."""
    runs = sorted(case.of("identify"), key=lambda r: float(r.path.at.t_s[0]))
    place, t, reading = (np.concatenate(v) for v in zip(*(_valid(r) for r in runs), strict=True))
    return place, t, reading


def _named(drift: RepeatDrift, axis: str, location: Localization) -> NamedEffect:
    tau = {} if drift.tau_s is None else {"tau_s": (drift.tau_s, drift.tau_s)}  # from a coarse grid: uncertain by a factor
    evidence = -0.5 * np.log(max(1.0 - drift.share, 1e-12)) * drift.drift_mm.size
    rivals = tuple((label, 0.0) for label in (f"spindle_thermal_drift:{axis}", "dead_path", f"axis_thermal_growth:{axis}"))
    size, u = drift.change_mm * 1e3, drift.u_change_mm * 1e3
    return NamedEffect("slow_drift", axis, size, u, tau, np.zeros(0), np.zeros((0, 0)), float(evidence), rivals, location)


def _next(axis: str) -> NextTest:
    why = "a fixed reference read by the same sensor tells whether sensor or axis drifts; a late repeat tells whether the drift has ended"
    return NextTest(("reference_length", "longer_session"), (f"spindle_thermal_drift:{axis}", "dead_path"), None, 30.0, why)


def _valid(run: CaseRun) -> tuple[F1, F1, F1]:
    """Return the place, time and value of the valid readings."""
    assert run.deviation_mm is not None
    return places_of(run)[run.valid], run.path.at.t_s[run.valid], run.deviation_mm[run.valid]


def places_of(run: CaseRun) -> F1:
    """Return a number per reading that encodes its position and its side of approach, shape (n,)."""
    position = np.round(run.path.at.q_mm @ run.path.look[0] / NEAR_MM) * NEAR_MM
    return np.asarray(position + 1e6 * run.path.direction)


def _drift_at(drift: RepeatDrift, t_s: F1) -> tuple[F1, F1]:
    """Return the times and drift of the fitted readings in chronological order."""
    order = np.argsort(t_s, kind="stable")
    return t_s[order], drift.drift_mm[order]


def _predicted(run: CaseRun, place: F1, level: F1, drift: tuple[F1, F1] | None) -> F1:
    """Return the mean of the fitted runs at the same place plus the drift, if any, which is extrapolated linearly after these runs."""
    means = {p: float(level[place == p].mean()) for p in np.unique(place)}
    fallback = float(level.mean())
    out = np.array([means.get(p, fallback) for p in places_of(run)])
    return out if drift is None else out + _extrapolated(drift, run.path.at.t_s)


def _extrapolated(drift: tuple[F1, F1], t_s: F1) -> F1:
    t, d = drift
    slope = (d[-1] - d[-2]) / (t[-1] - t[-2]) if t[-1] > t[-2] else 0.0
    return np.asarray(np.interp(t_s, t, d) + slope * np.maximum(t_s - t[-1], 0.0))


def _residual_mm(run: CaseRun, place: F1, level: F1, drift: tuple[F1, F1] | None) -> F1:
    assert run.deviation_mm is not None
    return np.asarray(np.where(run.valid, run.deviation_mm - _predicted(run, place, level, drift), np.nan))


def _gap(role: str, judged: Sequence[CaseRun], before: dict[str, F1], after: dict[str, F1], drift: RepeatDrift) -> Gap:
    labels = [r.path.label for r in judged if r.role == role]
    rms = [float(np.sqrt(np.nanmean(np.concatenate([v[label] for label in labels]) ** 2))) for v in (before, after)]
    return Gap(rms[0], rms[1], drift.after_mm if drift.named else drift.before_mm)
