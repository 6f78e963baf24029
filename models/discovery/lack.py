"""Lack of fit: whether residuals exceed independently known noise after the search has found nothing.

The search finds only known shapes, and noise estimated from the residuals includes unknown shapes. So the noise comes from repeats if there
are any. The verdict "nothing is missing" requires that residuals agree with this noise: all together, run by run, and by position,
direction, time, feed and temperature (`abbe.models.discovery.localization.locate`). Holdout runs must agree, too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Agreement, Localization
from abbe.models.discovery.candidate_bank import Pick
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.instrument_noise import CLEARLY, fine
from abbe.models.discovery.localization import locate
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.machine import AXES
from abbe.models.probability import f_above

TIMES = 1.5
"""Residuals exceed noise if their rms is above this multiple of its rms."""
CHANCE = 1e-3
"""Significance level of statements about one run, position or direction, family-wise for a campaign."""
FEWEST, REPEATS = 8, 20
"""Minimum number of readings for a test of a single run; minimum number of repeats for an estimate of noise."""
SHARED = 6
"""Readings per degree of freedom of the noise from differences of neighbours: differences share readings, and a median is used."""
NEAR_MM = 0.05
"""Positions closer than this are repeats of one position."""
ALONG_ONE_AXIS = 0.999
"""A laser measures along one axis if this component of its beam's unit vector is larger."""
KNOWN_FREEDOM = 1e6
COMMON, PERIODIC = 0.8, 0.6
"""Least share of the residuals' energy: `COMMON` to report residuals as alike in both directions, `PERIODIC` to report a period."""


@dataclass(frozen=True)
class Floor:
    """Noise of a reading of one instrument, mm, and its degrees of freedom."""

    sd_mm: float
    freedom: float


def floors(problem: WhitenedProblem) -> dict[str, Floor]:
    """Return the noise of each instrument, from repeats or from differences of neighbouring readings, the smaller of both.

    Residuals also contain model errors, so they are used only if repeats and differences are not clearly smaller. Neither repeats nor
    differences contain an effect, so the closed share of a gap does not depend on the effects found.
    """
    left = problem.projection.residual * problem.sd_mm()
    near = fine(left, problem.lengths, problem.kinds, problem.use, problem.projection.leverage)
    out = {}
    for kind, colour in problem.colours.items():
        least = problem.case.resolution_mm[kind] / np.sqrt(12.0)
        steps = repeat_steps(problem.case, kind)
        count = sum(int(np.count_nonzero(u)) for u, k in zip(problem.by_run(problem.use), problem.kinds, strict=True) if k == kind)
        found = [(float(np.sqrt(np.mean(steps**2) / 2.0)), steps.size)] if steps.size >= REPEATS else []
        found += [(near[kind].sd_mm, count // SHARED)] if kind in near and count // SHARED >= REPEATS else []
        sd, freedom = min(((max(sd, least), n) for sd, n in found), default=(np.inf, 1))
        chance = 1.0 - f_above((sd / colour.sd_mm) ** 2, freedom, KNOWN_FREEDOM)
        believed = sd < CLEARLY * colour.sd_mm and chance < CHANCE
        out[kind] = Floor(sd, freedom) if believed else Floor(colour.sd_mm, KNOWN_FREEDOM)
    return out


def repeat_steps(case: Case, kind: str) -> F1:
    """Return the differences, mm, of successive dwell readings at the same position of a set-up, approached from the same side.

    Slow drift contributes little to these differences; errors of position, direction and set-up contribute nothing. Each laser run has its
    own zero, so the mean of the differences between two runs is removed.
    """
    visits: dict[object, list[tuple[float, float, str]]] = {}
    for run in case.runs:
        p = run.path
        if p.kind != kind or run.deviation_mm is None or p.at.v_mm_s.any():
            continue
        places = np.round(p.at.q_mm / NEAR_MM).astype(int).tolist()
        for place, sign, t, y, good in zip(places, p.at.sign.tolist(), p.at.t_s, run.deviation_mm, run.valid, strict=True):
            if good:
                visits.setdefault((p.setup, *place, *sign), []).append((float(t), float(y), p.label))
    steps: dict[tuple[str, str], list[float]] = {}
    for visit in visits.values():
        for (_, y, before), (_, later, after) in pairwise(sorted(visit)):
            steps.setdefault((before, after), []).append(later - y)
    out = [np.array(d) if before == after else _about_mean(np.array(d)) for (before, after), d in steps.items()]
    return np.concatenate(out) if out else np.zeros(0)


def _about_mean(differences: F1) -> F1:
    """Remove the mean of the differences between two runs, and enlarge the rest to allow for the lost degree of freedom."""
    n = differences.size
    return np.asarray((differences - differences.mean())[: n if n > 1 else 0] * np.sqrt(n / max(n - 1, 1)))


def lack_of_fit(
    problem: WhitenedProblem, left_mm: Mapping[str, F1], floor: Mapping[str, Floor], agreement: Sequence[Agreement]
) -> Localization | None:
    """Find where the residuals of a solution without effects exceed noise; None if they do not.

    Parameters
    ----------
    problem : the fitted runs.
    left_mm : residual of every judged run, by label.
    floor : noise by kind of instrument, from `floors`.
    agreement : how each holdout run agrees with its prediction.
    """
    runs = problem.runs
    rest = [np.nan_to_num(left_mm[r.path.label]) / floor[r.path.kind].sd_mm for r in runs]
    louder = {kind: colour.sd_mm / floor[kind].sd_mm for kind, colour in problem.colours.items()}
    searched = zip(problem.by_run(problem.projection.residual), problem.kinds, strict=True)
    table = locate(problem.paths, tuple(r * louder[kind] for r, kind in searched)).table
    loud = tuple(r.path.label for r, e in zip(runs, rest, strict=True) if _louder(e, floor[r.path.kind], len(runs)))
    off = tuple(a.run for a in agreement if a.p < CHANCE and a.times > TIMES)
    if not (_times(np.concatenate(rest)) > TIMES or loud or off or (table and table[0].p < CHANCE)):
        return None
    location = locate(problem.paths, tuple(rest))
    if off and not loud:
        location = replace(location, runs=off)
    shaped = _shape_of([r for r in runs if not loud or r.path.label in loud], left_mm, floor)
    if shaped is None:
        return location
    depends = tuple(dict.fromkeys(("position", *(("direction",) if shaped.directions else ()), *location.depends_on)))
    return replace(shaped, tests=location.tests, runs=location.runs, depends_on=depends, table=location.table)


def unexplained(problem: WhitenedProblem, picks: Sequence[Pick], floor: Mapping[str, Floor], calm: F1) -> float:
    """Return by how much residuals of simulation and ``picks`` exceed the noise ``floor``, in nats; 0 if by less than a factor of `TIMES`.

    ``calm``: weight of each reading, shape (n,), 0 for readings with scatter from a known effect.
    """
    projection = problem.projection
    for pick in picks:
        raw = pick.raw(problem)
        projection = projection.without(problem.white(raw), pick.prior_sd(problem, raw.shape[1]))
    count = (problem.use * calm > 0).astype(np.float64)
    quieter = np.repeat([floor[k].sd_mm for k in problem.kinds], problem.lengths) / problem.sd_mm()
    noise = float(count @ ((1.0 - projection.leverage) * quieter**2))
    energy = float(count @ projection.residual**2)
    return 0.5 * (energy - noise) if energy > TIMES**2 * noise else 0.0


def _times(rest: F1) -> float:
    """Rms of residuals that are divided by the noise; exact zeros mark invalid readings."""
    read = rest[rest != 0.0]
    return float(np.sqrt(np.mean(read**2))) if read.size else 0.0


def _louder(rest: F1, floor: Floor, tried: int) -> bool:
    """Whether a run's residuals clearly exceed noise, with a significance corrected for the number of runs (``tried``)."""
    count, times = np.count_nonzero(rest), _times(rest)
    return bool(count >= FEWEST and times > TIMES and tried * f_above(times**2, count, floor.freedom) < CHANCE)


def _shape_of(runs: Sequence[CaseRun], left_mm: Mapping[str, F1], floor: Mapping[str, Floor]) -> Localization | None:
    """Describe the residuals (span, direction, period) if all runs are laser lines along the same axis; else None."""
    lines = [r for r in runs if r.path.test == "laser_linear" and np.abs(r.path.look[0]).max() > ALONG_ONE_AXIS]
    axes = {int(np.argmax(np.abs(r.path.look[0]))) for r in lines}
    if not lines or len(axes) != 1 or len(lines) < len(runs):
        return None
    a = axes.pop()
    q = np.concatenate([r.path.at.q_mm for r in lines])
    y = np.concatenate([left_mm[r.path.label] * np.sign(r.path.look[0, a]) for r in lines])
    up = np.concatenate([r.path.at.sign[:, a] for r in lines])
    good = np.isfinite(y)
    q, y, up = q[good], y[good], up[good]
    place, both = _common(q[:, a], y, up)
    noise = floor["laser"].sd_mm ** 2
    share = float((both @ both - noise * np.unique(place).size) / max(y @ y - noise * y.size, 1e-300))
    means = np.array([both[place == p].mean() for p in np.unique(place)])
    at = np.unique(place) * NEAR_MM
    top, low = int(np.argmax(means)), int(np.argmin(means))
    span = 1e3 * (means[top] - means[low])
    period = _period(at, means)
    alike = "alike in both directions" if share > COMMON else "not alike in both directions"
    shape = f"a shape along {AXES[a]}, {alike}, {span:.3g} µm from {AXES[a]} {at[low]:.4g} mm (lowest) to {at[top]:.4g} mm (highest)"
    x, y_mm, z = (float(v) for v in q[int(np.argmax(np.abs(y)))])
    ways = () if share > COMMON or not up.any() else (_loudest(y, up),)
    return Localization(axes=(AXES[a],), directions=ways, position_mm=(x, y_mm, z), period_mm=period, shape=shape)


def _common(x: F1, y: F1, up: F1) -> tuple[F1, F1]:
    """Return, for each reading, the index of its position and the mean of both directions there, shape (n,) each."""
    place = np.round(x / NEAR_MM)
    both = np.zeros(len(y))
    for p in np.unique(place):
        here = place == p
        sides = [y[here & (up == s)].mean() for s in np.unique(up[here])]
        both[here] = float(np.mean(sides))
    return place, both


def _loudest(y: F1, up: F1) -> int:
    """Return the direction of motion, 1 or -1, with the larger residuals."""
    energy = {s: float(np.mean(y[up == s] ** 2)) for s in (-1, 1) if (up == s).any()}
    return max(energy, key=lambda s: energy[s])


def _period(x: F1, y: F1) -> float | None:
    """Return the period, mm, of the wave that, added to a straight line, explains most of y; None if no wave explains enough."""
    if x.size < FEWEST:
        return None
    spacing, span = float(np.median(np.diff(x))), float(np.ptp(x))
    line = np.column_stack([np.ones(x.size), x])
    flat = y - line @ np.linalg.lstsq(line, y, rcond=None)[0]
    best, found = 0.0, None
    for period in np.geomspace(2.0 * spacing, 0.5 * span, 200):
        wave = np.column_stack([line, np.sin(2.0 * np.pi * x / period), np.cos(2.0 * np.pi * x / period)])
        left = y - wave @ np.linalg.lstsq(wave, y, rcond=None)[0]
        share = 1.0 - float(left @ left) / max(float(flat @ flat), 1e-300)
        if share > best:
            best, found = share, float(period)
    # with few positions, the two parameters of a wave always explain some share
    return found if best > max(PERIODIC, 6.0 / x.size) else None
