"""Monte Carlo trials of a campaign: each draws readings, calibrations, temperatures and omitted orders, solves and predicts.

A batch of results has 10^4 trials of 3 figures per point, so at most `MOST_POINTS` points are allowed at a time. More points can be handled
in several calls: the same seed draws the same errors for any points, except the scatter of `StatedInputs.single_approach`.

Linear trials apply the solver's gain to a whole batch at once. Exact trials iterate like the solver with the exact reading of every run
(finite rotations, length of the bar, tilted mirror). Exact trials are slow; they show that the linear trials are good enough.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2, F3
from abbe.models.geometry.volume import RigidFree, unit_deviation
from abbe.models.solvers.joint import JointSolution
from abbe.models.solvers.observe import predict
from abbe.models.uncertainty.distributions import NORMAL, Distribution
from abbe.models.uncertainty.monte_carlo import Draw
from abbe.models.uncertainty.sources import ErrorSources, Response, response

READINGS = ("bar_noise", "laser_noise")
LIMITS: Mapping[str, Distribution] = MappingProxyType(
    {name: Distribution("rectangular") for name in ("wavelength", "bar_temperature", "scale_temperature")}
)
"""Distributions for inputs that are stated as limits: rectangular, of unit standard deviation."""
EXACT_ROUNDS = 4
MOST_POINTS = 500
"""Most points of one set of trials: a batch of 10^4 results then takes 120 MB, and so does each copy for sorting and moments."""
CHUNK_READINGS = 4_000_000
"""Number of simulated readings in memory at once: 16 MB."""


@dataclass(frozen=True)
class CampaignTrials:
    """Monte Carlo trials of the prediction at m points: the uncertain inputs of a solution and their influence.

    Attributes
    ----------
    sources : ErrorSources
    response : Response
    predict_per_unit : array, shape (3 m, len(sources.terms))
        Deviation at the points per unit of each coefficient, x y z of the first point first.
    distributions : dict
        Distribution of each source's inputs, by name of the source; normal if it is missing.
    """

    sources: ErrorSources
    response: Response
    predict_per_unit: F2
    distributions: Mapping[str, Distribution]

    def value(self) -> F1:
        """Return the predicted deviation for the estimated coefficients, mm, shape (3 m,)."""
        return np.asarray(self.predict_per_unit @ self.sources.coefficients)

    def linear(self) -> Draw:
        """Return a function that draws trials, shape (trials, 3 m), with the solver linearised (its gain)."""
        n = len(self.sources.solution.terms)
        readings = ((self.predict_per_unit[:, :n] @ self.response.gain[:n]).T * self._reading_sd()[:, None]).astype(np.float32)
        others = self._others()
        size = max(1, CHUNK_READINGS // max(len(readings), 1))

        def draw(rng: np.random.Generator, trials: int) -> F2:
            out: F2 = np.empty((trials, len(self.predict_per_unit)))
            for i in range(0, trials, size):  # single precision: seven digits of what is random
                out[i : i + size] = self._readings(rng, min(size, trials - i)) @ readings
            return self._with_others(out, others, rng)

        return draw

    def exact(self) -> Draw:
        """Return a function that draws trials with the exact reading of every run, solved by iteration; all other inputs stay linear."""
        solution, gain, sd = self.sources.solution, self.response.gain, self._reading_sd()
        n = len(solution.terms)
        measured = np.concatenate([run.deviation_mm for run in solution.data])
        resting = self._settled(measured, gain, solution.estimate.theta)
        others = self._others()

        def draw(rng: np.random.Generator, trials: int) -> F2:
            noise = self._readings(rng, trials) * sd
            out = np.empty((trials, len(self.predict_per_unit)))
            for t in range(trials):
                moved = self._settled(measured + noise[t], gain, resting + gain @ noise[t]) - resting
                out[t] = self.predict_per_unit[:, :n] @ moved[:n]
            return self._with_others(out, others, rng)

        return draw

    def _with_others(self, out: F2, others: list[tuple[str, F2]], rng: np.random.Generator) -> F2:
        """Add the prediction and the draws of all other sources to ``out``, in place."""
        for name, factor in others:
            out += self._drawn(name, rng, (len(out), len(factor))) @ factor
        scatter = self.sources.inputs.repeatability_mm if self.sources.inputs.single_approach else 0.0
        if scatter:
            out += scatter * self._drawn("repeatability", rng, (len(out), out.shape[1]))
        out += self.value()
        return out

    def _settled(self, measured: F1, gain: F2, theta: F1) -> F1:
        """Iterate with the exact model as the solver does, with its final weights and priors."""
        for _ in range(EXACT_ROUNDS):
            theta = gain @ (measured - _predicted(self.sources.solution, theta) + self.response.design @ theta)
        return np.asarray(theta)

    def _others(self) -> list[tuple[str, F2]]:
        """Return all sources but the noise of readings: name, and effect of each of its inputs on the results, shape (inputs, 3 m)."""
        b, out = self.predict_per_unit, []
        for s in self.sources.sources:
            if s.name in (*READINGS, "repeatability"):
                continue
            factor = (b @ s.factor).T
            if s.subtracted is not None:
                factor = _clamped(factor, (b @ s.subtracted).T)
            out.append((s.name, factor))
        return out

    def _reading_sd(self) -> F1:
        w = self.response.weight
        return np.where(w > 0, 1.0 / np.sqrt(np.where(w > 0, w, 1.0)), 0.0)

    def _readings(self, rng: np.random.Generator, trials: int) -> NDArray[np.float32]:
        """Errors of all readings in units of their standard deviation, shape (trials, n)."""
        out = np.empty((trials, self.response.weight.size), dtype=np.float32)
        for name in READINGS:
            mask = self.response.kind == name.removesuffix("_noise")
            drawn = np.empty((trials, int(mask.sum())), dtype=np.float32)
            self.distributions.get(name, NORMAL).fill(rng, drawn)
            out[:, mask] = drawn
        return out

    def _drawn(self, name: str, rng: np.random.Generator, shape: tuple[int, int]) -> F2:
        out = np.empty(shape)
        self.distributions.get(name, NORMAL).fill(rng, out)
        return out


def _clamped(plus: F2, subtracted: F2) -> F2:
    """Return the effect (inputs, 3 m) of the source ``estimated_sizes``, clipped at every point as in `predict_deviation`.

    All points use the same draws and stay correlated; the contribution at one point does not depend on the other points.
    """
    points = plus.reshape(len(plus), -1, 3).transpose(1, 2, 0)  # (m, 3, inputs)
    minus = subtracted.reshape(len(subtracted), subtracted.shape[1] // 3, 3).transpose(1, 2, 0)
    whole = points @ np.swapaxes(points, 1, 2)
    kept = _powered(whole - minus @ np.swapaxes(minus, 1, 2), 0.5)
    return np.asarray((kept @ _powered(whole, -0.5) @ points).transpose(2, 0, 1).reshape(len(plus), -1))


def _powered(covariance: F3, power: float) -> F3:
    """Raise the positive eigenvalues of m symmetric matrices, shape (m, 3, 3), to a power; set the others to zero."""
    value, vector = np.linalg.eigh(covariance)
    positive = value > 1e-12 * np.maximum(value[:, -1:], 1e-300)
    powered = np.where(positive, np.where(positive, value, 1.0) ** power, 0.0)
    return np.asarray((vector * powered[:, None, :]) @ np.swapaxes(vector, 1, 2))


def _predicted(solution: JointSolution, theta: F1) -> F1:
    return np.concatenate([predict(solution.machine, solution.terms, run, solution.setup, theta) for run in solution.data])


def campaign_trials(
    sources: ErrorSources,
    points_mm: F2,
    *,
    tool_mm: F1 | None = None,
    frame: RigidFree | None = None,
    distributions: Mapping[str, Distribution] | None = None,
) -> CampaignTrials:
    """Prepare trials of a solution for a prediction at points, shape (m, 3); tool and frame as in `predict_deviation`.

    ``distributions``: distributions by name of the source, e.g. `LIMITS`, each with unit standard deviation (``u`` 1 for normal and
    rectangular). All other sources are normal. The repeatability of the machine is part of the readings' noise and drawn with it.

    Raises
    ------
    ValueError
        No points, more than `MOST_POINTS`, another shape, or numbers that are not finite.
    """
    if points_mm.ndim != 2 or points_mm.shape[1] != 3 or not len(points_mm) or not np.isfinite(points_mm).all():
        raise ValueError(f"campaign trials: points_mm must be finite numbers of shape (m, 3), got shape {points_mm.shape}")
    if len(points_mm) > MOST_POINTS:
        raise ValueError(
            f"campaign trials: {len(points_mm)} points need too much memory; pass at most {MOST_POINTS} at a time, with the same seed"
        )
    d = unit_deviation(sources.solution.machine, sources.terms, points_mm, tool_mm, frame)
    return CampaignTrials(sources, response(sources.solution), d.reshape(-1, d.shape[2]), distributions or {})
