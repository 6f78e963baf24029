"""Campaigns of runs at standstill (ISO 230-3): the part of the displacement that temperatures explain, as text and JSON."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.standstill import Standstill, rms, standstill
from abbe.models.evaluation.thermal_response import CHANCE, Shift, StandstillRun, probability_shifted
from abbe.service.domain.run import LaserSetup, Run
from abbe.service.errors import NotObservable
from abbe.service.rendering.numbers import plain, with_uncertainty

FORMAT = "abbe-standstill/1"
TEMPERATURE = re.compile(r"temp_(\w+)_C")
GAIN = 0.9
"""The lagged response explains something if it leaves less than this share of the displacement in runs outside the fit."""


@dataclass(frozen=True, eq=False)
class Judged:
    """A run that was not fitted: prediction and its standard uncertainty, mm; ``measured_mm`` is None for a sealed run."""

    label: str
    predicted_mm: F1
    u_mm: F1
    measured_mm: F1 | None


@dataclass(frozen=True, eq=False)
class StandstillAnswer:
    """Results of the runs of a campaign. ``runs``: labels of those that were fitted, in order of time; ``judged``: all others."""

    campaign: str
    runs: tuple[str, ...]
    sensors: tuple[str, ...]
    found: Standstill
    judged: tuple[Judged, ...]


def at_standstill(runs: Sequence[Run]) -> bool:
    """Whether these are runs of an axis that stood still, with temperatures."""
    return bool(runs) and all(isinstance(r.setup, LaserSetup) and not np.ptp(r.columns.q_mm, axis=0).any() and _sensors(r) for r in runs)


def standstill_answer(campaign: str, runs: Sequence[Run]) -> StandstillAnswer:
    """Fit the runs with the role identify, and predict all others.

    Raises
    ------
    NotObservable
        Too few runs, or too few readings with all temperatures.
    """
    runs = sorted(runs, key=lambda r: float(r.columns.t_s[0]))
    sensors = tuple(name for name in _sensors(runs[0]) if all(name in _sensors(r) for r in runs))
    if not sensors:
        raise NotObservable("the runs have no temperature column in common", "export every run with the same columns temp_..._C")
    series = [_series(r, sensors) for r in runs]
    fitted = [k for k, r in enumerate(runs) if r.identifies]
    try:
        found = standstill([series[k] for k in fitted])
    except ValueError as err:
        raise NotObservable(str(err), "measure on more days, at other temperatures") from None
    judged = []
    for k, run in enumerate(runs):
        if not run.identifies:
            place = sum(i < k for i in fitted) - 0.5
            mean, u = found.response.predict(series[k], probability_shifted(found.response.shift, range(len(fitted)), place))
            judged.append(Judged(run.run_id, mean, u, None if run.is_sealed else series[k].displacement_mm))
    return StandstillAnswer(campaign, tuple(runs[k].run_id for k in fitted), sensors, found, tuple(judged))


def _sensors(run: Run) -> list[str]:
    return [match.group(1) for name in run.columns.further if (match := TEMPERATURE.fullmatch(name))]


def _series(run: Run, sensors: Sequence[str]) -> StandstillRun:
    """Return the valid readings that have all temperatures; displacements are relative to the first of them."""
    columns = run.columns
    temperatures = np.column_stack([np.asarray(columns.further[f"temp_{name}_C"], dtype=np.float64) for name in sensors])
    reading = np.zeros(len(columns)) if run.is_sealed else columns.readings_mm
    kept = columns.valid & np.isfinite(temperatures).all(axis=1) & np.isfinite(reading) & np.isfinite(columns.t_s)
    if kept.sum() < 2:
        raise NotObservable(
            f"run {run.run_id}: only {kept.sum()} readings have all temperatures, expected 2 or more", "leave it out (--without)"
        )
    return StandstillRun(run.run_id, columns.t_s[kept], reading[kept] - reading[kept][0], temperatures[kept])


def lines_of(answer: StandstillAnswer) -> list[str]:
    """Return the answer for the terminal, one fact per line."""
    found, left = answer.found, answer.found.left_out
    raw, static, lagged = (plain(v * 1e3) for v in (left.raw_mm, left.static_mm, left.response_mm))
    word = "Heat explains it in part" if left.response_mm < GAIN * left.raw_mm else "These temperatures do not explain the displacement"
    way = "changes of temperature since the start of a run" if found.since_start else "temperatures as they are"
    time, u_time = (v / 60.0 for v in found.response.time_constant_s)
    out = [
        f"campaign {answer.campaign}: {len(answer.runs)} runs at standstill (ISO 230-3), temperatures {', '.join(answer.sensors)}",
        f"{word}. The displacement since the start of a run is {raw} µm rms. Each run was predicted from all other runs: "
        f"{static} µm rms remain if temperatures act at once, {lagged} µm if they act with a lag.",
        f"U (k = 2) covers {left.covered:.0%} of the readings in these predictions; typical U {plain(2e3 * _typical_u(answer), 2)} µm",
        f"time constant of the lag {' ± '.join(with_uncertainty(time, u_time))} min; the model that predicts better uses {way}",
    ]
    out.append("by sensor, all others unchanged:")
    for k, name in enumerate(answer.sensors):
        at_once, settled = (" ± ".join(with_uncertainty(v * 1e3, u * 1e3)) for v, u in _sensitivities(found, k))
        out.append(f"  {name}: {at_once} µm/K at once, {settled} µm/K settled")
    out += _shift_lines(answer)
    for one in answer.judged:
        if one.measured_mm is not None:
            inside = np.mean(np.abs(one.measured_mm - one.predicted_mm) <= 2.0 * one.u_mm)
            off = plain(rms(one.measured_mm - one.predicted_mm) * 1e3, 2)
            out.append(f"run {one.label} was never fitted: {off} µm rms from its prediction, {inside:.0%} of its readings within U")
    return out


def _shift_lines(answer: StandstillAnswer) -> list[str]:
    better = "look for what changed there (coolant, mounting, sensor)"
    worse = "the other model predicts better; in this one, runs that begin warmer or colder than the rest also look like a shift"
    found = (
        (answer.found.shift_absolute, "temperatures as they are", worse if answer.found.since_start else better),
        (answer.found.shift_since_start, "changes of temperature", better if answer.found.since_start else worse),
    )
    shifts = [_shift_line(answer.runs, shift, what, then) for shift, what, then in found if shift is not None]
    return shifts or [f"shift of several runs: none beyond chance (p > {CHANCE:g})"]


def _shift_line(runs: Sequence[str], shift: Shift, what: str, then: str) -> str:
    size = " ± ".join(with_uncertainty(shift.size_mm * 1e3, shift.u_mm * 1e3))
    sign = "+" if shift.size_mm > 0.0 else ""
    where = f"from run {runs[shift.first]} " + ("on" if shift.last == len(runs) - 1 else f"to run {runs[shift.last]}")
    return f"shift: {where} the displacement differs by {sign}{size} µm from what {what} explain (p = {plain(shift.p, 1)}): {then}"


def answer_doc(answer: StandstillAnswer) -> dict[str, Any]:
    """Return the answer as JSON: figures in µm, µm/K and s with standard uncertainties, predictions in mm."""
    found, left = answer.found, answer.found.left_out
    shifts = {"absolute": found.shift_absolute, "since_start": found.shift_since_start}
    time, u_time = found.response.time_constant_s
    return {
        "format": FORMAT,
        "case": answer.campaign,
        "runs": list(answer.runs),
        "rms_um": {"raw": left.raw_mm * 1e3, "static": left.static_mm * 1e3, "response": left.response_mm * 1e3},
        "covered": left.covered,
        "left_out": [
            {"run": run, "predicted_mm": mean.tolist(), "u_mm": u.tolist()}
            for run, mean, u in zip(answer.runs, left.predicted_mm, left.u_mm, strict=True)
        ],
        "model": "since_start" if found.since_start else "absolute",
        "time_constant_s": time,
        "u_time_constant_s": u_time,
        "sensitivities": [_sensor_doc(found, k, name) for k, name in enumerate(answer.sensors)],
        "shifts": [_shift_doc(answer, shift, model) for model, shift in shifts.items() if shift is not None],
        "predictions": {one.label: {"predicted_mm": one.predicted_mm.tolist(), "u_mm": one.u_mm.tolist()} for one in answer.judged},
    }


def _sensor_doc(found: Standstill, k: int, name: str) -> dict[str, Any]:
    (fast, u_fast), (settled, u_settled) = _sensitivities(found, k)
    figures = {"at_once_um_K": fast, "u_at_once_um_K": u_fast, "settled_um_K": settled, "u_settled_um_K": u_settled}
    return {"sensor": name} | {key: value * 1e3 for key, value in figures.items()}


def _shift_doc(answer: StandstillAnswer, shift: Shift, model: str) -> dict[str, Any]:
    size = {"um": shift.size_mm * 1e3, "u_um": shift.u_mm * 1e3, "p": shift.p}
    return {"model": model, "first": answer.runs[shift.first], "last": answer.runs[shift.last]} | size


def _sensitivities(found: Standstill, sensor: int) -> tuple[tuple[float, float], tuple[float, float]]:
    return found.response.sensitivity(sensor, settled=False), found.response.sensitivity(sensor, settled=True)


def _typical_u(answer: StandstillAnswer) -> float:
    return float(np.median(np.concatenate(answer.found.left_out.u_mm)))
