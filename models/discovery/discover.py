"""The complete search over one campaign: where simulation and measurement disagree and which effect is missing.

Variance effects are found in the residuals of the mean model and then excluded from the search for mean effects.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.case import Case
from abbe.models.discovery.finding import doubted, finding
from abbe.models.discovery.lack import CHANCE
from abbe.models.discovery.mixed_up import mixed_up, wrong_tool
from abbe.models.discovery.selection import Contest, Rival, Selection, dropped, rivals_of, selected, weighed
from abbe.models.discovery.solved_model import predictions, solve
from abbe.models.discovery.variance.rounds import scattered, without
from abbe.models.discovery.variance.scatter_effects import VarianceFinding
from abbe.models.discovery.whitened_problem import WhitenedProblem, linearised, whiten, with_estimated_noise
from abbe.models.effects.effect import Effect

ShareSink = Callable[[str, float], None]
Search = tuple[WhitenedProblem, Contest, list[Selection], tuple[VarianceFinding, ...]]
CLEAR = 1.0
"""A rival replaces a named effect if its chi-square is lower by at least this; a new name needs the same margin."""
ROUNDS = 3
"""Maximum number of repetitions of the search, each with noise and simulation refitted together with the findings."""


def discover(case: Case, effects: tuple[Effect, ...], *, progress: ShareSink | None = None) -> Discovery:
    """Find the effects that the present simulation of a campaign lacks.

    Parameters
    ----------
    case : Case
        Its identify runs are fitted, its holdout runs judge the result, its sealed runs are predicted.
    effects : tuple of Effect
        Effects to choose from.
    progress : function (text, share of the work done from 0 to 1), optional

    Returns
    -------
    Discovery
        Deterministic; the order of the runs does not matter.
    """
    tell = progress or (lambda text, share: None)
    tell("fitting the present simulation", 0.0)
    plain = whiten(case, baseline_of(case))
    empty = solve(plain, ())
    before = predictions(plain, empty)
    mixed = mixed_up(plain) or wrong_tool(plain)
    if mixed is not None:
        return doubted(finding(plain, plain, (), (), empty, (), (before, before)), mixed)
    tell("comparing effects", 0.2)
    problem, contest, found, loud = searched(plain, effects, tell)
    found, rivals = fairly(contest, found)
    tell("predicting", 0.9)
    picks = [f.pick for f in found]
    solved = solve(problem, picks)
    after = predictions(problem, solved) if picks else before
    tell("what else it could be", 0.95)
    named = finding(problem, plain, found, loud, solved, rivals, (before, after))
    if named.verdict != "named" or named.p_value < CHANCE:
        return named
    return replace(named, alone=finding(plain, plain, (), (), empty, (), (before, before)))


def searched(problem: WhitenedProblem, effects: tuple[Effect, ...], tell: ShareSink) -> Search:
    """Search for mean and variance effects and refit noise and simulation, up to `ROUNDS` times, until the findings stay the same."""
    contest = Contest.of(problem, effects)
    found, loud, start = selected(contest), tuple[VarianceFinding, ...](), list[Pick]()
    for i in range(ROUNDS):
        tell("comparing again what is left", 0.5 + 0.15 * i)
        labels = {f.pick.label for f in found} | {f.label for f in loud}
        named = [f.pick for f in found if not f.pick.unnamed]
        loud, known = _merged(loud, scattered(problem, named, loud)), len(loud)
        if renewed := i == 0 or labels != _labels(found, loud):
            contest.banks.clear()  # they would take as much memory as those of the new problem
            problem = without(settled(problem, [f.pick for f in found]), loud[known:])
        if not found and not loud and not any(c.gain for c in problem.colours.values()):
            break
        if not renewed and [p.start for p in named] == [p.start for p in start]:
            break  # the search would only repeat itself
        again = Contest.of(problem, effects)
        again.banks.extend(contest.banks[1:])
        contest, start = again, named
        found = selected(contest, start)
        if _labels(found, loud) == labels:
            break
    return problem, contest, sorted(found, key=lambda f: -f.score), loud


def fairly(contest: Contest, found: list[Selection]) -> tuple[list[Selection], list[list[Rival]]]:
    """Replace each named effect by a rival if the rival explains the readings better; return the findings with their rivals.

    The search compares effects in their textbook form, so it may have chosen the wrong one of two similar effects. Here effect and rival
    may deviate from the textbook form (`Form`).
    """
    changed = False
    for i in range(len(found)):
        rivals = _rivals(contest, found, i)
        if rivals and rivals[0].deficit < -CLEAR:
            picks = [f.pick for f in found]
            picks[i] = rivals[0].pick
            found, changed = weighed(contest, picks), True
    if changed:
        found = sorted(weighed(contest, dropped(contest, [f.pick for f in found])), key=lambda f: -f.score)
    return found, [_rivals(contest, found, i) for i in range(len(found))]


def _rivals(contest: Contest, found: list[Selection], i: int) -> list[Rival]:
    """Rivals of one finding; a structure without a name has none."""
    return [] if found[i].pick.unnamed else rivals_of(contest, found, i)


def _labels(found: list[Selection], loud: tuple[VarianceFinding, ...]) -> set[str]:
    return {f.pick.label for f in found} | {f.label for f in loud}


def _merged(old: tuple[VarianceFinding, ...], new: tuple[VarianceFinding, ...]) -> tuple[VarianceFinding, ...]:
    """Return the old findings, then the new findings whose labels are not among the old ones."""
    known = {f.label for f in old}
    return (*old, *(f for f in new if f.label not in known))


def settled(problem: WhitenedProblem, picks: list[Pick]) -> WhitenedProblem:
    """Fit simulation and chosen effects (``picks``) together, linearise the problem there, and estimate the noise from the residuals."""
    if not picks:
        return with_estimated_noise(problem, (), memory=True)
    raw = [p.raw(problem) for p in picks]
    sd = [p.prior_sd(problem, r.shape[1]) for p, r in zip(picks, raw, strict=True)]
    problem = linearised(problem, np.concatenate(raw, axis=1), np.concatenate(sd))
    return with_estimated_noise(problem, [(p.raw(problem), s) for p, s in zip(picks, sd, strict=True)], memory=True)
