"""Names that are only residues: deviations of a stronger effect from its formula, or names that explain nothing without such a residue."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from itertools import permutations
from types import MappingProxyType

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import NamedEffect
from abbe.models.discovery.candidate_bank import Pick, gain_of, taken
from abbe.models.discovery.selection import Selection
from abbe.models.discovery.solved_model import SolvedModel
from abbe.models.discovery.variance.scatter_effects import VarianceFinding, teeth_mm2
from abbe.models.discovery.variance.spectrum import roughness_of
from abbe.models.discovery.whitened_problem import WhitenedProblem

RESIDUE_SHARE = 0.001
"""A name with less than this share of the largest evidence cannot be distinguished from a residue of the strongest effect."""
SCATTER_SHARE, SMOOTH_SHARE, SCATTER = 0.01, 0.003, ("stick_slip", "vibration", "bar_outliers")
"""Stick-slip, vibration and outliers of the bar count as residues of the strongest mean effect, on any axis, if they have less than a share
of that effect's evidence: 1 % if it has corners or waves (`ROUGH`), 0.3 % if it is smooth, because smooth residues look less like scatter.
A true stick-slip had 1.0 % of a pitch error's evidence.
"""
AXIS_SHARE = 0.0125
AT_TURNS = ("backlash", "backlash_begun", "backlash_position_dependent", "reversal_spike", "lateral_play", "servo_mismatch")
"""Effects at the reversals of one axis differ only in form: an effect with less than `AXIS_SHARE` of the evidence of another such effect
is a residue of the other, because a form that deviates by a ninth leaves 1.2 % of the evidence.

The share was chosen on 52 cases (own ones from 410001, and practice) and 17 own cases with two effects (from 720001). There the largest
residues had 1.0 % and 0.9 %, and two small effects were true: a spike with 1.5 %, and a spike with 0.6 % that was found with three times
its height. The second one loses its name.
"""
ROUGH = (*AT_TURNS, "cyclic_error")
"""Effects with corners or waves."""
KIN_SHARE = 0.04
CLOCK = ("bar_thermal", "axis_thermal_growth", "spindle_thermal_drift", "squareness_thermal")
LAG = ("contour_lag", "servo_mismatch")
SHAPE = ("straightness", "angular_error", "positioning_nonlinear", "nonrigid_bed", "ram_sag")
LASER_SCALE = ("laser_cosine", "air_refraction")
"""Groups of related effects: thermal courses, lags of drives, curves over the position, scales of the laser. If an effect deviates from
its formula by a fifth (4 % of its evidence), the deviation resembles another effect of the group. In 345 cases (150 others for lags) eleven
false names had 0.2 to 3.1 % of the evidence of the strong effect; two true names had 9 %. Of the scales of the laser only the first may be
a residue of the second: a misaligned beam has a size of its own in every set-up and leaves nothing that changes in time, as air does."""
ROUGHEST = 4.0
"""A mean effect leaves at most this many times its own roughness (squared second differences) at the places of a stick-slip. That much
remains if half of a wave is left at twice its frequency, or if corners are missed by twice their height. In 17 own cases with two effects
(seeds 720001 to 720120) the scatter of the true stick-slips was at least 6.7 times as rough as the strong effect of another axis.
"""
CALM = 0.05
"""Readings with less than this share of the largest variance of a stick-slip lie outside of its places."""
CLEARLY_WEAKER = 0.5
"""An effect can be a residue of another only if its own evidence is at most this share of the other's own evidence. Above this share, the
evidence that both explain does not show which of them is the deviation (`ties`). In the one tuned case that was decided so, the residue had
2.9 nats and the other 68.9.
"""
COMPANION_SHARE, COMPANION_OVERLAP = 0.005, 0.6
"""A name is a residue of another if its evidence is below `COMPANION_SHARE` of the other's and their signals overlap by more than
`COMPANION_OVERLAP`."""


def shared(problem: WhitenedProblem, found: Sequence[Selection]) -> dict[tuple[str, str], float]:
    """Return the evidence of a finding, in nats, with one other finding taken out of the fit, by (label, label of the other).

    Of two findings that resemble each other, each has little evidence beside the other: a part belongs to both.
    """
    out = {}
    for other in found:
        rest = [f for f in found if f is not other]
        for f in rest:
            gain = gain_of(problem, f.pick, taken(problem, [g.pick for g in rest if g is not f]))
            out[f.pick.label, other.pick.label] = 0.5 * (gain - (f.gain - f.score))
    return out


def too_smooth(problem: WhitenedProblem, solved: SolvedModel, loud: Sequence[VarianceFinding], rest: F1) -> frozenset[tuple[str, str]]:
    """Find the mean effects of other axes that are too smooth to leave the scatter of a stick-slip: pairs (stick-slip, mean effect).

    Roughness is the mean of squared second differences, weighted with the variance of the stick-slip. An effect is too smooth if the
    roughness of the residuals, less their roughness at bar readings without stick-slip, exceeds `ROUGHEST` times the roughness of the
    effect's own signal.

    Parameters
    ----------
    loud : effects found in the variance.
    rest : array, shape (n,): whitened residuals, also of readings that are left out (`abbe.models.discovery.solved_model.whole_rest`).
    """
    sticking = [f for f in loud if f.name == "stick_slip"]
    if not sticking:
        return frozenset()
    signals = [problem.white_all(p.raw(problem) @ c[:, None])[:, 0] for p, c in zip(solved.picks, solved.coefficients, strict=True)]
    left, *own = (np.concatenate([*map(roughness_of, problem.by_run(x))]) for x in (rest * problem.lone(rest * problem.sd_mm()), *signals))
    out = set[tuple[str, str]]()
    for f in sticking:
        teeth = teeth_mm2(problem.paths, f) * (rest != 0.0)
        calm = (teeth < CALM * teeth.max()) & (rest != 0.0) & np.repeat([k == "bar" for k in problem.kinds], problem.lengths)
        excess = float(np.average(left, weights=teeth) - np.mean(left[calm])) if calm.any() and teeth.any() else 0.0
        rough = (float(np.average(r, weights=teeth)) if teeth.any() else np.inf for r in own)
        out |= {(f.label, p.label) for p, r in zip(solved.picks, rough, strict=True) if not _moves(p, f.key) and excess > ROUGHEST * r}
    return frozenset(out)


def _moves(pick: Pick, axis: str) -> bool:
    """Whether an effect may stem from the motion of an axis: its key ends with the axis, or it is one of the drives without a key."""
    return pick.key[-1:] == axis or (not pick.key and pick.effect.family == "drive")


def residues(
    effects: Sequence[NamedEffect],
    scatter: frozenset[str],
    without: Mapping[tuple[str, str], float] = MappingProxyType({}),
    smooth: Set[tuple[str, str]] = frozenset(),
) -> Mapping[str, str]:
    """Find named effects that may be mere residues: deviations of a stronger effect from its formula.

    An effect is a residue of a stronger effect if its evidence is below this share of the stronger effect's evidence:

    - 1.25 % if both act at the reversals of the same axis (lost motion, its change along the axis, spikes, lateral play, servo mismatch);
    - 4 % if both are related: two thermal effects (bar included), two lags of the drives, two curves over the same axis or in the same
      direction, nonlinear positioning and thermal growth of the same axis, or a misaligned beam beside refraction of air;
    - if the weaker effect is stick-slip, vibration or outliers of the bar, and the stronger one changes the mean: 1 % beside effects at
      reversals and cyclic errors, 0.3 % beside others;
    - 1 % for outliers of a laser beside a wave with harmonics;
    - 0.1 % for any other two effects.

    Parameters
    ----------
    effects : all named effects. scatter : labels of those found in the variance.
    without : evidence of one effect with the other taken out (`shared`). It is used if it is larger: the part that both explain belongs to
        the stronger one. If neither is clearly the stronger one (`CLEARLY_WEAKER`), none is a residue (`ties`).
    smooth : pairs (effect, stronger effect) in which the stronger one cannot leave the other as a residue (`too_smooth`).

    Returns
    -------
    dict
        Reason as text, by label.
    """
    out: dict[str, str] = {}
    for small in effects:
        for big in sorted(effects, key=lambda e: -e.evidence):
            if (small.label, big.label) in smooth:
                continue
            share, whole = _share(small, big, big.label in scatter), max(big.evidence, without.get((big.label, small.label), 0.0))
            if small.evidence <= CLEARLY_WEAKER * big.evidence and small.evidence < share * whole:
                share_text = f"evidence {small.evidence:.0f}, only {small.evidence / whole:.1%} of the evidence of {big.label}"
                out[small.label] = f"{share_text}: the effect may be only the deviation of {big.label} from its formula"
                break
    return out


def ties(effects: Sequence[NamedEffect], scatter: frozenset[str], without: Mapping[tuple[str, str], float]) -> frozenset[tuple[str, str]]:
    """Find pairs of effects in which one may be the residue of the other, but the readings do not show which one.

    Their shared evidence is large enough for a residue (`residues`), but neither effect is clearly weaker than the other. Each pair of
    labels is given in both orders. For the parameters see `residues`.
    """
    out = set[tuple[str, str]]()
    for small, big in permutations(effects, 2):
        least = _share(small, big, big.label in scatter) * without.get((big.label, small.label), 0.0)
        if CLEARLY_WEAKER * big.evidence < small.evidence <= big.evidence and small.evidence < least:
            out |= {(small.label, big.label), (big.label, small.label)}
    return frozenset(out)


def _share(small: NamedEffect, big: NamedEffect, big_is_scatter: bool) -> float:
    """Return the share of the evidence of ``big`` below which ``small`` is its residue (`residues`)."""
    if small.name in AT_TURNS and big.name in AT_TURNS and small.key[-1:] == big.key[-1:]:
        return AXIS_SHARE
    if small.name == "beam_outliers" and any(form.startswith("harmonics") for form in big.forms):
        return SCATTER_SHARE  # readings beside the jumps of a saw-tooth
    grown = small.name == "positioning_nonlinear" and big.name == "axis_thermal_growth" and small.key == big.key
    clock = small.name in CLOCK and big.name in CLOCK
    lag = small.name in LAG and big.name in LAG and small.name != big.name
    scale = (small.name, big.name) == LASER_SCALE
    if grown or clock or lag or scale or (small.name in SHAPE and big.name in SHAPE and _together(small.key, big.key)):
        return KIN_SHARE
    if small.name in SCATTER and not big_is_scatter:
        return SCATTER_SHARE if big.name in ROUGH else SMOOTH_SHARE
    return RESIDUE_SHARE


def _together(a: str, b: str) -> bool:
    """Whether two keys (EYX or X) share the moving axis or the deviating direction; an empty key (ram sag) shares with all."""
    if not a or not b or a[-1] == b[-1]:
        return True
    directions = [key[1] for key in (a, b) if len(key) == 3 and key[1] in "XYZ"]
    return len(directions) == 2 and directions[0] == directions[1]


def leaning(problem: WhitenedProblem, found: Sequence[Selection], residue: Set[str]) -> dict[str, str]:
    """Find names that score nothing once the residues are taken out of the fit, and give the reason by label.

    Such a name only repairs what a residue spoils in other runs. For example, if three axes seem to grow because the ball-bar grows, the
    scale of the laser has to shift, too. The reason lists every residue that alone makes the name score again; if none does, it lists all.

    ``residue``: labels of the findings that are residues; labels of variance effects, which are not in the fit, change nothing.
    """
    gone = [f.pick for f in found if f.pick.label in residue]
    kept = [f for f in found if f.pick.label not in residue]
    out = {}
    for f in kept if gone else ():
        others = [g.pick for g in kept if g is not f]
        if f.pick.unnamed or _scores(problem, f, others):
            continue
        leant = sorted(g.label for g in gone if _scores(problem, f, [*others, g])) or sorted(g.label for g in gone)
        out[f.pick.label] = f"evidence {f.score / 2.0:.0f}, which vanishes without the rejected {', '.join(leant)}"
    return out


def _scores(problem: WhitenedProblem, f: Selection, beside: Sequence[Pick]) -> bool:
    """Whether a finding gains more than its price beside other picks."""
    return gain_of(problem, f.pick, taken(problem, beside)) > f.gain - f.score


def companions(problem: WhitenedProblem, found: Sequence[Selection], solved: SolvedModel) -> dict[int, int]:
    """Return, for each finding that is only a residue, its index and the index of the finding that it comes from."""
    power = []
    for pick, c in zip(solved.picks, solved.coefficients, strict=True):
        size = problem.white(pick.raw(problem) @ c[:, None])[:, 0] ** 2
        power.append(np.sqrt(size / max(size.sum(), 1e-300)))
    out: dict[int, int] = {}
    for i, small in enumerate(found):
        for j, big in enumerate(found):
            if small.score < COMPANION_SHARE * big.score and not big.pick.unnamed and power[i] @ power[j] > COMPANION_OVERLAP:
                out[i] = j
    return out
