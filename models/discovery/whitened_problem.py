"""Readings of a campaign made ready for the search: present simulation fitted, noise known, everything it may still change taken out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from weakref import WeakSet

import numpy as np
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.discovery.baseline import Baseline
from abbe.models.discovery.case import Case, CaseRun
from abbe.models.discovery.noise import Colour, level, lone, unscaled
from abbe.models.discovery.projection import ROWS, SignalSpace
from abbe.models.effects.effect import Signal, Values
from abbe.models.effects.path import Path

FIRST_NOISE = {"bar": Colour(4e-4), "laser": Colour(2.5e-4)}
STEPS = 2
WIDE = 10.0
"""Testing takes out the simulation's unknowns with priors this much wider than usual, so that nothing rests on what is usual."""
ROUNDS = 2
LOUDEST_MM = 0.1
"""Prior standard deviation of what is taken out besides."""
STEADY = 0.02
"""Noise that changes by less is known."""
FITTED = 3.0
"""The same of the point about which the simulation is linearised."""


@dataclass(frozen=True)
class WhitenedProblem:
    """Identify runs, stacked in the order of time.

    Attributes
    ----------
    paths : as the fitted machine looks along them.
    gap : array, shape (n,): reading less the fitted simulation, mm.
    use : array, shape (n,): 1, or 0 for readings that do not count (flagged, or lone ones far off).
    theta : array, shape (p,): unknowns of the fitted simulation.
    tangent : columns of the simulation's unknowns, whitened but for the size of the noise.
    space : what is left of the whitened gap.
    also : array, shape (n, k): columns that are no part of the simulation and are taken out too (waves of a vibration), mm per mm.
    kept : whitened columns of picks and what the simulation leaves of them; banks : banks of candidates of this very scene that somebody
        still holds; widths : columns of an effect along one run, by label. Work that is not done twice, no part of what the scene says.
    """

    case: Case
    base: Baseline
    runs: tuple[CaseRun, ...]
    paths: tuple[Path, ...]
    gap: F1
    use: F1
    theta: F1
    colours: Mapping[str, Colour]
    tangent: Tangent
    space: SignalSpace
    also: F2
    kept: dict[str, tuple[F2, F2]] = field(default_factory=dict)
    banks: WeakSet[object] = field(default_factory=WeakSet)
    widths: dict[str, int] = field(default_factory=dict)

    @property
    def lengths(self) -> tuple[int, ...]:
        """Readings per run."""
        return tuple(p.n for p in self.paths)

    @property
    def kinds(self) -> tuple[str, ...]:
        """Instrument of every run."""
        return tuple(p.kind for p in self.paths)

    def white(self, columns: F2) -> F2:
        """Whitened columns (n, k); readings that do not count are zero."""
        return unscaled(columns * self.use[:, None], self.lengths, self.kinds, self.colours) / self.sd_mm()[:, None]

    def raw(self, signal: Signal, key: str, values: Values) -> F2:
        """Columns of an effect over all runs, mm, shape (n, k)."""
        return np.concatenate(signal(self.paths, key, values))

    def sd_mm(self) -> F1:
        """Noise of every reading, shape (n,)."""
        return np.repeat([self.colours[k].sd_mm for k in self.kinds], self.lengths)

    def by_run(self, values: F1) -> list[F1]:
        """Stacked values (n,) run by run."""
        return np.split(values, np.cumsum(self.lengths)[:-1])


@dataclass(frozen=True)
class Slopes:
    """Derivatives (n, p) with seven digits: they are first order about the perfect machine and right to 1e-4 anyway."""

    short: NDArray[np.float32]

    @classmethod
    def of(cls, runs: Sequence[CaseRun], base: Baseline) -> Slopes:
        """Of the readings of runs with respect to the simulation's unknowns."""
        out = np.empty((sum(r.path.n for r in runs), base.size), dtype=np.float32)
        start = 0
        for run in runs:
            out[start : start + run.path.n] = base.linear(run.data(), np.zeros(base.size))[1]
            start += run.path.n
        return cls(out)

    def __matmul__(self, theta: F1) -> F1:
        """Change of every reading, mm, shape (n,)."""
        parts = [self.short[i : i + ROWS].astype(np.float64) @ theta for i in range(0, len(self.short), ROWS)]
        return np.concatenate(parts) if parts else np.zeros(0)


@dataclass(frozen=True)
class Tangent:
    """Derivatives of all readings with respect to the simulation's unknowns about the perfect machine, whitened for noise of 1 mm.

    Errors are micrometres, so they turn bar and beam by 1e-4 at most: the derivatives do not change, only the reading itself is taken
    exactly. ``columns`` (n, p); ``gram`` (p, p) of the rows of each instrument; ``raw`` (n, p) as they are.
    """

    raw: Slopes
    columns: F2
    gram: Mapping[str, F2]

    @classmethod
    def of(cls, raw: Slopes, use: F1, lengths: Sequence[int], kinds: Sequence[str], colours: Mapping[str, Colour]) -> Tangent:
        """Whiten and multiply out once, run by run: there is never more than one large matrix besides what is given."""
        n, p = raw.short.shape
        columns = np.empty((n, p))
        gram = {kind: np.zeros((p, p)) for kind in dict.fromkeys(kinds)}
        start = 0
        for length, kind in zip(lengths, kinds, strict=True):
            at = slice(start, start + length)
            part = unscaled(np.asfortranarray(raw.short[at] * use[at, None]), (length,), (kind,), colours)
            columns[at] = part
            gram[kind] += part.T @ part
            start += length
        return cls(raw, columns, gram)

    def blend(self, colours: Mapping[str, Colour]) -> F2:
        """Columns^T columns of whitened columns, shape (p, p)."""
        return np.asarray(sum(g / colours[kind].sd_mm ** 2 for kind, g in self.gram.items()))


def ordered(runs: Sequence[CaseRun]) -> tuple[CaseRun, ...]:
    """Runs by the time of their first reading, so that the order in which they were handed over does not matter."""
    return tuple(sorted(runs, key=lambda r: (float(r.path.at.t_s[0]), r.path.label)))


def scene_of(case: Case, base: Baseline) -> WhitenedProblem:
    """Fit the present simulation to the identify runs and take it out."""
    runs = ordered(case.of("identify"))
    use = np.concatenate([r.valid.astype(float) for r in runs])
    paths, n = tuple(r.path for r in runs), use.size
    tangent = Tangent.of(Slopes.of(runs, base), use, [p.n for p in paths], [p.kind for p in paths], FIRST_NOISE)
    scene = WhitenedProblem(
        case, base, runs, paths, np.zeros(n), use, np.zeros(base.size), FIRST_NOISE, tangent, SignalSpace.nothing(n), np.zeros((n, 0))
    )
    scene = replace(scene, gap=np.concatenate([r.data().deviation_mm for r in runs]))
    for _ in range(STEPS):
        scene = linearised(scene, np.zeros((n, 0)), np.zeros(0))
    return quieted(scene, ())


def linearised(scene: WhitenedProblem, extra: F2, extra_sd: F1) -> WhitenedProblem:
    """One step towards the exact simulation, together with columns of effects (mm per unit, n x k) that stay outside of it."""
    base, tangent = scene.base, scene.tangent
    data = [r.data() for r in scene.runs]
    sd_mm = scene.sd_mm()[:, None]
    white = scene.white(np.column_stack([scene.gap + tangent.raw @ scene.theta, extra]))
    y, more = white[:, 0], white[:, 1:]
    cross = (tangent.columns.T @ (white / sd_mm)).T
    gram = np.block([[tangent.blend(scene.colours), cross[1:].T], [cross[1:], more.T @ more]])
    sd = np.concatenate([base.prior_sd * FITTED, extra_sd])
    gram = gram * sd[:, None] * sd
    gram.flat[:: len(gram) + 1] += 1.0
    solution = sd * np.linalg.solve(gram, sd * np.concatenate([cross[0], more.T @ y]))
    theta = solution[: base.size]
    value = np.concatenate([base.read(d, theta) for d in data])
    paths = tuple(base.along(r.path, d, theta) for r, d in zip(scene.runs, data, strict=True))
    gap = np.concatenate([d.deviation_mm for d in data]) - value
    scene.kept.clear()  # another scene takes its place: what was only kept for speed would be as large
    return replace(scene, theta=theta, gap=gap, paths=paths, kept={}, banks=WeakSet())


def taken_out(scene: WhitenedProblem) -> WhitenedProblem:
    """The same with its space made anew from gap, columns and noise."""
    y = scene.white(scene.gap[:, None])[:, 0]
    tangent = scene.tangent
    scene.kept.clear()
    space = SignalSpace.of(y, tangent.columns, tangent.blend(scene.colours), scene.base.prior_sd * WIDE, 1.0 / scene.sd_mm())
    if scene.also.shape[1]:
        space = space.without(scene.white(scene.also), np.full(scene.also.shape[1], LOUDEST_MM))
    return replace(scene, space=space, kept={}, banks=WeakSet())


def quieted(scene: WhitenedProblem, found: Sequence[tuple[F2, F1]]) -> WhitenedProblem:
    """The same with the noise that is left once the effects ``found`` (raw columns, prior sd) are taken out too."""
    for _ in range(ROUNDS):
        scene = taken_out(scene)
        space = scene.space
        for raw, sd in found:
            space = space.without(scene.white(raw), sd)
        left = space.residual * scene.sd_mm()
        use = scene.use * lone(left, scene.lengths, scene.kinds)
        colours = level(left, scene.lengths, scene.kinds, use, space.leverage, scene.case.resolution_mm)
        if (use != scene.use).any():
            scene = replace(scene, use=use, tangent=Tangent.of(scene.tangent.raw, use, scene.lengths, scene.kinds, colours))
        small = all(abs(colours[k].sd_mm / scene.colours[k].sd_mm - 1.0) < STEADY for k in colours)
        scene = replace(scene, colours=colours)
        if small:
            break
    return taken_out(scene)
