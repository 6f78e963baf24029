"""Test at standstill (ISO 230-3): a model of the thermal response, judged on runs to which it was not fitted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.evaluation.thermal_response import LEAST_RUNS, Series, Shift, StandstillRun, ThermalResponse, probability_shifted

COVERED = 0.95
"""Share of readings that U (k = 2) has to cover in runs left out."""


@dataclass(frozen=True, eq=False)
class LeftOut:
    """Predictions of every run from all other runs. Each rms, mm, is over all runs, and each run has the same weight.

    ``predicted_mm``, ``u_mm``: by run, (n,) each. ``raw_mm``: rms of the displacements; ``static_mm``: rms that a model without lag leaves
    (least squares); ``response_mm``: rms that the response leaves. ``covered``: share of readings within U (k = 2), where U is widened by
    the factor that the other runs need.
    """

    predicted_mm: tuple[F1, ...]
    u_mm: tuple[F1, ...]
    raw_mm: float
    static_mm: float
    response_mm: float
    covered: float


@dataclass(frozen=True, eq=False)
class Standstill:
    """Result of a test at standstill. Two models compete: one of absolute temperatures, one of their changes since the start of each run.

    ``since_start``: whether the model of changes predicts better; ``response``, ``left_out``: results of the better model;
    ``shift_absolute``, ``shift_since_start``: offset of some runs that the model of absolute temperatures, or of changes, does not explain;
    None without such an offset.
    """

    since_start: bool
    response: ThermalResponse
    left_out: LeftOut
    shift_absolute: Shift | None
    shift_since_start: Shift | None


def standstill(runs: Sequence[StandstillRun]) -> Standstill:
    """Fit the response of runs, given in their order, with the model that better predicts runs left out of the fit.

    Raises
    ------
    ValueError
        There are fewer than `LEAST_RUNS` runs.
    """
    if len(runs) < LEAST_RUNS:
        raise ValueError(f"{len(runs)} runs at standstill, expected {LEAST_RUNS} or more: fewer do not separate heat from time")
    series = [Series(runs, since_start=way) for way in (False, True)]
    absolute, since_start = (one.response() for one in series)
    judged = [_left_out(one) for one in series]
    better = judged[1][0].response_mm < judged[0][0].response_mm
    left, widening = judged[better]
    response = replace(since_start if better else absolute, widening=widening)
    return Standstill(better, response, left, absolute.shift, since_start.shift)


def _left_out(series: Series) -> tuple[LeftOut, float]:
    """Predict every run from all others; return also the factor by which u must be widened to cover the runs."""
    predicted, u, static = list[F1](), list[F1](), list[F1]()
    for k, run in enumerate(series.runs):
        kept = [i for i in range(len(series.runs)) if i != k]
        found = series.response(kept)
        mean, sd = found.predict(run, probability_shifted(found.shift, kept, k))
        predicted.append(mean)
        u.append(sd)
        static.append(_static([series.runs[i] for i in kept], run))
    y = [r.displacement_mm for r in series.runs]
    ratio = [np.abs(a - b) / c for a, b, c in zip(y, predicted, u, strict=True)]
    u = [sd * _widening([r for i, r in enumerate(ratio) if i != k]) for k, sd in enumerate(u)]
    covered = np.concatenate([np.abs(a - b) <= 2.0 * c for a, b, c in zip(y, predicted, u, strict=True)])
    raw, simple, lagged = (_by_run(y, other) for other in ([0.0 * v for v in y], static, predicted))
    return LeftOut(tuple(predicted), tuple(u), raw, simple, lagged, float(covered.mean())), _widening(ratio)


def _widening(ratio: Sequence[F1]) -> float:
    """Factor on u, 1 or more, with which 2 u covers the share `COVERED` of the errors; ``ratio``: error divided by u, of each run."""
    return max(1.0, 0.5 * float(np.quantile(np.concatenate(ratio), COVERED)))


def _by_run(y: Sequence[F1], predicted: Sequence[F1]) -> float:
    return rms(np.array([rms(a - b) for a, b in zip(y, predicted, strict=True)]))


def rms(values: F1) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def _static(others: Sequence[StandstillRun], run: StandstillRun) -> F1:
    """Predict a run by a model without lag, fitted to the temperature changes of the other runs (least squares)."""
    changes = np.concatenate([r.temperatures_c - r.temperatures_c[0] for r in others])
    slopes = np.linalg.lstsq(changes, np.concatenate([r.displacement_mm for r in others]), rcond=None)[0]
    return np.asarray((run.temperatures_c - run.temperatures_c[0]) @ slopes)
