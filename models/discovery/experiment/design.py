"""Experiment design: the addition that best separates the remaining suspects, by simulation (T-optimal design, Atkinson and Fedorov).

For every addition that the campaign lacks, each rival is fitted to the leading suspect's signal over old and new runs. All unknowns are
free: the rival's coefficients, the present simulation, the set-ups. The norm of the residual, in sigmas of the noise, is the expected
separation. The addition with the largest gain per minute is proposed; additions that separate all rivals by ball-bar or laser come first.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import NextTest
from abbe.models.discovery.baseline import Baseline, baseline_of
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.experiment.additions import ExperimentOffer, offers
from abbe.models.effects.effect import Effect, Values
from abbe.models.effects.path import Path, Places

THIN = 100
"""Approximate number of readings kept of each old run; each also represents readings left out."""
ENOUGH = 5.0
"""Separations are capped at this many sigmas."""
WORTH, LEAST = 2.0, 0.02
"""`WORTH`: least gain in sigmas of a test that is worth its time. `LEAST`: a test that gains fewer sigmas is useless."""
NOISE_MM = {"bar": 4e-4, "laser": 3e-4}
LENGTH_MM = 3e-4
SEPARATED = 4.0
"""A rival that is this many sigmas away is excluded."""
WIDE = 10.0
"""Factor on the priors of the simulation's unknowns, as in the search."""
RIDGE = 1e-10


@dataclass(frozen=True)
class SuspectEffect:
    """An effect that may be the missing one.

    Attributes
    ----------
    coefficients : array, shape (k,)
        Fitted coefficients, used only for the leading suspect. None: coefficients of typical strength (`usual`).
    """

    effect: Effect
    key: str
    values: Values
    coefficients: F1 | None = None

    @property
    def label(self) -> str:
        """Label of the effect: ``name:key``, or the name alone without a key."""
        return self.effect.label(self.key)


@dataclass(frozen=True)
class Prospect:
    """Expected separation of the leading suspect from each rival, sigmas, with an addition (``sigmas``) and without it (``already``)."""

    offer: ExperimentOffer
    sigmas: F1
    already: F1

    @property
    def gain(self) -> F1:
        """Separation that the addition gains from each rival, in sigmas."""
        return np.asarray(self.sigmas - self.already)

    @property
    def plain(self) -> bool:
        """Whether the addition is ordinary (not `ExperimentOffer.special`) and separates every rival that is still to be separated."""
        open_ = self.already < SEPARATED
        return not self.offer.special and bool((self.sigmas[open_] >= SEPARATED).all() and open_.any())

    @property
    def per_minute(self) -> float:
        """Gain in squared separation per minute, summed over the rivals; each separation is capped at `ENOUGH`."""
        gain = np.minimum(self.sigmas, ENOUGH) ** 2 - np.minimum(self.already, ENOUGH) ** 2
        return float(np.maximum(gain, 0.0).sum() / max(self.offer.minutes, 1.0))


def propose(
    case: Case, leader: SuspectEffect, rivals: tuple[SuspectEffect, ...], noise_mm: Mapping[str, float] | None = None
) -> NextTest | None:
    """Propose the addition that gains most separation of the leading suspect from its rivals per minute.

    Parameters
    ----------
    leader : the named suspect, with its coefficients.
    rivals : alternatives to it.
    noise_mm : noise of one reading of "bar" and "laser"; default: usual values.

    Returns
    -------
    NextTest or None
        None without rivals, or if every addition gains less than `LEAST` sigmas. If every addition gains less than `WORTH`, the result is
        the addition with the largest gain.
    """
    found = [p for p in prospects(case, leader, rivals, noise_mm) if p.gain.max() >= LEAST]
    if not found:
        return None
    useful = [p for p in found if p.gain.max() >= WORTH]
    best = useful[0] if useful else max(found, key=lambda p: float(p.gain.max()))
    separated = best.gain >= min(WORTH, float(best.gain.max()))
    labels = [r.label for r, t in zip(rivals, separated, strict=True) if t]
    return NextTest(
        (best.offer.adds,), (leader.label, *labels), float(best.sigmas[separated].min()), float(best.offer.minutes), best.offer.why
    )


def prospects(
    case: Case, leader: SuspectEffect, rivals: tuple[SuspectEffect, ...], noise_mm: Mapping[str, float] | None = None
) -> tuple[Prospect, ...]:
    """Return all additions with their expected separations: `Prospect.plain` ones first, then by gain per minute; see `propose`."""
    found = offers(case)
    if not rivals or not found:
        return ()
    noise = {**NOISE_MM, **(noise_mm or {})}
    old = tuple(_decimated(r) for r in case.of("identify"))
    new = tuple(r for o in found for r in (*o.runs, *o.subtracted))
    every = replace(case, runs=tuple(r for r, _ in old) + new)
    table = _Columns.of(_with_setups(every), leader, rivals, tuple(r.path for r in every.runs))
    known = np.sum([table.gram(r, k, w / noise[r.path.kind] ** 2) for k, (r, w) in enumerate(old)], axis=0)
    already = table.left(known)
    out, at = [], len(old)
    for offer in found:
        gram = known.copy()
        for i, run in enumerate(offer.runs):
            subtracted = (offer.subtracted[i], at + len(offer.runs) + i) if offer.subtracted else None
            gram += table.gram(run, at + i, 1.0 / noise[run.path.kind] ** 2, subtracted)
        at += len(offer.runs) + len(offer.subtracted)
        out.append(Prospect(offer, table.left(gram, knows_length=offer.knows_length), already))
    return tuple(sorted(out, key=lambda p: (not p.plain, -p.per_minute, p.offer.minutes, p.offer.adds)))


def _with_setups(case: Case) -> Baseline:
    """Return the present simulation with all set-up unknowns, because a new mounting always has an unknown cup, length and tilt."""
    return baseline_of(replace(case, includes=case.includes | {"setup_centre_offset", "bar_length_error", "mirror_tilt"}))


def _decimated(run: CaseRun) -> tuple[CaseRun, float]:
    """Return the run with fewer readings, and the number of old readings that each of them represents."""
    step = max(run.path.n // THIN, 1)
    p, rows = run.path, slice(None, None, step)
    a = p.at
    at = Places(
        a.q_mm[rows],
        a.sign[rows],
        a.since_mm[rows],
        a.v_mm_s[rows],
        a.a_mm_s2[rows],
        a.t_s[rows],
        {k: v[rows] for k, v in a.temp_c.items()},
    )
    path = replace(p, at=at, look=p.look[rows], feed_mm_min=p.feed_mm_min[rows], direction=p.direction[rows], travel_mm=p.travel_mm[rows])
    return replace(run, path=path, deviation_mm=np.zeros(path.n), valid=run.valid[rows]), float(step)


@dataclass(frozen=True)
class _Columns:
    """Columns of the present simulation, the rivals and the leading suspect over all runs, old and new."""

    base: Baseline
    leader: tuple[F1, ...]
    rivals: tuple[tuple[F2, ...], ...]

    @classmethod
    def of(cls, base: Baseline, leader: SuspectEffect, rivals: tuple[SuspectEffect, ...], paths: tuple[Path, ...]) -> _Columns:
        own = leader.effect.signal(paths, leader.key, leader.values)
        given = usual(leader, own[0].shape[1]) if leader.coefficients is None else leader.coefficients
        # Columns of new set-ups get the rms of the known coefficients.
        c = np.full(own[0].shape[1], float(np.sqrt(np.mean(given**2))))
        c[: given.size] = given[: c.size]
        found = tuple(tuple(r.effect.signal(paths, r.key, r.values)) for r in rivals)
        return cls(base, tuple(np.asarray(s @ c) for s in own), found)

    def gram(self, run: CaseRun, k: int, weight: float, subtracted: tuple[CaseRun, int] | None = None) -> F2:
        """Normal matrix of run number k (simulation, rivals, leader). ``subtracted``: run, and its number, whose columns are subtracted."""
        columns = self._of_run(run, k)
        if subtracted is not None:
            columns = columns - self._of_run(*subtracted)
        return np.asarray(columns.T @ columns * weight)

    def _of_run(self, run: CaseRun, k: int) -> F2:
        jacobian = self.base.linear(run.data(), np.zeros(self.base.size))[1]
        return np.column_stack([jacobian, *(r[k] for r in self.rivals), self.leader[k]])

    def left(self, gram: F2, *, knows_length: bool = False) -> F1:
        """Norm of the part of the leader's signal that the simulation together with each rival cannot imitate, sigmas, shape (rivals,)."""
        n, out = self.base.size, []
        sd = self.base.prior_sd * WIDE
        if knows_length:
            sd = np.where([name.startswith("bar_length") for name in self.base.names], LENGTH_MM, sd)
        start = n
        for rival in self.rivals:
            columns = np.arange(start, start + rival[0].shape[1])
            start += columns.size
            use = np.concatenate([np.arange(n), columns])
            inner = gram[np.ix_(use, use)] + np.diag(np.concatenate([sd**-2.0, np.zeros(columns.size)]))
            scale = 1.0 / np.sqrt(np.diag(inner) + 1e-30)
            inner = inner * scale * scale[:, None] + RIDGE * np.eye(use.size)
            b = gram[use, -1] * scale
            out.append(np.sqrt(max(gram[-1, -1] - b @ scipy.linalg.solve(inner, b, assume_a="pos"), 0.0)))
        return np.array(out)


def usual(suspect: SuspectEffect, columns: int) -> F1:
    """Return coefficients (columns,) of typical strength; only the first is not 0. The strength may be any power of this coefficient."""
    effect = suspect.effect
    sizes = [abs(effect.strength(c * effect.per_unit * np.eye(columns)[0], suspect.values)) / effect.per_unit for c in (1.0, 4.0)]
    power = np.log(sizes[1] / sizes[0]) / np.log(4.0)
    out = np.zeros(columns)
    out[0] = effect.per_unit * (np.sqrt(np.prod(effect.typical)) / sizes[0]) ** (1.0 / power)
    return out
