"""Refinement of a candidate's non-linear parameters between the starts of its grid, before it is compared with others."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy

from abbe.models.arrays import F2
from abbe.models.discovery.candidates import Pick, gain_of, with_values
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.effects.effect import Parameter

SWEEPS = 2
EVALUATIONS = 9
NEAR = 0.02
"""A structure without a name is refined within this share of its parameters' range."""


def refined(problem: WhitenedProblem, pick: Pick, rows: F2, *, sweeps: int = SWEEPS) -> tuple[Pick, float]:
    """Best values near those of ``pick`` (one parameter after the other, between the neighbouring starts), and the gain there."""
    best = gain_of(problem, pick, rows)
    if not pick.effect.shape:
        return pick, best
    for sweep in range(sweeps if len(pick.effect.shape) > 1 else 1):
        before = best
        for parameter in pick.effect.shape:
            pick, best = _along(parameter, pick, best, lambda p: gain_of(problem, p, rows), shrink=0.5**sweep)
        if best - before < 0.3:
            break
    return pick, best


def _along(parameter: Parameter, pick: Pick, best: float, gain: Callable[[Pick], float], shrink: float) -> tuple[Pick, float]:
    value = pick.values[parameter.name]
    low, high = _neighbours(parameter, value)
    if pick.unnamed:  # its starts are the peaks of a scan, not a grid
        reach = NEAR * (parameter.high - parameter.low)
        low, high = max(low, value - reach), min(high, value + reach)
    low, high = value + (low - value) * shrink, value + (high - value) * shrink
    if not high > low:
        return pick, best
    logs = low > 0.0 and high / low > 1.5

    def at(x: float) -> Pick:
        return with_values(pick, {**pick.values, parameter.name: float(np.exp(x)) if logs else float(x)})

    bounds = (np.log(low), np.log(high)) if logs else (low, high)
    found = scipy.optimize.minimize_scalar(
        lambda x: -gain(at(x)), bounds=bounds, method="bounded", options={"maxiter": EVALUATIONS, "xatol": 1e-4 * (bounds[1] - bounds[0])}
    )
    return (at(found.x), -float(found.fun)) if -found.fun > best else (pick, best)


def _neighbours(parameter: Parameter, value: float) -> tuple[float, float]:
    """The starts next to a value, or the bounds of the parameter."""
    below = [s for s in parameter.starts if s < value * (1 - 1e-9) - 1e-12]
    above = [s for s in parameter.starts if s > value * (1 + 1e-9) + 1e-12]
    return max(below, default=parameter.low), min(above, default=parameter.high)
