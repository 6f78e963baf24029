"""Fine structure of a machine's motions in points of artefacts: pitch errors of screws, and errors that change from position to position.

Polynomials are too smooth for it, and an artefact has too few points to sample it. Errors that change from position to position get one
unknown per position of an axis (`abbe.models.solvers.artefact.Fine`); at other positions they count as uncertainty. Periods are searched by
the score of a sine and cosine, on each axis and on all axes together (screws of one lead). Every probable period enters the model with a
size weighted by its probability: features stand at multiples of a pitch, so several periods often explain the readings (aliases). The first
period is searched again once the others are in the model, because an alias may fit best while the others still add to the scatter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.solvers.artefact import PRIORS, SAME_PLACE_MM, Fine
from abbe.models.solvers.components import KINDS
from abbe.models.solvers.engine import CampaignFit, CampaignProblem
from abbe.models.solvers.observations import RunData

Solve = Callable[[tuple[RunData, ...]], tuple[CampaignProblem, CampaignFit]]
NUGGETS, NOISY = 3.0, 1.4
"""Positions get values of their own if the score for these exceeds its expectation by `NUGGETS` standard deviations, or if the scatter of
probed points is `NOISY` times their repeatability."""
PERIODS_MM = (4.0, 60.0)
STEP_PER_MM = 2.5e-4
"""Range of the searched periods, and step of the searched frequencies."""
LEADS_MM = (5.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0, 25.0, 32.0, 40.0)
USUAL, SMOOTH, ALL_AXES = 0.7, 0.3, 0.7
"""Prior probabilities that a period is the lead of a usual screw, that there is no period, and that all axes have the same one."""
LEAST, SURE = 0.05, 0.8
"""A period enters the model from the probability `LEAST` on; another one is searched for only if the last had at least `SURE`."""
LARGEST = 4
"""Number of periods that are searched one after the other."""
POLYNOMIAL = 5
"""Degrees of freedom that a smooth motion takes of the values at the positions of an axis."""


@dataclass(frozen=True)
class Score:
    """Part of the residuals that further unknowns would explain (Rao's score)."""

    weight: F1
    left: F1
    scaled: F2
    covariance: F2
    sigma: F1

    @classmethod
    def of(cls, problem: CampaignProblem, fit: CampaignFit) -> Score:
        """Prepare the score of a fit."""
        kind = problem.readings.kind
        weight = fit.weight * np.exp(-fit.components.eta)[kind] / fit.decimation[kind]
        root = fit.sizes.root * fit.components.half(fit.sizes)
        return cls(weight, fit.residual_mm / problem.sigma, problem.readings.a @ root, fit.posterior.cov, problem.sigma)

    def asked(self, columns: F2) -> tuple[F1, F2]:
        """Derivative of the log evidence by the unknowns of these columns, (k,), and its information, (k, k)."""
        b = columns / self.sigma[:, None]
        weighted = b * self.weight[:, None]
        across = weighted.T @ self.scaled
        return weighted.T @ self.left, b.T @ weighted - across @ self.covariance @ across.T

    def excess(self, columns: F2) -> float:
        """Score for a common variance of the unknowns, in standard deviations."""
        asked, information = self.asked(columns)
        return float((asked @ asked - np.trace(information)) / np.sqrt(2.0 * np.sum(information * information)))

    def gain(self, columns: F2, size: float) -> tuple[float, float]:
        """Sum of squares that unknowns of this prior standard deviation explain, and log ratio of their prior to posterior volume."""
        asked, information = self.asked(columns)
        whole = np.eye(len(asked)) + size**2 * information
        return float(size**2 * asked @ np.linalg.solve(whole, asked)), float(0.5 * np.linalg.slogdet(whole)[1])

    def gain_rescaled(self, columns: F2) -> float:
        """Gain of log evidence by unknowns of size 1 in these columns if the noise is estimated anew."""
        explained, used = self.gain(columns, 1.0)
        total = float(self.weight @ self.left**2)
        return float(_evidence(np.array(explained / max(total, 1e-12) * self.left.size), np.array(float(self.left.size)))) - used


def refined(problem: CampaignProblem, fit: CampaignFit, solve: Solve) -> tuple[CampaignProblem, CampaignFit]:
    """Add fine structure to the solution of a campaign of artefacts where the readings show it."""
    nuggets = _nuggets(problem.runs)
    if not nuggets or not (_noisy(problem, fit) or Score.of(problem, fit).excess(_columns(problem.runs, nuggets)) > NUGGETS):
        return problem, fit
    groups: list[tuple[Fine, ...]] = []
    problem, fit = solve(_with(problem.runs, nuggets))
    for _ in range(LARGEST):
        more, sure = _waves(problem, fit)
        if not more:
            break
        groups.append(more)
        problem, fit = solve(_with(problem.runs, _joined(nuggets, groups)))
        if not sure:
            break
    for i in range(len(groups) - 1):  # found while the later ones were still in the scatter: an alias may have won
        beside = solve(_with(problem.runs, _joined(nuggets, groups[:i] + groups[i + 1 :])))
        groups[i] = _waves(*beside)[0] or groups[i]
    return solve(_with(problem.runs, _joined(nuggets, groups))) if len(groups) > 1 else (problem, fit)


def _joined(nuggets: tuple[Fine, ...], groups: list[tuple[Fine, ...]]) -> tuple[Fine, ...]:
    """Nuggets and all waves, each name once."""
    waves = {w.name: w for group in reversed(groups) for w in group}
    return (*nuggets, *waves.values())


def _noisy(problem: CampaignProblem, fit: CampaignFit) -> bool:
    """Whether probed points scatter more than they repeat; a workpiece scatters by its drilling."""
    probed = any(r.points is not None and r.points.source == "probe" for r in problem.runs)
    return probed and float(np.exp(0.5 * fit.components.eta[KINDS.index("artefact")])) > NOISY


def _with(runs: tuple[RunData, ...], fine: tuple[Fine, ...]) -> tuple[RunData, ...]:
    return tuple(r if r.points is None or r.points.source == "length" else replace(r, points=replace(r.points, fine=fine)) for r in runs)


def _sensed(runs: tuple[RunData, ...]) -> list[tuple[RunData, F2]]:
    """Runs of points with the machine direction that each row reads, (n, 3)."""
    return [(r, r.points.direction) for r in runs if r.points is not None and r.points.source != "length"]


def _nuggets(runs: tuple[RunData, ...]) -> tuple[Fine, ...]:
    """One unknown for every position of an axis at which it was sensed along itself or across."""
    out = []
    for axis in range(3):
        places = np.sort(np.concatenate([r.axes_mm[np.abs(way[:, axis]) > 0.1, axis] for r, way in _sensed(runs)]))
        if places.size and np.ptp(places) > SAME_PLACE_MM:
            groups = np.split(places, np.flatnonzero(np.diff(places) > SAME_PLACE_MM) + 1)
            out += [Fine(axis, axis, float(np.mean(g))) for g in groups]
    return tuple(out)


def _columns(runs: tuple[RunData, ...], fine: tuple[Fine, ...]) -> F2:
    """First-order readings per unit of fine structure, all rows of a campaign."""
    blocks = []
    for r in runs:
        if r.points is None or r.points.source == "length":
            blocks.append(np.zeros((r.deviation_mm.size, len(fine))))
            continue
        way = r.points.direction
        blocks.append(np.stack([way[:, f.component] * f.values(r.axes_mm) for f in fine], axis=1))
    return np.concatenate(blocks)


def _waves(problem: CampaignProblem, fit: CampaignFit) -> tuple[tuple[Fine, ...], bool]:
    """Waves of the probable periods, sized by their probability, and whether one of them is nearly certain."""
    nuggets, score = _nuggets(problem.runs), Score.of(problem, fit)
    axes = sorted({f.axis for f in nuggets})
    frequencies = np.arange(1.0 / PERIODS_MM[1], 1.0 / PERIODS_MM[0], STEP_PER_MM)
    found = np.array([[score.gain(_columns(problem.runs, wave_pair(a, 1.0 / f)), PRIORS.wave_mm) for f in frequencies] for a in axes])
    count = np.array([max(sum(f.axis == a for f in nuggets) - POLYNOMIAL, 4) for a in axes])
    span = max(np.ptp([f.at_mm for f in nuggets if f.axis == a]) for a in axes)
    prior = np.log(_prior(frequencies, float(span)))
    common = prior + _evidence(found[:, :, 0].sum(axis=0), count.sum()) - found[:, :, 1].sum(axis=0) + np.log(ALL_AXES)
    single = prior + _evidence(found[:, :, 0], count[:, None]) - found[:, :, 1] + np.log((1.0 - ALL_AXES) / len(axes))
    sheets = single if len(axes) == 1 else np.vstack([common, single])
    share = np.exp(sheets - np.logaddexp(np.logaddexp.reduce(sheets, axis=None), np.log(SMOOTH)))
    out, best = list[Fine](), 0.0
    for sheet, mine in zip(share, [[a] for a in axes] if len(axes) == 1 else [axes, *([a] for a in axes)], strict=True):
        for at, weight in _peaks(sheet):
            best = max(best, weight)
            out += [replace(w, size_mm=PRIORS.wave_mm * weight**0.5) for a in mine for w in wave_pair(a, _period(frequencies, sheet, at))]
    return tuple(out), best >= SURE


def wave_pair(axis: int, period_mm: float) -> tuple[Fine, Fine]:
    """Cosine and sine of the positioning of an axis."""
    return Fine(axis, axis, period_mm=period_mm, phase=0), Fine(axis, axis, period_mm=period_mm, phase=1)


def _evidence(explained: F1, count: F1) -> F1:
    """Gain of log evidence if the size of the residuals is estimated again, for so many degrees of freedom."""
    return np.asarray(-0.5 * count * np.log(np.maximum(1.0 - explained / count, 0.02)))


def _prior(frequencies: F1, span_mm: float) -> F1:
    """Prior probability of every searched frequency: a usual lead, within the resolution of the positions, or any."""
    near = np.abs(frequencies[:, None] - 1.0 / np.array(LEADS_MM)) < 0.5 / span_mm
    usual = (near / np.maximum(near.sum(axis=0), 1)).sum(axis=1) / len(LEADS_MM)
    return np.asarray((1.0 - SMOOTH) * (USUAL * usual + (1.0 - USUAL) / frequencies.size))


def _peaks(share: F1) -> list[tuple[int, float]]:
    """Local maxima of a probability and the probability about each of them, from `LEAST` on."""
    high = np.concatenate([[0.0], share, [0.0]])
    tops = np.flatnonzero((share >= high[:-2]) & (share > high[2:]))
    if not tops.size:
        return []
    nearest = np.argmin(np.abs(np.arange(share.size)[:, None] - tops), axis=1)
    weights = [(int(t), float(share[nearest == i].sum())) for i, t in enumerate(tops)]
    return [(t, w) for t, w in weights if w >= LEAST]


def _period(frequencies: F1, share: F1, at: int) -> float:
    """Period at a peak: the mean frequency of its neighbours, weighted by probability."""
    near = slice(max(at - 2, 0), at + 3)
    return float(1.0 / np.average(frequencies[near], weights=share[near]))
