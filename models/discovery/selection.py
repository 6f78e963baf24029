"""Forward selection of missing effects with backward steps and a price for every parameter and label tried.

A label is an effect with its key (axis or error motion); a label of the catalogue is called a name. Before a candidate is compared, its
non-linear parameters are refined from its best start (`refined`): between the neighbouring starts, or, for a structure without a name, only
close to the start. Other names are tried in place of a chosen one on the same readings (`rivals_of`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise

import numpy as np
import scipy

from abbe.models.discovery.candidate_bank import UNNAMED, Bank, Pick, Taken, bank_of, competing, gain_of, starts_of, taken, with_values
from abbe.models.discovery.generic.unnamed_structures import generic_rivals
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.effects.effect import Effect, Parameter, Signal
from abbe.models.effects.path import Path

SWEEPS = 2
EVALUATIONS = 9
NEAR = 0.02
"""A structure without a name is refined within this fraction of its parameters' range on either side of the start."""
MOST_EFFECTS = 5
SHORTLIST = 6
THRESHOLD = 4.0
"""Price of every new name, in addition to the prices for its parameters and for the number of names tried."""
UNNAMED_PRICE = 6.0
VARIANT_PRICE = 4.0
"""Price of a name that contains a simpler one (`abbe.models.effects.effect.Effect.variant_of`), equal to the price of a new name."""
FORM_LEAST = 0.0002
"""A form (`Form`) must explain at least this share of its effect's gain; a smaller one would only shift the strength."""
NEARLY = 0.93
"""A name is preferred to a structure without a name if it explains this share of the structure's gain."""
HOPELESS = 0.5
"""A start that gains less than this share of the best name so far is not refined."""
UNNAMED_LABELS = 40
"""Number of labels of structures without a name that are tried (`abbe.models.discovery.generic.unnamed_structures`)."""
FORM_SHARE, FORM_PRICE = 0.6, 6.0
"""Price of a form (`Form`) of a chosen effect: this share of the price of its columns, plus a constant."""
APART = 0.06
"""Least relative distance between a second effect's parameter and the first effect's parameter and its harmonics."""
SIDE_BAND = 0.03
"""A second wave nearer to the first than twice `APART`, with less than this share of the first's score, is a side band: the first wave's
amplitude changes along the axis in another way than its forms allow."""
UNSURE = 3.84
"""A moment is not excluded if its chi-square gain is at most this much below the best (95 %)."""
EXCLUDED = 12.0
"""A rival whose score is lower by this much chi-square is excluded."""
TRIED = 8
LIKE = 0.3
"""A rival in its textbook form is refined only if it has at least this share of the gain of the names that it would replace."""
KIN = 0.02
"""A rival that explains all but this share of the gain is not excluded, because a real effect deviates that much from its formula. This
rule does not hold for rivals with more unknowns than the name, which may explain more by following the deviations.
"""


def refined(problem: WhitenedProblem, pick: Pick, beside: Taken, *, sweeps: int = SWEEPS) -> tuple[Pick, float]:
    """Optimise the non-linear parameters of ``pick`` one after the other; return the pick and its gain.

    Each parameter stays between the neighbouring starts, and close to its start (`NEAR`) in a structure without a name. A parameter of a
    name that the readings do not determine takes its usual value (`Parameter.prior_sd`).
    """
    best = gain_of(problem, pick, beside)
    if not pick.effect.shape:
        return pick, best
    for sweep in range(sweeps if len(pick.effect.shape) > 1 else 1):
        before = best
        for parameter in pick.effect.shape:
            pick, best = _along(parameter, pick, best, lambda p: gain_of(problem, p, beside), shrink=0.5**sweep)
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

    def unusual(tried: Pick) -> float:
        return 0.0 if pick.unnamed else ((tried.values[parameter.name] - parameter.typical) / parameter.prior_sd) ** 2

    bounds = (np.log(low), np.log(high)) if logs else (low, high)
    found = scipy.optimize.minimize_scalar(
        lambda x: unusual(at(x)) - gain(at(x)),
        bounds=bounds,
        method="bounded",
        options={"maxiter": EVALUATIONS, "xatol": 1e-4 * (bounds[1] - bounds[0])},
    )
    better = at(found.x)
    return (better, unusual(better) - float(found.fun)) if -found.fun > best - unusual(pick) else (pick, best)


def _neighbours(parameter: Parameter, value: float) -> tuple[float, float]:
    """Return the next start below and above a value, or the bound of the parameter where there is none."""
    below = [s for s in parameter.starts if s < value * (1 - 1e-9) - 1e-12]
    above = [s for s in parameter.starts if s > value * (1 + 1e-9) + 1e-12]
    return max(below, default=parameter.low), min(above, default=parameter.high)


@dataclass(frozen=True)
class Selection:
    """A pick with its gain (reduction of chi-square given all other picks) and its score (gain minus price)."""

    pick: Pick
    gain: float
    score: float


def price(pick: Pick, logs: float, readings: int, labels: int) -> float:
    """Return the gain that a new label needs: a price for each parameter, for the number of labels tried, and a threshold.

    ``logs``: log of the number of readings that a column changes, summed over the columns; a non-linear parameter costs log(``readings``).
    """
    return (
        logs
        + len(pick.effect.shape) * float(np.log(readings))
        + 2.0 * float(np.log(max(labels, 1)))
        + THRESHOLD
        + (UNNAMED_PRICE if pick.unnamed else VARIANT_PRICE if pick.effect.variant_of else 0.0)
    )


def form_price(logs: float) -> float:
    """Return the gain that a form (`Form`) needs; ``logs`` as in `price`, over its columns."""
    return FORM_SHARE * logs + FORM_PRICE


@dataclass(frozen=True)
class Contest:
    """The search over one problem: its banks of candidates, and the numbers of labels and readings.

    ``widths``: argument ``logs`` of `price`, by label.
    ``seconds``: effects that are tried only together with another effect (`abbe.models.effects.effect.Effect.beside`).
    """

    problem: WhitenedProblem
    banks: list[Bank]
    widths: dict[str, float]
    labels: int
    readings: int
    seconds: tuple[Effect, ...] = ()

    @classmethod
    def of(cls, problem: WhitenedProblem, effects: Sequence[Effect]) -> Contest:
        """Set up a search for all effects that change the mean of the readings and that the present simulation lacks.

        Each effect is tried with every combination of its start values (`starts_of`).
        """
        rivals = competing(effects, problem.case.includes)
        bank = bank_of(problem, starts_of([e for e in rivals if not e.beside]))
        widths = {p.label: float(k) for p, k in zip(bank.picks, bank.logs, strict=True)}
        seconds = tuple(e for e in rivals if e.beside)
        return cls(problem, [bank], widths, len(widths) + UNNAMED_LABELS, int(np.count_nonzero(problem.use)), seconds)

    def look_for_more(self, picks: Sequence[Pick], beside: Taken) -> None:
        """Add to the search the effects that are tried only together with ``picks``, and structures without a name.

        These structures start at the peaks of the residuals once the picks are projected out (``beside``).
        """
        problem = self.problem
        left = problem.projection.residual - beside.rows.T @ (beside.rows @ problem.projection.y)
        labels = [p.label for p in problem.paths]
        sigma = {kind: c.sd_mm for kind, c in problem.colours.items()}
        rivals = generic_rivals(problem.case, dict(zip(labels, problem.by_run(left), strict=True)), sigma)
        seconds = [_second(e, p, self.problem.paths) for e in self.seconds for p in picks if p.effect.name in e.beside]
        bank = bank_of(problem, starts_of([*competing(rivals, problem.case.includes), *seconds]))
        self.widths.update({p.label: float(k) for p, k in zip(bank.picks, bank.logs, strict=True)})
        self.banks[1:] = [bank]

    def price(self, pick: Pick) -> float:
        """Price of a pick in this search, its forms included."""
        plain = price(pick, self._width(pick.label, pick.effect.signal, pick), self.readings, self.labels)
        return plain + sum(form_price(self._form_width(pick, i)) for i in range(len(pick.forms)))

    def _form_width(self, pick: Pick, i: int) -> float:
        return self._width(f"{pick.label}/{pick.forms[i].name}", pick.forms[i].signal, pick)

    def _width(self, name: str, signal: Signal, pick: Pick) -> float:
        """Return the argument ``logs`` of `price` for the signal of a pick or of one of its forms."""
        if name not in self.widths:
            columns = np.abs(self.problem.raw(signal, pick.key, pick.values))
            self.widths[name] = float(np.log(np.maximum((columns > 1e-5 * columns.max()).sum(axis=0), 2)).sum())
        return self.widths[name]

    def shortlist(self, beside: Taken, without: Sequence[str], most: int = SHORTLIST) -> list[Selection]:
        """Return the best candidate of each label on the grid, best labels first; labels in ``without`` are left out."""
        best: dict[str, Selection] = {}
        for bank in self.banks:
            for pick, gain in zip(bank.picks, bank.gains(self.problem.projection.y, beside.rows), strict=True):
                if pick.label not in without and (pick.label not in best or gain > best[pick.label].gain):
                    best[pick.label] = Selection(pick, float(gain), float(gain) - self.price(pick))
        return sorted(best.values(), key=lambda f: (-f.score, f.pick.label))[:most]

    def next(self, picks: Sequence[Pick], beside: Taken, without: Sequence[str] = (), beat: float = 0.0) -> Selection | None:
        """Return the best refined new label with a score above ``beat``, or None; a name nearly as good wins over an unnamed structure."""
        tried: list[Selection] = []
        for candidate in self.shortlist(beside, [*without, *(p.label for p in picks)]):
            most = max([beat, *(f.score for f in tried)])
            if candidate.gain < HOPELESS * most - 20.0 or candidate.score < -30.0:
                continue
            pick, gain = refined(self.problem, candidate.pick, beside)
            tried.append(Selection(pick, gain, gain - self.price(pick)))
        good = [f for f in tried if f.score > beat]
        if not good:
            return None
        best = max(good, key=lambda f: f.score)
        if best.pick.unnamed:  # it can imitate a name's formula: prefer the name, whose forms are tried next
            near = [f for f in good if not f.pick.unnamed and f.gain > NEARLY * best.gain]
            return max(near, key=lambda f: f.score, default=best)
        return best

    def next_form(self, picks: Sequence[Pick], beside: Taken) -> tuple[int, Pick, float] | None:
        """Find the best form (`Form`) to add to a chosen effect; return the index of the pick, the pick with the form, and its score."""
        best: tuple[int, Pick, float] | None = None
        for i, pick in enumerate(picks):
            for form in pick.effect.forms:
                if form in pick.forms:
                    continue
                more = replace(pick, forms=(*pick.forms, form))
                only = replace(pick.effect, name=f"{UNNAMED}form {pick.effect.name} {form.name}", signal=form.signal, forms=())
                gain = gain_of(self.problem, Pick(only, pick.key, pick.values), beside)
                score = gain - form_price(self._form_width(more, len(more.forms) - 1))
                if gain < FORM_LEAST * gain_of(self.problem, pick, others(self.problem, picks, i)):
                    continue
                if score > 0.0 and (best is None or score > best[2]):
                    best = (i, more, score)
        return best


def _second(effect: Effect, pick: Pick, paths: Sequence[Path]) -> Effect:
    """Return an effect that is tried together with ``pick``, with the same key and with starts for these runs.

    Starts of a moment lie between runs and within them (`moments`); starts of a parameter that the pick also has are not near the pick's
    value and its harmonics.
    """
    shape = []
    for q in effect.shape:
        starts = q.starts
        if q.name == "t0_s":
            starts = moments(paths)
        elif q.name in pick.values:
            times = np.array([pick.values[q.name] / s for s in starts])
            apart = np.abs(times - np.maximum(np.round(times), 1.0)) > APART * np.maximum(times, 1.0)
            starts = tuple(s for s, far in zip(starts, apart, strict=True) if far)
        shape.append(replace(q, starts=starts))
    return replace(effect, keys=(pick.key,), shape=tuple(shape))


def moments(paths: Sequence[Path]) -> tuple[float, ...]:
    """Return times, s, at which something may begin: half way between successive runs, and in the middle of each run but the first."""
    ends = sorted((float(p.at.t_s[0]), float(p.at.t_s[-1])) for p in paths)
    return tuple(t for (_, end), (start, last) in pairwise(ends) for t in (0.5 * (end + start), 0.5 * (start + last)))


def selected(contest: Contest, start: Sequence[Pick] = (), most: int = MOST_EFFECTS) -> list[Selection]:
    """Select all effects that are worth their price, with backward steps after every addition."""
    picks, problem, in_vain = list(start), contest.problem, list[str]()
    for _ in range(3 * most):
        beside = taken(problem, picks)
        form = contest.next_form(picks, beside)
        contest.look_for_more(picks, beside)
        new = contest.next(picks, beside, in_vain) if len(picks) < most else None
        if form is not None and (new is None or form[2] > new.score or form[2] > 0.5 * new.score):
            picks[form[0]] = form[1]
        elif new is not None:
            picks.append(new.pick)
            picks = dropped(contest, swapped(contest, picks))
            in_vain = [*in_vain, new.pick.label] if new.pick.label not in {p.label for p in picks} else []
        else:
            fewer = merged(contest, picks)
            if len(fewer) == len(picks):
                break
            picks, in_vain = dropped(contest, fewer), []
    return weighed(contest, dropped(contest, picks))


def others(problem: WhitenedProblem, picks: Sequence[Pick], i: int) -> Taken:
    """Project out all picks but number i."""
    return taken(problem, [p for j, p in enumerate(picks) if j != i])


def swapped(contest: Contest, picks: list[Pick]) -> list[Pick]:
    """Refine every pick again given the others, and replace it by another label with a higher score."""
    if len(picks) < 2:
        return picks
    for i in range(len(picks)):
        beside = others(contest.problem, picks, i)
        own, gain = refined(contest.problem, picks[i], beside, sweeps=1)
        score = gain - contest.price(own)
        rival = contest.next([p for j, p in enumerate(picks) if j != i], beside, without=[picks[i].label], beat=score + 1.0)
        picks[i] = own if rival is None else rival.pick
    return picks


def merged(contest: Contest, picks: list[Pick]) -> list[Pick]:
    """Replace two picks by one name that scores higher than both together.

    One effect of the true form can look like two of the textbook form: a lag of Y like equal leads of X and Z, a bed that bends double
    like two curves. So the one name is compared with its forms (`Form`). An effect that is tried only beside another one replaces nothing,
    and two structures without a name are not replaced.
    """
    problem = contest.problem
    for i, j in combinations(range(len(picks)), 2):
        a, b = picks[i], picks[j]
        if a.unnamed and b.unnamed:
            continue
        rest = [p for k, p in enumerate(picks) if k not in (i, j)]
        beside = taken(problem, rest)
        both = gain_of(problem, a, beside) + gain_of(problem, b, taken(problem, [*rest, a]))
        worth = both - contest.price(a) - contest.price(b)
        near = [f for f in contest.shortlist(beside, [p.label for p in rest], TRIED) if f.gain > LIKE * both]
        tried = [_formed_twice(contest, f.pick, beside, worth) for f in near if not f.pick.unnamed and not f.pick.effect.beside]
        best = max(tried, key=lambda t: t[0], default=None)
        if best is not None and best[0] > worth:
            return merged(contest, [*rest, best[1]])
    return picks


def _formed_twice(contest: Contest, pick: Pick, beside: Taken, worth: float) -> tuple[float, Pick]:
    """Refine a pick, add its forms, and refine it again, because the forms move the best pitch or time constant; return score and pick.

    A pick without non-linear parameters stays without forms if not even all forms together make its score larger than ``worth``.
    """
    one, gain = refined(contest.problem, pick, beside)
    score = gain - contest.price(one)
    if not one.effect.shape and gain_of(contest.problem, replace(one, forms=one.effect.forms), beside) - gain + score <= worth:
        return score, one
    one, gain, score = _formed(contest, one, beside, gain)
    if one.forms and one.effect.shape:
        one, gain = refined(contest.problem, one, beside, sweeps=1)
        score = gain - contest.price(one)
    return score, one


def dropped(contest: Contest, picks: list[Pick]) -> list[Pick]:
    """Drop side bands, and the pick with the lowest score given the others, until every score is positive."""
    while picks:
        found = weighed(contest, picks)
        bands = [f for f in found if _side_band(f, found)]
        worst = bands[0] if bands else min(found, key=lambda f: f.score)
        if worst.score > 0.0 and not bands:
            return picks
        picks = [f.pick for f in found if f is not worst]
    return picks


def near_waves(second: Pick, first: Pick) -> bool:
    """Whether ``second`` is a wave on the same axis as ``first`` whose pitch is too near to count as another wave."""
    if first.effect.name not in second.effect.beside or second.key != first.key or "pitch_mm" not in second.values:
        return False
    return abs(first.values["pitch_mm"] / second.values["pitch_mm"] - 1.0) < 2.0 * APART


def _side_band(small: Selection, found: Sequence[Selection]) -> bool:
    return any(near_waves(small.pick, f.pick) and small.score < SIDE_BAND * f.score for f in found)


def weighed(contest: Contest, picks: Sequence[Pick]) -> list[Selection]:
    """Return gain and score of each pick given all others, in the order of the picks."""
    out = []
    for i, pick in enumerate(picks):
        gain = gain_of(contest.problem, pick, others(contest.problem, picks, i))
        out.append(Selection(pick, gain, gain - contest.price(pick)))
    return out


def u_moment(problem: WhitenedProblem, picks: Sequence[Pick], i: int) -> float:
    """Standard uncertainty, s, of the moment at which pick ``i`` begins: a quarter of the span of moments that explain nearly as much.

    `UNSURE`: largest loss of gain that counts as nearly as much. A step in time has no derivative, so the fit gives no uncertainty.
    """
    beside, pick = others(problem, picks, i), picks[i]
    times = np.array([*moments(problem.paths), pick.values["t0_s"]])
    gains = np.array([gain_of(problem, with_values(pick, {**pick.values, "t0_s": float(t)}), beside) for t in times])
    near = times[gains > gains.max() - UNSURE]
    gap = np.diff(np.sort(times))[max(int(np.searchsorted(np.sort(times), pick.values["t0_s"])) - 1, 0)]
    return float(max(0.25 * np.ptp(near), gap / np.sqrt(12.0)))


@dataclass(frozen=True)
class Rival:
    """A name that could replace a chosen name.

    ``deficit``: the chosen name's score minus the rival's; ``share``: the rival's gain divided by the chosen name's.
    """

    pick: Pick
    deficit: float
    share: float


def rivals_of(contest: Contest, found: Sequence[Selection], i: int) -> list[Rival]:
    """Return the rivals of pick ``i`` that the readings do not exclude, best first, without variants of its name."""
    picks = [f.pick for f in found]
    beside = others(contest.problem, picks, i)
    own = found[i]
    without = [p.label for p in picks]
    out = []
    for candidate in contest.shortlist(beside, without, TRIED):
        if candidate.pick.unnamed or _nested(candidate.pick, own.pick) or candidate.gain < LIKE * own.gain:
            continue
        pick, gain = refined(contest.problem, candidate.pick, beside)
        pick, gain, score = _formed(contest, pick, beside, gain)
        rival = Rival(pick, own.score - score, gain / own.gain)
        if rival.deficit < EXCLUDED or (
            rival.share > 1.0 - KIN and _unknowns(contest.problem, pick) <= _unknowns(contest.problem, own.pick)
        ):
            out.append(rival)
    return sorted(out, key=lambda r: r.deficit)


def _unknowns(problem: WhitenedProblem, pick: Pick) -> int:
    """Number of coefficients and non-linear parameters of a pick."""
    return int(pick.raw(problem).shape[1]) + len(pick.effect.shape)


def _nested(a: Pick, b: Pick) -> bool:
    """Whether one pick is a variant of the other, such as backlash and position-dependent backlash of the same axis."""
    return a.key == b.key and (a.effect.name == b.effect.variant_of or b.effect.name == a.effect.variant_of)


def _formed(contest: Contest, pick: Pick, beside: Taken, gain: float) -> tuple[Pick, float, float]:
    """Add the forms (`Form`) that are worth their price to a rival; return it with gain and score."""
    score = gain - contest.price(pick)
    for form in pick.effect.forms:
        more = replace(pick, forms=(*pick.forms, form))
        with_form = gain_of(contest.problem, more, beside)
        if with_form - gain < FORM_LEAST * gain:  # the same rule as for the chosen name
            continue
        if with_form - contest.price(more) > score:
            pick, gain, score = more, with_form, with_form - contest.price(more)
    return pick, gain, score
