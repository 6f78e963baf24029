"""Candidates for the missing effect: every effect for every key (axis or error motion), over a grid of its non-linear parameters."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
import scipy
from numpy.typing import NDArray

from abbe.models.arrays import F1, F2
from abbe.models.discovery.whitened_problem import WhitenedProblem, rows_of
from abbe.models.effects.effect import Effect, Form, Values

UNNAMED = "unnamed_"
"""Prefix of the names of structures that the catalogue does not contain."""
GENEROUS = 3.0
"""Prior standard deviation of a strength, as a multiple of the top of its usual range."""
VISIBLE_SHARE = 1e-5
"""A candidate is invisible when the projection leaves less than this fraction of its squared norm."""
MOST_CACHED = 16
"""Number of picks whose columns are cached; a search often returns to recent picks."""
Short = NDArray[np.float32]
PART = 20
"""Number of candidates whitened at once; whitening makes several copies of its input."""


@dataclass(frozen=True)
class Pick:
    """A candidate: an effect with key (axis or error motion), values of its non-linear parameters and the forms added to it (`Form`)."""

    effect: Effect
    key: str
    values: Values = field(default_factory=dict)
    forms: tuple[Form, ...] = ()

    @property
    def label(self) -> str:
        """Label of the effect: ``name:key``, or the name alone without a key."""
        return self.effect.label(self.key)

    @property
    def unnamed(self) -> bool:
        """Whether the effect is a structure without a name, outside the catalogue."""
        return self.effect.name.startswith(UNNAMED)

    def raw(self, problem: WhitenedProblem) -> F2:
        """Signal in all readings, mm per unit of each coefficient, shape (n, k); the columns of the forms come last."""
        parts = [problem.raw(self.effect.signal, self.key, self.values)]
        parts += [problem.raw(f.signal, self.key, self.values) for f in self.forms]
        return np.concatenate(parts, axis=1)

    @cached_property
    def start(self) -> str:
        """Identifier of the pick's columns: label, non-linear parameters and forms."""
        return f"{self.label} {sorted(self.values.items())} {[f.name for f in self.forms]}"

    def prior_sd(self, problem: WhitenedProblem, columns: int) -> F1:
        """Prior standard deviation of each coefficient, shape (columns,)."""
        if self.label not in problem.widths:
            problem.widths[self.label] = int(self.effect.signal(problem.paths[:1], self.key, self.values)[0].shape[1])
        return np.full(columns, coefficient_sd(self.effect, self.values, problem.widths[self.label]))


def coefficient_sd(effect: Effect, values: Values, width: int) -> float:
    """Return the prior sd of an effect's coefficients: the value that gives `GENEROUS` times the largest usual strength.

    The strength may be any power of the coefficient. ``width``: number of columns of the effect along one run.
    """
    top = GENEROUS * effect.typical[1]
    if effect.name.startswith(UNNAMED):
        return top * effect.per_unit
    unit = np.zeros(width)
    sizes = []
    for c in (1.0, 4.0):
        unit[0] = c * effect.per_unit
        sizes.append(abs(effect.strength(unit, values)) / effect.per_unit)
    power = np.log(sizes[1] / sizes[0]) / np.log(4.0)
    return float(effect.per_unit * (top / sizes[0]) ** (1.0 / power))


def competing(effects: Sequence[Effect], includes: frozenset[str]) -> tuple[Effect, ...]:
    """Return the effects on the mean reading that the present simulation (``includes``) does not contain."""
    return tuple(e for e in effects if e.kind == "mean" and not includes & set(e.absorbed_by))


def grid(effect: Effect) -> list[dict[str, float]]:
    """Return every combination of the start values of an effect's non-linear parameters."""
    return [dict(zip((p.name for p in effect.shape), v, strict=True)) for v in product(*(dict.fromkeys(p.starts) for p in effect.shape))]


def starts_of(effects: Sequence[Effect]) -> list[Pick]:
    """Return a pick for every effect, key and combination of start values."""
    return [Pick(e, key, values) for e in effects for key in e.keys for values in grid(e)]


@dataclass(frozen=True, eq=False)
class Bank:
    """All candidates of a problem, with the present simulation projected out; the columns of one pick form a group.

    Attributes
    ----------
    picks : tuple of Pick, one per group.
    known : group index of every requested pick, by `Pick.start`; -1 if it changes no reading.
    first, size : arrays of int: first column of each group, and its number of columns.
    parts : arrays, shape (columns, n): whitened columns as rows; no group is split between parts. Single precision suffices, because the
        bank only chooses where a refinement starts; the parts take half of the memory of a search.
    own : array, shape (K,): squared norm of each column before projection; K: number of all columns.
    gram : tuple of arrays (k, k), one per group: columns^T M columns (M: `SignalProjection`). rhs : array, shape (K,): columns^T M y.
    prior_sd : array, shape (K,). logs : array, shape (groups,): sum over the columns of log(number of readings that a column changes).
    """

    picks: tuple[Pick, ...]
    known: Mapping[str, int]
    first: np.ndarray[tuple[int], np.dtype[np.intp]]
    size: np.ndarray[tuple[int], np.dtype[np.intp]]
    parts: tuple[Short, ...]
    own: F1
    gram: tuple[F2, ...]
    rhs: F1
    prior_sd: F1
    logs: F1

    def gains(self, y: F1, rows: F2) -> F1:
        """Reduction of chi-square of readings y by each group, shape (groups,); ``rows`` (k, n) project out the picks made before.

        Coefficients may have any sign (compare `abbe.models.effects.effect.Effect.one_sign`), so that the reduction is an upper bound.
        """
        short = rows.astype(np.float32)
        also = np.concatenate([np.zeros((len(rows), 0)), *(short @ part.T for part in self.parts)], axis=1)
        rhs = self.rhs - also.T @ (rows @ y)
        out = np.zeros(len(self.picks))
        for k in np.unique(self.size):
            at = np.flatnonzero(self.size == k)
            index = self.first[at][:, None] + np.arange(k)
            taken = also[:, index].transpose(1, 2, 0)
            gram = np.stack([self.gram[i] for i in at]) - taken @ taken.transpose(0, 2, 1)
            out[at] = _gains(gram, rhs[index], self.own[index], self.prior_sd[index])
        return out

    def groups(self) -> Iterator[_Group]:
        """Yield the groups in order, each with its columns."""
        rows = (part[i:] for part in self.parts for i in range(len(part)))  # from each column on to the end of its part
        starts = dict(zip(self.first.tolist(), range(len(self.picks)), strict=True))
        for column, after in enumerate(rows):
            if column in starts:
                i = starts[column]
                at = slice(column, column + int(self.size[i]))
                yield _Group(after[: self.size[i]], self.own[at], self.gram[i], self.rhs[at], float(self.logs[i]))


@dataclass(frozen=True)
class _Group:
    """Data of one pick in a bank."""

    rows: Short
    own: F1
    gram: F2
    rhs: F1
    log: float


def _gains(gram: np.ndarray, rhs: F2, own: F2, prior_sd: F2) -> F1:
    """Gains of groups with equal numbers of columns, rhs^T (gram + prior^-2)^-1 rhs; columns hardly visible after projection add little."""
    k = gram.shape[1]
    eye = np.eye(k)
    solved = np.linalg.solve(gram + _ridge(own, prior_sd)[:, :, None] * eye, rhs[:, :, None])[:, :, 0]
    return np.asarray(np.maximum((solved * rhs).sum(axis=1), 0.0))


def _ridge(own: np.ndarray, prior_sd: np.ndarray) -> np.ndarray:
    """Return the amounts to add to the diagonal of a Gram matrix, in the shape of ``own``."""
    return np.asarray(prior_sd**-2.0 + VISIBLE_SHARE * own + 1e-30)


def bank_of(problem: WhitenedProblem, picks: Sequence[Pick]) -> Bank:
    """Build the bank of all picks that change a reading; reuse columns of the problem's other banks in memory."""
    picks = list({p.start: p for p in picks}.values())  # two picks beside which the same effect is tried ask for it twice
    asked = [p.start for p in picks]
    banks = [b for b in problem.banks if isinstance(b, Bank)]
    same = next((b for b in banks if list(b.known) == asked), None)
    if same is not None:
        return replace(same, picks=tuple(p for p in picks if same.known[p.start] >= 0))
    blind = {name for b in banks for name, i in b.known.items() if i < 0}
    old = {name: g for b in banks for (name, g) in zip((n for n, i in b.known.items() if i >= 0), b.groups(), strict=True)}
    kept: list[Pick] = []
    parts, groups = list[Short](), list[_Group]()
    for start in range(0, len(picks), PART):
        some = [p for p in picks[start : start + PART] if p.start not in blind]
        found = {**old, **dict(_groups(problem, [p for p in some if p.start not in old]))}
        some = [p for p in some if p.start in found]
        if some:
            parts.append(np.concatenate([found[p.start].rows for p in some]))
            groups += [replace(found[p.start], rows=parts[-1][:0]) for p in some]
            kept += some
    number = {p.start: i for i, p in enumerate(kept)}
    size = np.array([g.own.size for g in groups], dtype=np.intp)
    bank = Bank(
        tuple(kept), {name: number.get(name, -1) for name in asked}, np.cumsum(size) - size, size, tuple(parts),
        np.concatenate([np.zeros(0), *(g.own for g in groups)]), tuple(g.gram for g in groups),
        np.concatenate([np.zeros(0), *(g.rhs for g in groups)]),
        np.concatenate([np.zeros(0), *(p.prior_sd(problem, g.own.size) for p, g in zip(kept, groups, strict=True))]),
        np.array([g.log for g in groups]),
    )  # fmt: skip
    problem.banks.add(bank)
    return bank


def _groups(problem: WhitenedProblem, picks: Sequence[Pick]) -> Iterator[tuple[str, _Group]]:
    """Yield the identifier (`Pick.start`) and the group of each pick that changes a reading."""
    blocks = [(p, raw) for p, raw in ((p, p.raw(problem)) for p in picks) if raw.any()]
    if not blocks:
        return
    raw = np.concatenate([b.T for _, b in blocks]).T  # columns one after the other, the layout in which whitening is fastest
    widths = [(p, b.shape[1]) for p, b in blocks]
    del blocks  # each copy of the columns takes megabytes
    columns, projection = problem.white(raw), problem.projection
    coordinates = projection.coordinates(columns)
    rhs = columns.T @ projection.y - coordinates.T @ projection.y_coordinates
    own = np.einsum("nk,nk->k", columns, columns)
    short = columns.T.astype(np.float32)
    start = 0
    for p, width in widths:
        at = slice(start, start + width)
        start = at.stop
        gram = columns[:, at].T @ columns[:, at] - coordinates[:, at].T @ coordinates[:, at]
        size = np.abs(raw[:, at])
        sees = (size > VISIBLE_SHARE * size.max()).sum(axis=0)
        yield p.start, _Group(short[at], own[at], gram, rhs[at], float(np.log(np.maximum(sees, 2)).sum()))


@dataclass(frozen=True, eq=False)
class Taken:
    """Picks that are projected out: their identifiers (`Pick.start`), and their rows, shape (k, n) (`SignalProjection.rows`)."""

    names: tuple[str, ...]
    rows: F2


def gain_of(problem: WhitenedProblem, pick: Pick, taken: Taken) -> float:
    """Reduction of chi-square by one pick beside others; the result is cached, as a repeated search asks for the same gains."""
    asked = pick.start, taken.names
    if asked not in problem.gains:
        problem.gains[asked] = _gain(problem, pick, taken.rows)
    return problem.gains[asked]


def _gain(problem: WhitenedProblem, pick: Pick, rows: F2) -> float:
    """Compute the gain in double precision. Where the projection leaves little of a column, single precision errs by several units in a
    gain of thousands.
    """
    projection = problem.projection
    columns = problem.white(pick.raw(problem))
    coordinates, also = projection.coordinates(columns), rows @ columns
    gram = columns.T @ columns - coordinates.T @ coordinates - also.T @ also
    rhs = columns.T @ projection.residual - also.T @ (rows @ projection.y)
    own, sd = np.einsum("nk,nk->k", columns, columns), pick.prior_sd(problem, columns.shape[1])
    if pick.effect.one_sign:
        return max(_positive_gain(gram, sign * rhs, own, sd) for sign in (1.0, -1.0))
    return float(_gains(gram[None], rhs[None], own[None], sd[None])[0])


def _positive_gain(gram: F2, rhs: F1, own: F1, prior_sd: F1) -> float:
    """Gain of one group (`_gains`) whose coefficients may not be negative."""
    root = np.linalg.cholesky(gram + np.diag(_ridge(own, prior_sd)))
    whole = np.linalg.solve(root, rhs)
    return float(whole @ whole - scipy.optimize.nnls(root.T, whole)[1] ** 2)


def whitened(problem: WhitenedProblem, pick: Pick) -> tuple[F2, F2]:
    """Return the whitened columns of a pick before and after the projection, using the problem's cache."""
    name = pick.start
    if name not in problem.column_cache:
        if len(problem.column_cache) >= MOST_CACHED:
            problem.column_cache.pop(next(iter(problem.column_cache)))
        columns = problem.white(pick.raw(problem))
        problem.column_cache[name] = columns, problem.projection.left(columns)
    return problem.column_cache[name]


def taken(problem: WhitenedProblem, picks: Sequence[Pick]) -> Taken:
    """Project out several picks together."""
    if not picks:
        return Taken((), np.zeros((0, problem.gap.size)))
    parts = [whitened(problem, p) for p in picks]
    columns, left = (np.concatenate([p[i] for p in parts], axis=1) for i in (0, 1))
    sd = np.concatenate([p.prior_sd(problem, part[0].shape[1]) for p, part in zip(picks, parts, strict=True)])
    sd = np.minimum(sd, 1.0 / np.sqrt(VISIBLE_SHARE * np.einsum("nk,nk->k", columns, columns) + 1e-300))
    return Taken(tuple(p.start for p in picks), rows_of(left, columns, sd))


def with_values(pick: Pick, values: Values) -> Pick:
    """Return the pick with other values of its non-linear parameters."""
    return replace(pick, values=values)
