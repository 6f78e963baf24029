"""Fine structure of a machine's motions in points of artefacts: pitch errors of screws, and errors that change from position to position.

Polynomials are too smooth for fine structure, and an artefact has too few points to sample it. Errors that change from position to position
get one unknown per position of an axis (`abbe.models.solvers.artefact.Fine`); at other positions they add to the uncertainty. Periods are
searched in the displacements at these positions (`abbe.models.solvers.waves`). Every probable period enters the model with a size weighted
by its probability: features stand at multiples of a pitch, so several periods often explain the readings (aliases).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F2
from abbe.models.solvers.artefact import SAME_PLACE_MM, Fine
from abbe.models.solvers.components import KINDS
from abbe.models.solvers.engine import CampaignFit, CampaignProblem, Score
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.waves import Displacements, Peak, peaks

Solve = Callable[[tuple[RunData, ...]], tuple[CampaignProblem, CampaignFit]]
NUGGETS, NOISY = 3.0, 1.4
"""Each position gets its own value if the score for such values exceeds its expectation by `NUGGETS` standard deviations, or if the scatter
of probed points is `NOISY` times their repeatability."""
SURE, ROUNDS = 0.8, 3
"""After a period of at least the probability `SURE`, further ones are searched for, in at most `ROUNDS` searches."""


def refined(problem: CampaignProblem, fit: CampaignFit, solve: Solve) -> tuple[CampaignProblem, CampaignFit]:
    """Add fine structure to the solution of a campaign of artefacts where the readings show it."""
    nuggets = _nuggets(problem.runs)
    if not nuggets or not (_noisy(problem, fit) or Score.of(problem, fit).excess(_columns(problem.runs, nuggets)) > NUGGETS):
        return problem, fit
    found, (problem, fit) = list[tuple[Fine, ...]](), solve(_with(problem.runs, nuggets))
    for _ in range(ROUNDS):
        probable = peaks(Displacements.of(problem, fit, nuggets))
        if not probable:
            break
        found.append(_waves(probable))
        problem, fit = solve(_with(problem.runs, _joined(nuggets, found)))
        if max(p.weight for p in probable) < SURE:
            break
    return problem, fit


def _joined(nuggets: tuple[Fine, ...], groups: list[tuple[Fine, ...]]) -> tuple[Fine, ...]:
    """Nuggets and all waves, each name once."""
    waves = {w.name: w for group in reversed(groups) for w in group}
    return (*nuggets, *waves.values())


def _noisy(problem: CampaignProblem, fit: CampaignFit) -> bool:
    """Whether probed points scatter more than their repeatability. Drilling adds scatter to a workpiece, which always counts as noisy."""
    sources = {r.points.source for r in problem.runs if r.points is not None}
    return "cmm" in sources or ("probe" in sources and float(np.exp(0.5 * fit.components.eta[KINDS.index("artefact")])) > NOISY)


def _with(runs: tuple[RunData, ...], fine: tuple[Fine, ...]) -> tuple[RunData, ...]:
    return tuple(r if r.points is None or r.points.source == "length" else replace(r, points=replace(r.points, fine=fine)) for r in runs)


def _sensed(runs: tuple[RunData, ...]) -> list[tuple[RunData, F2]]:
    """Runs of points with the machine direction that each row reads, (n, 3)."""
    return [(r, r.points.direction) for r in runs if r.points is not None and r.points.source != "length"]


def _nuggets(runs: tuple[RunData, ...]) -> tuple[Fine, ...]:
    """One unknown for every position of an axis at which a row reads this axis' own direction."""
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


def _waves(peaks: tuple[Peak, ...]) -> tuple[Fine, ...]:
    """Waves of probable periods, sized by their probability: cosine and sine of the positioning of each axis.

    Two waves, at the ends of the standard uncertainty of a period, stand for each period, so that the solution can shift it.
    """
    return tuple(
        Fine(a, a, period_mm=1.0 / frequency, phase=phase, found_mm=1.0 / p.frequency, probability=p.weight)
        for p in peaks
        for frequency in (p.frequency - p.u_frequency, p.frequency + p.u_frequency)
        for a in p.axes
        for phase in (0, 1)
    )


def sure_periods(fine: tuple[Fine, ...]) -> tuple[tuple[int, float], ...]:
    """Axes and periods, mm, without a rival explanation: periods of at least the probability `SURE`, each only once."""
    return tuple(dict.fromkeys((one.axis, one.found_mm) for one in fine if one.period_mm and one.probability >= SURE))
