"""Candidates for what is missing: every effect at every key over a grid of its non-linear parameters, all scored at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np

from models.arrays import F1, F2
from models.discovery.scene import Scene
from models.discovery.space import rows_of
from models.effects.effect import Effect, Form, Values
from models.effects.path import Path

UNNAMED = "unnamed_"
"""Names that begin so mean: something is missing, but it is nothing that the catalogue knows."""
GENEROUS = 3.0
"""Prior standard deviation of a strength over the top of its usual range."""
SEEN = 1e-5
"""A candidate of which less than this share of its square is left shows nothing."""


@dataclass(frozen=True)
class Pick:
    """An effect with its key, non-linear parameters and the freedoms of form that it uses."""

    effect: Effect
    key: str
    values: Values = field(default_factory=dict)
    forms: tuple[Form, ...] = ()

    @property
    def label(self) -> str:
        """``name:key``."""
        return self.effect.label(self.key)

    @property
    def unnamed(self) -> bool:
        """Whether it is a generic rival."""
        return self.effect.name.startswith(UNNAMED)

    def raw(self, scene: Scene) -> F2:
        """Columns, mm per unit of each coefficient, shape (n, k); those of the forms last."""
        parts = [scene.raw(self.effect.signal, self.key, self.values)]
        parts += [scene.raw(f.signal, self.key, self.values) for f in self.forms]
        return np.concatenate(parts, axis=1)

    def prior_sd(self, scene: Scene, columns: int) -> F1:
        """Prior standard deviation of each coefficient, shape (columns,)."""
        return np.full(columns, coefficient_sd(self.effect, self.values, scene.paths[0], self.key))


def coefficient_sd(effect: Effect, values: Values, path: Path, key: str) -> float:
    """The coefficient at which the strength is `GENEROUS` times the top of what is usual, for any power law of the strength."""
    top = GENEROUS * effect.typical[1]
    if effect.name.startswith(UNNAMED):
        return top * effect.per_unit
    unit = np.zeros(effect.signal((path,), key, values)[0].shape[1])
    sizes = []
    for c in (1.0, 4.0):
        unit[0] = c * effect.per_unit
        sizes.append(abs(effect.strength(unit, values)) / effect.per_unit)
    power = np.log(sizes[1] / sizes[0]) / np.log(4.0)
    return float(effect.per_unit * (top / sizes[0]) ** (1.0 / power))


def competing(effects: Sequence[Effect], includes: frozenset[str]) -> tuple[Effect, ...]:
    """Effects of the mean that the present simulation does not hold already."""
    return tuple(e for e in effects if e.kind == "mean" and not includes & set(e.absorbed_by))


def grid(effect: Effect) -> list[dict[str, float]]:
    """Every combination of the starts of an effect's non-linear parameters."""
    return [dict(zip((p.name for p in effect.shape), v, strict=True)) for v in product(*(p.starts for p in effect.shape))]


def starts_of(effects: Sequence[Effect]) -> list[Pick]:
    """Every effect at every key at every start."""
    return [Pick(e, key, values) for e in effects for key in e.keys for values in grid(e)]


@dataclass(frozen=True)
class Bank:
    """All candidates of a scene with what the present simulation leaves of them.

    Attributes
    ----------
    picks : tuple of Pick, one per group.
    first : array of int, where each group's columns begin; size : how many each has.
    columns : array, shape (n, K), whitened. own : array, shape (K,): square of each before anything was taken out.
    gram : tuple of arrays (k, k), one per group: columns^T M columns. moment : array, shape (K,): columns^T M y.
    prior_sd : array, shape (K,). logs : array, shape (groups,): sum over a group's columns of the log of how many readings see them.
    """

    picks: tuple[Pick, ...]
    first: np.ndarray[tuple[int], np.dtype[np.intp]]
    size: np.ndarray[tuple[int], np.dtype[np.intp]]
    columns: F2
    own: F1
    gram: tuple[F2, ...]
    moment: F1
    prior_sd: F1
    logs: F1

    def gains(self, y: F1, rows: F2) -> F1:
        """Chi-square that each group takes away after ``rows`` (k, n) of earlier picks were taken out too, shape (groups,)."""
        also = rows @ self.columns
        moment = self.moment - also.T @ (rows @ y)
        out = np.zeros(len(self.picks))
        for k in np.unique(self.size):
            at = np.flatnonzero(self.size == k)
            index = self.first[at][:, None] + np.arange(k)
            taken = also[:, index].transpose(1, 2, 0)
            gram = np.stack([self.gram[i] for i in at]) - taken @ taken.transpose(0, 2, 1)
            out[at] = _gains(gram, moment[index], self.own[index], self.prior_sd[index])
        return out


def _gains(gram: np.ndarray, moment: F2, own: F2, prior_sd: F2) -> F1:
    """Gains of groups of one size: moment^T (gram + prior^-2)^-1 moment; what is hardly visible counts as noise of the arithmetic."""
    k = gram.shape[1]
    eye = np.eye(k)
    weight = prior_sd**-2.0 + SEEN * own + 1e-30
    solved = np.linalg.solve(gram + weight[:, :, None] * eye, moment[:, :, None])[:, :, 0]
    return np.asarray(np.maximum((solved * moment).sum(axis=1), 0.0))


def bank_of(scene: Scene, picks: Sequence[Pick]) -> Bank:
    """Columns of all candidates; those that no run sees are left out."""
    kept, blocks = [], []
    for p in picks:
        raw = p.raw(scene)
        if np.abs(raw).max() > 0.0:
            kept.append(p)
            blocks.append(raw)
    size = np.array([b.shape[1] for b in blocks], dtype=np.intp)
    first = np.concatenate([[0], np.cumsum(size)[:-1]]).astype(np.intp)
    sd = np.concatenate([p.prior_sd(scene, b.shape[1]) for p, b in zip(kept, blocks, strict=True)])
    logs = np.array([np.log(np.maximum((np.abs(b) > SEEN * np.abs(b).max()).sum(axis=0), 2)).sum() for b in blocks])
    columns = _whitened_in_parts(scene, blocks)
    space = scene.space
    seen = space.taken @ columns
    moment = columns.T @ space.y - seen.T @ space.moment
    gram = tuple(
        columns[:, f : f + k].T @ columns[:, f : f + k] - seen[:, f : f + k].T @ seen[:, f : f + k]
        for f, k in zip(first, size, strict=True)
    )
    own = np.einsum("nk,nk->k", columns, columns)
    return Bank(tuple(kept), first, size, columns, own, gram, moment, sd, logs)


PART = 40


def _whitened_in_parts(scene: Scene, blocks: list[F2]) -> F2:
    """Whitened blocks side by side, some at a time and each forgotten then: whitening takes several copies of what it is given."""
    columns = np.empty((scene.gap.size, sum(b.shape[1] for b in blocks)))
    at = 0
    for start in range(0, len(blocks), PART):
        part = np.concatenate(blocks[start : start + PART], axis=1)
        blocks[start : start + PART] = [np.zeros((0, 0))] * len(blocks[start : start + PART])
        columns[:, at : at + part.shape[1]] = scene.white(part)
        at += part.shape[1]
    return columns


def gain_of(scene: Scene, pick: Pick, rows: F2) -> float:
    """Chi-square that one pick takes away after ``rows`` of others were taken out too; seven digits, for trials."""
    space = scene.space
    columns = scene.white(pick.raw(scene))
    seen, also = space.taken_short @ columns.astype(np.float32), rows @ columns
    gram = columns.T @ columns - (seen.T @ seen).astype(np.float64) - also.T @ also
    moment = columns.T @ space.residual - also.T @ (rows @ space.y)
    sd = pick.prior_sd(scene, columns.shape[1])
    return float(_gains(gram[None], moment[None], np.einsum("nk,nk->k", columns, columns)[None], sd[None])[0])


def whitened(scene: Scene, pick: Pick) -> tuple[F2, F2]:
    """Whitened columns of a pick and what the simulation leaves of them, kept for as long as the scene."""
    name = f"{pick.label} {sorted(pick.values.items())} {[f.name for f in pick.forms]}"
    if name not in scene.kept:
        columns = scene.white(pick.raw(scene))
        scene.kept[name] = columns, scene.space.left(columns)
    return scene.kept[name]


def rows_for(scene: Scene, picks: Sequence[Pick]) -> F2:
    """Rows that take out several picks together, shape (k, n)."""
    if not picks:
        return np.zeros((0, scene.gap.size))
    parts = [whitened(scene, p) for p in picks]
    columns, left = (np.concatenate([p[i] for p in parts], axis=1) for i in (0, 1))
    sd = np.concatenate([p.prior_sd(scene, part[0].shape[1]) for p, part in zip(picks, parts, strict=True)])
    sd = np.minimum(sd, 1.0 / np.sqrt(SEEN * np.einsum("nk,nk->k", columns, columns) + 1e-300))
    return rows_of(left, columns, sd)


def with_values(pick: Pick, values: Values) -> Pick:
    """The same effect with other non-linear parameters."""
    return replace(pick, values=values)
