"""Where simulation and measurement disagree, and which effect is missing: the whole search over one campaign (discovery.md 4)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidates import Pick
from abbe.models.discovery.case import Case
from abbe.models.discovery.finding import finding
from abbe.models.discovery.prediction import predictions, solve
from abbe.models.discovery.rivals import Rival, rivals_of
from abbe.models.discovery.scatter import scattered, without
from abbe.models.discovery.selection import Contest, Found, dropped, selected, weighed
from abbe.models.discovery.variance.scatter_effects import VarianceFinding
from abbe.models.discovery.whitened_problem import Scene, linearised, quieted, scene_of
from abbe.models.effects.effect import Effect

Progress = Callable[[str, float], None]
Search = tuple[Scene, Contest, list[Found], tuple[VarianceFinding, ...]]
CLEAR = 1.0
"""A rival takes a name's place when it explains more by this chi-square: as much as a new name has to beat one that is there."""
ROUNDS = 3
"""The search is repeated with the noise and the simulation that its findings leave, at most this often."""


def discover(case: Case, effects: tuple[Effect, ...], *, progress: Progress | None = None) -> Discovery:
    """Find what the present simulation of a campaign misses.

    Parameters
    ----------
    case : Case
        Identify runs are fitted, holdout runs judge, sealed runs are predicted.
    effects : tuple of Effect
        Names to choose from.
    progress : function (what is being done, share that is done), optional

    Returns
    -------
    Discovery
        Deterministic; the order of the runs does not matter.
    """
    tell = progress or (lambda text, share: None)
    tell("fitting the present simulation", 0.0)
    plain = scene_of(case, baseline_of(case))
    before = predictions(plain, solve(plain, ()))
    tell("comparing effects", 0.2)
    scene, contest, found, loud = searched(plain, effects, tell)
    found, rivals = fairly(contest, found)
    tell("predicting", 0.9)
    picks = [f.pick for f in found]
    solved = solve(scene, picks)
    after = predictions(scene, solved) if picks else before
    tell("what else it could be", 0.95)
    return finding(scene, plain, found, loud, solved, rivals, (before, after))


def searched(scene: Scene, effects: tuple[Effect, ...], tell: Progress) -> Search:
    """Mean, then scatter, then again with the noise and the exact simulation that the findings leave, until they stay the same."""
    contest = Contest.of(scene, effects)
    found, loud = selected(contest), tuple[VarianceFinding, ...]()
    for i in range(ROUNDS):
        tell("comparing again what is left", 0.5 + 0.15 * i)
        labels = {f.pick.label for f in found} | {f.label for f in loud}
        named = [f.pick for f in found if not f.pick.unnamed]
        loud = _merged(loud, scattered(scene, named))
        if not found and not loud:
            break
        scene = without(settled(scene, [f.pick for f in found]), loud) if i == 0 or labels != _labels(found, loud) else scene
        contest = Contest.of(scene, effects)
        found = selected(contest, named)
        if _labels(found, loud) == labels:
            break
    return scene, contest, sorted(found, key=lambda f: -f.score), loud


def fairly(contest: Contest, found: list[Found]) -> tuple[list[Found], list[list[Rival]]]:
    """The names with their rivals; a rival that explains more once both have their freedoms of form takes the name's place.

    The search compares names before their forms, so that a bent effect may have let the wrong one of two near kin in.
    """
    changed = False
    for i in range(len(found)):
        rivals = _rivals(contest, found, i)
        if rivals and rivals[0].less < -CLEAR:
            picks = [f.pick for f in found]
            picks[i] = rivals[0].pick
            found, changed = weighed(contest, picks), True
    if changed:
        found = sorted(weighed(contest, dropped(contest, [f.pick for f in found])), key=lambda f: -f.score)
    return found, [_rivals(contest, found, i) for i in range(len(found))]


def _rivals(contest: Contest, found: list[Found], i: int) -> list[Rival]:
    """Of one name; none of a structure without a name."""
    return [] if found[i].pick.unnamed else rivals_of(contest, found, i)


def _labels(found: list[Found], loud: tuple[VarianceFinding, ...]) -> set[str]:
    return {f.pick.label for f in found} | {f.label for f in loud}


def _merged(old: tuple[VarianceFinding, ...], new: tuple[VarianceFinding, ...]) -> tuple[VarianceFinding, ...]:
    """What was found stays, with what is found besides."""
    known = {f.label for f in old}
    return (*old, *(f for f in new if f.label not in known))


def settled(scene: Scene, picks: list[Pick]) -> Scene:
    """The scene linearised about the simulation that fits together with the picks, with the noise that they leave."""
    if not picks:
        return quieted(scene, ())
    raw = [p.raw(scene) for p in picks]
    sd = [p.prior_sd(scene, r.shape[1]) for p, r in zip(picks, raw, strict=True)]
    scene = linearised(scene, np.concatenate(raw, axis=1), np.concatenate(sd))
    return quieted(scene, [(p.raw(scene), s) for p, s in zip(picks, sd, strict=True)])
