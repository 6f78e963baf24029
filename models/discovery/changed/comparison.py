"""Changes of a machine since a solution: which error motions, by how much, judged by runs that did not choose them.

A known machine that drifts lacks no physical effect: its model is complete, its numbers are old. So the old solution, with its covariance,
is compared with new runs, and error motions compete for the residuals: six linear ones (scales, squareness) and the shape of each of the
21. Selection is stepwise by the marginal likelihood of a linear normal model (as `abbe.models.solvers.components`) less the price, the
logarithm of the number of candidates. For validation, one half of the set-ups chooses and the other judges, both ways round. Set-ups and
lost motion are refitted throughout: a new cup is no change of the machine.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.discovery.changed.search import ChangeContext, Chosen
from abbe.models.solvers.engine import CampaignProblem, build, expected_noise, settle
from abbe.models.solvers.information import InformationSums, total
from abbe.models.solvers.observations import RunData
from abbe.models.solvers.priors import Priors
from abbe.models.uncertainty.known_field import KnownField

FEWEST_SETUPS = 2
"""Least set-ups of each half for cross-validation."""


@dataclass(frozen=True)
class Change:
    """A changed error motion.

    Attributes
    ----------
    name : str
        ``"EXX"`` ... ``"A0Z"`` for a scale or squareness, ``"EYX shape"`` for what is not linear in it (of an angle: all of it).
    value, u : float
        Change and standard uncertainty, all scales and squareness free beside it: rad (m/m) of a linear one; of a shape its rms over the
        stroke, mm or rad. ``u`` includes the old solution's uncertainty.
    evidence : float
        Gain in log evidence after its price, beside all other named changes.
    rivals : tuple of (name, evidence less)
        Candidates that explain nearly as much in its place: these runs cannot distinguish them.
    halves : int
        Number of halves of the runs that chose it independently: 0 to 2.
    """

    name: str
    value: float
    u: float
    evidence: float
    rivals: tuple[tuple[str, float], ...]
    halves: int


@dataclass(frozen=True)
class Changed:
    """All changes found.

    ``before_mm``: rms of readings minus the old solution. ``after_mm``: minus the changes, too, that the OTHER half of the set-ups chose.
    ``floor_mm``: rms noise. ``judged``: log likelihood ratio of each half for the other's choice, the smaller of the two. None: too few
    set-ups to judge. ``hidden``: bound on the change of each scale and squareness that was not named, rad, without those that these runs
    do not see.
    """

    changes: tuple[Change, ...]
    before_mm: float | None
    after_mm: float | None
    floor_mm: float
    judged: float | None
    hidden: dict[str, float]


def changed_since(known: KnownField, runs: tuple[RunData, ...]) -> Changed:
    """Name what has changed in a machine since it was solved.

    Parameters
    ----------
    known : KnownField
        The old solution, with its covariance.
    runs : tuple of RunData
        Runs measured since, corrected for the active table and known effects like the solved runs.

    Raises
    ------
    ValueError
        No runs, or one that cannot be used (named).
    """
    if not runs:
        raise ValueError("changes: no runs")
    problem = build(known.machine, known.terms, runs, Priors(), expected_noise(runs, None, None))
    fit = settle(problem, _silent)
    context = ChangeContext(known, problem, fit)
    whole = context.choose(total(fit.parts))
    by_half = [context.choose(total(half)) for half in _halves(fit.parts, problem)]
    before, after, judged = context.judged(by_half) if by_half else (None, None, None)
    return Changed(_changes(context, whole, by_half), before, after, context.floor_mm(), judged, context.hidden(whole))


def _silent(_: str) -> None:
    return None


def _halves(parts: tuple[InformationSums, ...], problem: CampaignProblem) -> list[tuple[InformationSums, ...]]:
    """Folds (whole set-ups) with even and with odd numbers; none where one half would have too few set-ups."""
    folds = problem.readings.fold
    setups = [{problem.runs[k].setup for k in np.unique(problem.readings.run[folds % 2 == odd])} for odd in (0, 1)]
    if min(len(s) for s in setups) < FEWEST_SETUPS:
        return []
    return [parts[odd::2] for odd in (0, 1)]


def _changes(context: ChangeContext, whole: Chosen, by_half: list[Chosen]) -> tuple[Change, ...]:
    """All that were chosen by all runs, the largest evidence first."""
    out = []
    for taken in whole.taken:
        value, u = context.size(whole, taken.asked)
        halves = sum(taken.asked.name in {t.asked.name for t in half.taken} for half in by_half)
        out.append(Change(taken.asked.name, value, u, taken.gain, taken.rivals, halves))
    return tuple(sorted(out, key=lambda c: -c.evidence))
