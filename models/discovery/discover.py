"""Where simulation and measurement disagree, and which effect is missing: the whole search over one campaign (discovery.md 4)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Discovery
from abbe.models.discovery.baseline import baseline_of
from abbe.models.discovery.candidates import Pick
from abbe.models.discovery.case import Case
from abbe.models.discovery.finding import finding
from abbe.models.discovery.noise import unscaled
from abbe.models.discovery.prediction import predictions, solve
from abbe.models.discovery.rivals import Rival, rivals_of
from abbe.models.discovery.selection import Contest, Selection, dropped, selected, weighed
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, extra_variance
from abbe.models.discovery.whitened_problem import Tangent, WhitenedProblem, linearised, quieted, scene_of, taken_out
from abbe.models.effects.effect import Effect

# Effects of the scatter beside those of the mean: found in what the mean leaves, then kept away from the search for the mean.


GATE = 1.3
"""Readings at less than this times the speed at which an axis sticks do not count for the mean."""
MOST_GATED = 0.35
"""... unless they are more than this share of all readings."""


def scattered(scene: WhitenedProblem, picks: Sequence[Pick]) -> tuple[VarianceFinding, ...]:
    """What the scatter of the readings shows once simulation and ``picks`` are taken out; lone readings of lasers are in it again."""
    solved = solve(scene, picks)
    model = scene.tangent.raw @ (solved.theta - scene.theta)
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        model = model + pick.raw(scene) @ c
    valid = np.concatenate([r.valid.astype(float) for r in scene.runs])
    left = (scene.gap - model) * valid
    white = unscaled(left[:, None], scene.lengths, scene.kinds, scene.colours)[:, 0] / scene.sd_mm()
    sigma = tuple(scene.colours[k].sd_mm for k in scene.kinds)
    leverage = tuple(scene.by_run(scene.space.leverage))
    return extra_variance(scene.paths, tuple(scene.by_run(white * valid)), sigma, leverage=leverage, colours=scene.colours)


def without(scene: WhitenedProblem, findings: Sequence[VarianceFinding]) -> WhitenedProblem:
    """The scene whose mean is free of the findings: a vibration's waves are taken out run by run, loud readings do not count."""
    waves, use = [scene.also], scene.use
    for f in findings:
        if f.name == "vibration":
            waves.append(_waves(scene, "XYZ".index(f.key), f.parameters["frequency_hz"]))
        elif f.name == "stick_slip":
            loud = _slow(scene, "XYZ".index(f.key), f.parameters["v_c"])
            use = use * (1.0 - loud) if loud.mean() < MOST_GATED else use
        elif f.name == "unnamed_burst":
            use = use * (1.0 - _moment(scene, f.parameters["t0_s"], f.parameters["width_s"]))
    scene = replace(scene, also=np.concatenate(waves, axis=1))
    if (use != scene.use).any():
        tangent = Tangent.of(scene.tangent.raw, use, scene.lengths, scene.kinds, scene.colours)
        scene = replace(scene, use=use, tangent=tangent)
    return taken_out(scene)


def _waves(scene: WhitenedProblem, axis: int, frequency_hz: float) -> F2:
    """Sine and cosine of unknown size and phase in every ball-bar run, mm."""
    out = np.zeros((scene.gap.size, 2 * sum(k == "bar" for k in scene.kinds)))
    start = column = 0
    for path in scene.paths:
        if path.kind == "bar":
            phase = 2.0 * np.pi * frequency_hz * (path.at.t_s - path.at.t_s[0])
            out[start : start + path.n, column : column + 2] = path.look[:, axis, None] * np.stack([np.sin(phase), np.cos(phase)], axis=1)
            column += 2
        start += path.n
    return out


def _slow(scene: WhitenedProblem, axis: int, v_mm_s: float) -> F1:
    return np.concatenate([(np.abs(p.at.v_mm_s[:, axis]) < GATE * v_mm_s) * float(p.kind == "bar") for p in scene.paths])


def _moment(scene: WhitenedProblem, t0_s: float, width_s: float) -> F1:
    return np.concatenate([(np.abs(p.at.t_s - t0_s) < 1.5 * width_s) * float(p.kind == "bar") for p in scene.paths])


Progress = Callable[[str, float], None]
Search = tuple[WhitenedProblem, Contest, list[Selection], tuple[VarianceFinding, ...]]
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


def searched(scene: WhitenedProblem, effects: tuple[Effect, ...], tell: Progress) -> Search:
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


def fairly(contest: Contest, found: list[Selection]) -> tuple[list[Selection], list[list[Rival]]]:
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


def _rivals(contest: Contest, found: list[Selection], i: int) -> list[Rival]:
    """Of one name; none of a structure without a name."""
    return [] if found[i].pick.unnamed else rivals_of(contest, found, i)


def _labels(found: list[Selection], loud: tuple[VarianceFinding, ...]) -> set[str]:
    return {f.pick.label for f in found} | {f.label for f in loud}


def _merged(old: tuple[VarianceFinding, ...], new: tuple[VarianceFinding, ...]) -> tuple[VarianceFinding, ...]:
    """What was found stays, with what is found besides."""
    known = {f.label for f in old}
    return (*old, *(f for f in new if f.label not in known))


def settled(scene: WhitenedProblem, picks: list[Pick]) -> WhitenedProblem:
    """The scene linearised about the simulation that fits together with the picks, with the noise that they leave."""
    if not picks:
        return quieted(scene, ())
    raw = [p.raw(scene) for p in picks]
    sd = [p.prior_sd(scene, r.shape[1]) for p, r in zip(picks, raw, strict=True)]
    scene = linearised(scene, np.concatenate(raw, axis=1), np.concatenate(sd))
    return quieted(scene, [(p.raw(scene), s) for p, s in zip(picks, sd, strict=True)])
