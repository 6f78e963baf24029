"""Lack of fit: whether what is left of the runs, once the search has found nothing, is no more than noise that was known beforehand.

The search finds shapes that it knows, and a noise that is estimated from what is left holds those it does not. So the noise is asked of
repeats where there are any, and "nothing is missing" is said only of residuals that agree with it: all together, run by run, and against
position, direction, time, feed and temperature (`abbe.models.discovery.localization.locate`); and of runs never fitted only if they agree,
too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Agreement, Localization
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.localization import locate
from abbe.models.discovery.noise import CLEARLY
from abbe.models.discovery.whitened_problem import WhitenedProblem
from abbe.models.machine import AXES
from abbe.models.probability import f_above

TIMES = 1.5
"""Residuals are more than noise from so many times its rms on."""
CHANCE = 1e-3
"""What is told of one run, one place or one direction is what chance gives in fewer campaigns than this."""
FEWEST, REPEATS = 8, 20
"""Readings of a run that is judged alone; repeats from which a noise is believed."""
NEAR_MM = 0.05
"""Positions closer than this are the same one, approached again."""
ALONE = 0.999
"""A laser looks along one axis if its beam's share of it is larger."""
KNOWN_FREEDOM = 1e6
COMMON, PERIODIC = 0.8, 0.6
"""Share of a gap's energy that both directions have in common, and of that which one period explains, to be told so."""


@dataclass(frozen=True)
class Floor:
    """Noise of a reading of one instrument, mm, and the degrees of freedom that it is known with."""

    sd_mm: float
    freedom: float


def floors(problem: WhitenedProblem) -> dict[str, Floor]:
    """Noise of each instrument: of its repeats, where they say clearly less than what the fit left; that may hold what is missing."""
    out = {}
    for kind, colour in problem.colours.items():
        steps = repeat_steps(problem.case, kind)
        sd = max(float(np.sqrt(np.mean(steps**2) / 2.0)), problem.case.resolution_mm[kind] / np.sqrt(12.0)) if steps.size else np.inf
        chance = 1.0 - f_above((sd / colour.sd_mm) ** 2, steps.size, KNOWN_FREEDOM) if steps.size >= REPEATS else 1.0
        believed = sd < CLEARLY * colour.sd_mm and chance < CHANCE
        out[kind] = Floor(sd, steps.size) if believed else Floor(colour.sd_mm, KNOWN_FREEDOM)
    return out


def repeat_steps(case: Case, kind: str) -> F1:
    """How a dwelling machine's readings differ from the one before in the same set-up, at the same place from the same side, mm.

    What drifts slowly takes little part in them; what the place, the direction or the set-up does, none.
    """
    visits: dict[object, list[tuple[float, float]]] = {}
    for run in case.runs:
        p = run.path
        if p.kind != kind or run.deviation_mm is None or p.at.v_mm_s.any():
            continue
        places = np.round(p.at.q_mm / NEAR_MM).astype(int).tolist()
        for place, sign, t, y, good in zip(places, p.at.sign.tolist(), p.at.t_s, run.deviation_mm, run.valid, strict=True):
            if good:
                visits.setdefault((p.label, *place, *sign), []).append((float(t), float(y)))
    steps = [np.diff([y for _, y in sorted(v)]) for v in visits.values()]
    return np.concatenate(steps) if steps else np.zeros(0)


def lack_of_fit(
    problem: WhitenedProblem, left_mm: Mapping[str, F1], floor: Mapping[str, Floor], agreement: Sequence[Agreement]
) -> Localization | None:
    """Where a solution without effects leaves more than noise; None: nowhere.

    Parameters
    ----------
    problem : fitted runs as the present simulation leaves them. left_mm : residual of every judged run, by label.
    floor : of `floors`. agreement : of runs that were never fitted.
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
    where = locate(problem.paths, tuple(rest))
    if off and not loud:
        where = replace(where, runs=off)
    shaped = _shape_of([r for r in runs if not loud or r.path.label in loud], left_mm, floor)
    if shaped is None:
        return where
    depends = tuple(dict.fromkeys(("position", *(("direction",) if shaped.directions else ()), *where.depends_on)))
    return replace(shaped, tests=where.tests, runs=where.runs, depends_on=depends, table=where.table)


def _times(rest: F1) -> float:
    """Rms over that of the noise, of readings that count."""
    read = rest[rest != 0.0]
    return float(np.sqrt(np.mean(read**2))) if read.size else 0.0


def _louder(rest: F1, floor: Floor, tried: int) -> bool:
    """Whether one run's residuals are more than noise, by size and by chance over all runs."""
    count, times = np.count_nonzero(rest), _times(rest)
    return bool(count >= FEWEST and times > TIMES and tried * f_above(times**2, count, floor.freedom) < CHANCE)


def _shape_of(runs: Sequence[CaseRun], left_mm: Mapping[str, F1], floor: Mapping[str, Floor]) -> Localization | None:
    """What is left along the axis that all runs look along: how far it goes, which way, its period; None where there is no such axis."""
    lines = [r for r in runs if r.path.test == "laser_linear" and np.abs(r.path.look[0]).max() > ALONE]
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
    """Place of every reading as a number, and what both directions have in common there, shape (n,) each."""
    place = np.round(x / NEAR_MM)
    both = np.zeros(len(y))
    for p in np.unique(place):
        here = place == p
        sides = [y[here & (up == s)].mean() for s in np.unique(up[here])]
        both[here] = float(np.mean(sides))
    return place, both


def _loudest(y: F1, up: F1) -> int:
    """Direction in which more is left."""
    energy = {s: float(np.mean(y[up == s] ** 2)) for s in (-1, 1) if (up == s).any()}
    return max(energy, key=lambda s: energy[s])


def _period(x: F1, y: F1) -> float | None:
    """Period that explains most of a shape beside a straight line, mm; None where none explains enough, or too few places were seen."""
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
    # two parameters of few places explain a share by themselves
    return found if best > max(PERIODIC, 6.0 / x.size) else None
