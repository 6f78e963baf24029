"""New runs of a machine that was solved before: candidates for what has changed, the choice among them, their sizes, and the judgement."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from models.arrays import F1, F2
from models.discovery.changed_evidence import Asked, evidence_of, log_evidence
from models.geometry.bases import Term, term_values
from models.machine import AXES
from models.solvers.engine import Fit, Problem
from models.solvers.information import Sums
from models.uncertainty.known_field import KnownField

LINEAR = ("EXX", "EYY", "EZZ", "C0Y", "B0Z", "A0Z")
LINEAR_SIZES = (3e-6, 10e-6, 30e-6, 100e-6, 300e-6)
"""Sizes of a change of scale or squareness that are tried, rad."""
SHAPE_SIZES = (0.1, 0.3, 1.0, 3.0)
"""Sizes of a change of a motion's shape that are tried, in documented sizes of the motion itself (`models.solvers.priors`)."""
ENOUGH = 3.0
"""Evidence (natural logarithm) after its price from which on a change is told: twenty times as likely with it."""
NEAR = 3.0
"""A rival with so much less evidence or less is one that the runs cannot tell from what is named."""
MOST = 6
POINTS = 41


@dataclass(frozen=True)
class Taken:
    """A candidate that was chosen: with which size it stands beside the others, its gain after its price, and its near rivals."""

    asked: Asked
    size: float
    gain: float
    rivals: tuple[tuple[str, float], ...]


@dataclass(frozen=True)
class Chosen:
    """What some runs have chosen, and their normal equations less what the solution from before expects: (p, p) and (p,)."""

    taken: tuple[Taken, ...]
    gram: F2
    moment: F1


@dataclass(frozen=True, eq=False)
class Bench:
    """The new runs, linearised about what they themselves say, and the machine from before. Unknowns in units of their typical size."""

    known: KnownField
    problem: Problem
    fit: Fit

    @property
    def _n(self) -> int:
        return len(self.known.terms)

    @cached_property
    def _open(self) -> F2:
        """Factor of what is open without any change, shape (p, p): the solution's own covariance, lost motion, set-ups."""
        typical, p, n = self.problem.sizes.typical, len(self.problem.names), self._n
        out = np.zeros((p, p))
        out[:n, :n] = self.known.root() / typical[:n, None]
        out[range(n, p), range(n, p)] = self.fit.prior_sd[n:] / typical[n:]
        return out

    @cached_property
    def candidates(self) -> tuple[Asked, ...]:
        """All that may have changed, as far as the solution from before has terms for it."""
        names = {t.motion if t.order == 0 else t.name for t in self.known.terms}
        linear = [m for m in LINEAR if (m if m[1] == "0" else f"{m}.1") in names]
        out = [Asked(m, self._scaled(self.known.linear({m: 1.0})), LINEAR_SIZES) for m in linear]
        bent = dict.fromkeys(t.motion for t in self.known.terms if _is_shape(t))
        return (*out, *(Asked(f"{m} shape", self._shape(m), SHAPE_SIZES, several=True) for m in bent))

    def _scaled(self, coefficients: F1) -> F2:
        """One direction (P,) in mm and rad as a direction of all unknowns, shape (p, 1)."""
        out = np.zeros((len(self.problem.names), 1))
        out[: self._n, 0] = coefficients / self.problem.sizes.typical[: self._n]
        return out

    def _shape(self, motion: str) -> F2:
        """Factor of the documented size of a motion but for its linear part, shape (p, q)."""
        return self.problem.sizes.root[:, [k for k, t in enumerate(self.known.terms) if t.motion == motion and _is_shape(t)]]

    def choose(self, sums: Sums) -> Chosen:
        """Take in what gains most, one after another, until nothing gains enough; what has become needless goes.

        A shape is so pliant that it may gain more at first than either of two linear changes which explain all together. So the linear
        ones also get the first word, and the choice that makes the readings more likely is taken.
        """
        weight = np.exp(-self.fit.components.eta)
        gram, moment = np.tensordot(weight, sums.gram, 1), weight @ sums.moment
        start = np.zeros(len(moment))
        start[: self._n] = self.known.coefficients / self.problem.sizes.typical[: self._n]
        none = Chosen((), gram, moment - gram @ start)
        linear = tuple(a for a in self.candidates if not a.several)
        both = [self._grown(none, self.candidates), self._grown(self._grown(none, linear), self.candidates)]
        return max(both, key=lambda c: log_evidence(gram, c.moment, self._beside(c.taken)) - self._price * len(c.taken))

    def _grown(self, chosen: Chosen, candidates: Sequence[Asked]) -> Chosen:
        while len(chosen.taken) < MOST and (best := self._best(chosen, candidates)) is not None:
            grown = self._needed(replace(chosen, taken=(*chosen.taken, best)))
            if best.asked.name not in {t.asked.name for t in grown.taken}:
                break
            chosen = grown
        return chosen

    def _best(self, chosen: Chosen, candidates: Sequence[Asked]) -> Taken | None:
        names = {t.asked.name for t in chosen.taken}
        left = [a for a in candidates if a.name not in names]
        if not left:
            return None
        found = evidence_of(chosen.gram, chosen.moment, self._beside(chosen.taken), left)
        k = int(np.argmax([e.gain for e in found]))
        gain = found[k].gain - self._price
        if gain < ENOUGH:
            return None
        near = [(e.name, found[k].gain - e.gain) for e in found if e is not found[k] and found[k].gain - e.gain < NEAR]
        size = found[k].size if left[k].several else max(LINEAR_SIZES)
        return Taken(left[k], size, gain, tuple(sorted(near, key=lambda item: item[1])))

    def _needed(self, chosen: Chosen) -> Chosen:
        """Every one with its gain beside all the others; the least needed goes first, until all are needed."""
        taken = list(chosen.taken)
        while True:
            told = [
                evidence_of(chosen.gram, chosen.moment, self._beside([o for o in taken if o is not t]), [t.asked])[0].gain - self._price
                for t in taken
            ]
            if not taken or min(told) >= ENOUGH:
                return replace(chosen, taken=tuple(replace(t, gain=gain) for t, gain in zip(taken, told, strict=True)))
            del taken[int(np.argmin(told))]

    @property
    def _price(self) -> float:
        return float(np.log(len(self.candidates)))

    def _beside(self, taken: Sequence[Taken]) -> F2:
        """Factor of all that is open when these have changed, shape (p, k)."""
        return np.column_stack([self._open, *(t.asked.directions * t.size for t in taken)])

    def _free(self, chosen: Chosen, but: str) -> F2:
        """The same with all scales and squareness free, too, without one candidate."""
        others = [t for t in chosen.taken if t.asked.name != but]
        names = {but, *(t.asked.name for t in others)}
        linear = [Taken(a, max(LINEAR_SIZES), 0.0, ()) for a in self.candidates if not a.several and a.name not in names]
        return self._beside([*others, *linear])

    def size(self, chosen: Chosen, asked: Asked) -> tuple[float, float]:
        """Value of a change and its standard uncertainty (`models.discovery.changed.Change`), all that is linear free beside it."""
        coefficients, covariance = self._coefficients(chosen, asked)
        rows = self._values(asked.name.split()[0])
        if not asked.several:
            direction = self.known.linear({asked.name: 1.0})
            k = int(np.argmax(np.abs(direction)))
            return float(coefficients[k] / direction[k]), float(np.sqrt(covariance[k, k]) / abs(direction[k]))
        value = float(np.sqrt(np.mean((rows @ coefficients) ** 2)))
        slope = rows.T @ (rows @ coefficients) / (len(rows) * max(value, 1e-300))
        return value, float(np.sqrt(max(float(slope @ covariance @ slope), 0.0)))

    def _coefficients(self, chosen: Chosen, asked: Asked) -> tuple[F1, F2]:
        """Coefficients (P,) of one change, mm or rad, and their covariance."""
        size = next(t.size for t in chosen.taken if t.asked.name == asked.name)
        factor = asked.directions * size
        whole = np.column_stack([factor, self._free(chosen, asked.name)])
        inside = whole.T @ chosen.gram @ whole
        inside[np.diag_indices_from(inside)] += 1.0
        low = linalg.cho_factor(inside)
        mine = slice(0, factor.shape[1])
        x = linalg.cho_solve(low, whole.T @ chosen.moment)[mine]
        covariance = linalg.cho_solve(low, np.eye(len(inside))[:, mine])[mine]
        typical = self.problem.sizes.typical[: self._n, None]
        turned = factor[: self._n] * typical
        return turned @ x, turned @ covariance @ turned.T

    def _values(self, motion: str) -> F2:
        """A motion over its stroke per coefficient, shape (POINTS, P)."""
        stroke = self.known.machine.stroke_mm
        axis = AXES.index(motion[2])
        points = np.tile(stroke.mean(axis=1), (POINTS, 1))
        points[:, axis] = np.linspace(float(stroke[axis, 0]), float(stroke[axis, 1]), POINTS)
        mine = np.array([t.motion == motion for t in self.known.terms])
        return np.asarray(term_values(self.known.terms, points, stroke) * mine)

    def seen(self, chosen: Chosen) -> dict[str, float]:
        """Change of each scale and squareness that equals its U (k = 2), the others free beside it, rad."""
        linear = [a for a in self.candidates if not a.several]
        found = [evidence_of(chosen.gram, chosen.moment, self._free(chosen, a.name), [a])[0] for a in linear]
        return {e.name: 2.0 / float(np.sqrt(max(e.information, 1e-300))) for e in found}

    def floor_mm(self) -> float:
        """Noise of the readings, rms."""
        return float(np.sqrt(np.mean((self._noise_mm * self._whole)[self._whole] ** 2)))

    @property
    def _noise_mm(self) -> F1:
        return np.asarray(self.problem.sigma * np.exp(0.5 * self.fit.components.eta)[self.problem.readings.kind])

    @property
    def _whole(self) -> NDArray[np.bool_]:
        """Readings that count."""
        return np.asarray(self.fit.weight > 0.5)

    def judged(self, by_half: Sequence[Chosen]) -> tuple[float, float]:
        """Rms of all readings less the solution from before, and less what the other half has chosen, too, mm; set-ups refitted."""
        old = self.known.coefficients
        before, after, count = 0.0, 0.0, 0
        for odd, chosen in enumerate(reversed(by_half)):
            rows = (self.problem.readings.fold % 2 == odd) & self._whole
            new = old + sum((self._coefficients(chosen, t.asked)[0] for t in chosen.taken), start=np.zeros_like(old))
            before += self._left(rows, old)
            after += self._left(rows, new)
            count += int(rows.sum())
        return float(np.sqrt(before / count)), float(np.sqrt(after / count))

    def _left(self, rows: NDArray[np.bool_], coefficients: F1) -> float:
        """Sum of squares of readings less what coefficients predict, mm²; lost motion and set-ups refitted within their priors."""
        r, n, typical = self.problem.readings, self._n, self.problem.sizes.typical
        noise = self._noise_mm[rows]
        sd = self.fit.prior_sd[n:] / typical[n:]
        at = self.fit.theta / typical
        at[:n] -= coefficients / typical[:n]
        y = (self.fit.residual_mm[rows] + self.problem.sigma[rows] * (r.a[rows] @ at)) / noise
        a = r.a[rows, n:] * sd * (self.problem.sigma[rows] / noise)[:, None]
        x = linalg.solve(a.T @ a + np.eye(a.shape[1]), a.T @ y, assume_a="pos")
        return float(np.sum(((y - a @ x) * noise) ** 2))


def _is_shape(term: Term) -> bool:
    """Whether a term is no scale and no squareness: those are asked apart."""
    return term.order > 0 and not (term.order == 1 and term.component == term.axis)
