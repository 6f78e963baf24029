"""Localization of the gap between measurement and simulation (`locate`), and of an effect's signal (`localize_signal`).

The gap is located by statistical tests of the whitened residuals, grouped by run, axis, direction, feed, time, position, frequency and
temperature. A signal is located by the kinds of measurement, runs, axes, directions, time and position that hold most of its energy.

Every p-value is family-wise (Sidak over all statistical tests). Energy is tested reading by reading and in block sums, which are sensitive
to smooth deviations; the noise variance is enlarged by `ROOM`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Localization, Significance
from abbe.models.effects.path import Path
from abbe.models.machine import AXES
from abbe.models.probability import chi2_above, normal_above

SHARE = 0.9
"""A signal is located at the time and position that hold this share of its energy."""
PRESENT = 0.2
"""A test, run, axis or direction counts as affected if its mean square is at least this fraction of the largest."""
LOCAL = 0.25
"""A signal is confined in position or time if the part that contains it is at most this fraction of the campaign."""

K = TypeVar("K", str, int)
BLOCKS = 12
"""Blocks of equal size per run."""
LAGS = 10
SIGNIFICANT = 0.01
CELLS = 4
"""Position cells along each axis."""
LEAST = 20
NEIGHBOURS, DIFFER = " (neighbours)", " up and down differ"
"""Suffixes in the table of tests: correlation of a run's neighbouring residuals; difference between the two directions of an axis."""
ROOM = 1.15
"""Factor on the noise variance, which is known to some percent only."""
DEPENDS = {
    "direction": "direction",
    "feed": "feed",
    "time": "time",
    "position": "position",
    "temperature": "temperature",
    "frequency": "time",
}


@dataclass(frozen=True)
class _SignalRows:
    """Table with a row per reading: squared signal, squared direction cosines of bar or beam, time, position, direction along the path."""

    energy: F1
    along: F2
    t_s: F1
    q_mm: F2
    direction: F1


def localize_signal(paths: tuple[Path, ...], signal: tuple[F1, ...]) -> Localization:
    """Locate the energy of an effect's signal.

    Parameters
    ----------
    signal : one array (n,) per path
        Contribution of the effect to the readings; all in the same unit (mm or sigmas).

    Returns
    -------
    Localization
        Tests, runs, axes and directions of the path in which the signal is strong, and, only if it is confined, the time and the position
        that hold 90 % of its energy. Empty for a signal of zeros. Runs in one direction only do not locate a direction.
    """
    rows = _signal_rows(paths, signal)
    if not rows.energy.sum() > 0:
        return Localization()
    mean = {p.label: float(np.mean(s**2)) for p, s in zip(paths, signal, strict=True)}
    along = rows.along.T @ rows.energy / (rows.along.sum(axis=0) + 1e-12)
    ways = {d: float(np.mean(rows.energy[rows.direction == d])) for d in (1, -1) if (rows.direction == d).any()}
    directions = _strong(ways) if len(ways) == 2 else ()
    time_s, (place, radius) = _time(rows), _place(rows)
    return Localization(
        tests=_strong(_by_test(paths, signal)), axes=_strong(dict(zip(AXES, along.tolist(), strict=True))), directions=directions,
        runs=_strong(mean), time_s=time_s, position_mm=place, radius_mm=radius,
    )  # fmt: skip


def _signal_rows(paths: tuple[Path, ...], signal: Iterable[F1]) -> _SignalRows:
    return _SignalRows(
        np.concatenate([s**2 for s in signal]),
        np.concatenate([p.look**2 for p in paths]),
        np.concatenate([p.at.t_s for p in paths]),
        np.concatenate([p.at.q_mm for p in paths]),
        np.concatenate([np.sign(p.direction) for p in paths]),
    )


def _by_test(paths: tuple[Path, ...], signal: tuple[F1, ...]) -> dict[str, float]:
    return {
        test: float(np.mean(np.concatenate([s**2 for p, s in zip(paths, signal, strict=True) if p.test == test])))
        for test in dict.fromkeys(p.test for p in paths)
    }


def _strong(sizes: dict[K, float]) -> tuple[K, ...]:
    most = max(sizes.values(), default=0.0)
    return tuple(k for k, v in sizes.items() if most > 0 and v >= PRESENT * most)


def _time(rows: _SignalRows) -> tuple[float, float] | None:
    """Time interval, s, that holds the central `SHARE` of the signal's energy; None if longer than `LOCAL` of the readings' time span."""
    order = np.argsort(rows.t_s, kind="stable")
    t, cumulative = rows.t_s[order], np.cumsum(rows.energy[order])
    low, high = np.interp([(1 - SHARE) / 2 * cumulative[-1], (1 + SHARE) / 2 * cumulative[-1]], cumulative, t)
    return (float(low), float(high)) if high - low <= LOCAL * np.ptp(t) else None


def _place(rows: _SignalRows) -> tuple[tuple[float, float, float] | None, float | None]:
    weight = rows.energy / rows.energy.sum()
    centre = weight @ rows.q_mm
    away = np.linalg.norm(rows.q_mm - centre, axis=1)
    order = np.argsort(away)
    radius = float(away[order][min(int(np.searchsorted(np.cumsum(weight[order]), SHARE)), len(away) - 1)])
    if radius > LOCAL * float(np.linalg.norm(np.ptp(rows.q_mm, axis=0))) or np.mean(away <= radius) > LOCAL:
        return None, None
    return (float(centre[0]), float(centre[1]), float(centre[2])), radius


@dataclass(frozen=True)
class _Group:
    kind: str
    value: str
    statistic: float
    p: float
    rows: np.ndarray[tuple[int], np.dtype[np.bool_]] | None = None


@dataclass(frozen=True)
class _Rows:
    """Whitened residuals of all runs, with the number of the run and of the block of each reading."""

    rest: F1
    run: np.ndarray[tuple[int], np.dtype[np.intp]]
    block: np.ndarray[tuple[int], np.dtype[np.intp]]


def locate(paths: tuple[Path, ...], whitened: tuple[F1, ...]) -> Localization:
    """Find where residuals exceed noise.

    Parameters
    ----------
    paths : runs.
    whitened : one array (n,) per run
        Whitened residuals, of variance 1 for noise alone; exact zeros mark missing readings.

    Returns
    -------
    Localization
        ``table``: every test, smallest p first. The other fields: the significant results (1 %, family-wise), empty if there are none.
    """
    rows = _rows(paths, whitened)
    found = [
        *_by_group(paths, rows),
        *_whiteness(paths, whitened),
        *_direction(paths, rows),
        *_temperature(paths, rows),
        *_lines(paths, rows),
    ]
    tried = max(len(found), 1)
    table = sorted(
        (replace(g, p=float(-np.expm1(tried * np.log1p(-min(g.p, 1.0 - 1e-12))))) for g in found), key=lambda g: (g.p, g.kind, g.value)
    )
    significant = [g for g in table if g.p < SIGNIFICANT]
    significance = tuple(Significance(g.kind, g.value, g.statistic, g.p) for g in table)
    if not significant:
        return Localization(table=significance)

    def values(kind: str) -> tuple[str, ...]:
        return tuple(dict.fromkeys(g.value.removesuffix(NEIGHBOURS).removesuffix(DIFFER) for g in significant if g.kind == kind))

    spread = localize_signal(paths, _excess(rows, paths))
    both = len({float(d) for p in paths for d in np.sign(p.direction)} - {0.0}) == 2  # one direction alone says nothing of the other
    return Localization(
        tests=values("test") or values("instrument"), axes=values("axis"), directions=tuple(int(v) for v in values("direction") if both),
        runs=values("run"), time_s=spread.time_s, position_mm=spread.position_mm, radius_mm=spread.radius_mm,
        depends_on=tuple(dict.fromkeys(DEPENDS[g.kind] for g in significant if g.kind in DEPENDS and (both or g.kind != "direction"))),
        table=significance,
    )  # fmt: skip


def _rows(paths: tuple[Path, ...], whitened: tuple[F1, ...]) -> _Rows:
    run = np.repeat(np.arange(len(paths)), [p.n for p in paths])
    block, first = np.zeros(len(run), dtype=np.intp), 0
    for k, p in enumerate(paths):
        count = max(min(BLOCKS, p.n // 4), 1)
        block[run == k] = first + np.arange(p.n) * count // max(p.n, 1)
        first += count
    return _Rows(np.concatenate(whitened), run, block)


def _excess(rows: _Rows, paths: tuple[Path, ...]) -> tuple[F1, ...]:
    """Return the size of the residuals above noise, the same for all readings of a block, one array per run."""
    count = np.bincount(rows.block)
    total = np.bincount(rows.block, rows.rest) ** 2 / np.maximum(count, 1)
    energy = np.bincount(rows.block, rows.rest**2) - count
    above = np.maximum(np.maximum(total - 6.0, energy / np.sqrt(2.0 * np.maximum(count, 1)) - 3.0), 0.0)
    return tuple(np.split(np.sqrt(above / np.maximum(count, 1))[rows.block], np.cumsum([p.n for p in paths])[:-1]))


def _by_group(paths: tuple[Path, ...], rows: _Rows) -> Iterator[_Group]:
    """Test the energy of the residuals by run, test, instrument, feed, axis, position and set-up."""
    q = np.concatenate([p.at.q_mm for p in paths])
    look = np.concatenate([p.look**2 for p in paths])
    for kind, names in (
        ("run", [p.label for p in paths]), ("test", [p.test for p in paths]), ("instrument", [p.kind for p in paths]),
    ):  # fmt: skip
        named = np.array(names)[rows.run]
        for name in dict.fromkeys(names):
            yield _energy(kind, name, rows, (named == name).astype(np.float64))
    feed = np.concatenate([np.round(p.feed_mm_min) for p in paths])
    for f in np.unique(feed)[:12]:
        yield _energy("feed", f"{f:g}", rows, (feed == f).astype(np.float64))
    for a, axis in enumerate(AXES):
        yield _energy("axis", axis, rows, look[:, a] ** 2)
        edges = np.linspace(q[:, a].min(), q[:, a].max() + 1e-9, CELLS + 1)
        for low, high in pairwise(edges):
            yield _energy("position", f"{axis} {low:.0f} to {high:.0f} mm", rows, ((q[:, a] >= low) & (q[:, a] < high)).astype(np.float64))
    t = np.concatenate([p.at.t_s for p in paths])
    for setup in dict.fromkeys(p.setup for p in paths):
        inside = np.isin(rows.run, [k for k, p in enumerate(paths) if p.setup == setup])
        yield _energy("time", f"{t[inside].min():.0f} to {t[inside].max():.0f} s", rows, inside.astype(np.float64))


def _energy(kind: str, value: str, rows: _Rows, weight: F1) -> _Group:
    """Test the weighted energy of block sums and of single readings against noise; p is twice the smaller p of both tests."""
    read = rows.rest != 0.0
    w = weight * read
    count = np.bincount(rows.block, read)
    mean = np.bincount(rows.block, w) / np.maximum(count, 1)
    sums = np.bincount(rows.block, rows.rest) ** 2 / np.maximum(count, 1)
    p_block = _weighted_p(mean[count > 3], sums[count > 3])
    p_single = _weighted_p(w[read], rows.rest[read] ** 2)
    statistic = float(w @ rows.rest**2 / max(w.sum(), 1e-12))
    return _Group(kind, value, statistic, min(1.0, 2.0 * min(p_block, p_single)))


def _weighted_p(weight: F1, square: F1) -> float:
    """Probability that noise gives a weighted sum of squares at least as large (Satterthwaite)."""
    if weight.sum() <= 0:
        return 1.0
    scale, freedom = float(weight @ weight / weight.sum()), float(weight.sum() ** 2 / (weight @ weight))
    return float(chi2_above(weight @ square / (scale * ROOM), freedom)) if freedom >= 2.0 else 1.0


def _whiteness(paths: tuple[Path, ...], whitened: tuple[F1, ...]) -> Iterator[_Group]:
    """Test each run for correlation of neighbouring residuals: Ljung-Box over the first ten lags.

    In a short run, one spectral line of white noise that is strong by chance correlates all lags at once. Chi-square over ten independent
    lags then gives too small a p: 1e-7 for a value that one of 4000 draws of 74 readings reaches. So p is at least the probability of such
    a line at one of n/2 frequencies.
    """
    for p, r in zip(paths, whitened, strict=True):
        if p.n < 4 * LAGS:
            continue
        e = r - r.mean()
        rho = np.array([e[k:] @ e[:-k] for k in range(1, LAGS + 1)]) / max(float(e @ e), 1e-300)
        q = p.n * (p.n + 2.0) * float(np.sum(rho**2 / (p.n - np.arange(1, LAGS + 1))))
        line = 0.5 * p.n * np.exp(-0.5 * np.sqrt(q * p.n / LAGS))
        yield _Group("run", p.label + NEIGHBOURS, q / LAGS, min(1.0, max(float(chi2_above(q / ROOM**2, LAGS)), float(line))))


def _direction(paths: tuple[Path, ...], rows: _Rows) -> Iterator[_Group]:
    """Test each direction of the path, and for each axis the difference between its two directions of motion."""
    way = np.concatenate([np.sign(p.direction) for p in paths])
    for d in (1, -1):
        yield _energy("direction", f"{d:d}", rows, (way == d).astype(np.float64))
    sign = np.concatenate([p.at.sign * p.look for p in paths])
    for a, axis in enumerate(AXES):
        z = _score(sign[:, a], rows)
        yield _Group("axis", axis + DIFFER, z, float(2.0 * normal_above(abs(z) / np.sqrt(ROOM))))


def _temperature(paths: tuple[Path, ...], rows: _Rows) -> Iterator[_Group]:
    """Test whether residuals follow a temperature sensor times the position along an axis, as an expansion does."""
    for sensor in sorted(set.intersection(*(set(p.at.temp_c) for p in paths)) if paths else ()):
        value = np.concatenate([p.at.temp_c[sensor] for p in paths])
        if np.ptp(value) < 0.05:
            continue
        moved = [np.concatenate([p.look[:, a] * (p.at.q_mm[:, a] - p.machine.centre_mm[a]) for p in paths]) for a in range(3)]
        z = max((_score((value - value.mean()) * m, rows) for m in moved), key=abs)
        yield _Group("temperature", sensor, z, min(1.0, float(6.0 * normal_above(abs(z) / np.sqrt(ROOM)))))


def _score(column: F1, rows: _Rows) -> float:
    """Inner product of a column with the residuals, in standard deviations of noise."""
    parts = np.bincount(rows.block, column * rows.rest)
    return float(parts.sum() / np.sqrt(max(float(np.sum((column * (rows.rest != 0)) ** 2)), 1e-300)))


def _lines(paths: tuple[Path, ...], rows: _Rows) -> Iterator[_Group]:
    """Test the strongest spectral line between 1/100 Hz and 1/15 Hz over all bar runs, along each axis."""
    bars = [k for k, p in enumerate(paths) if p.kind == "bar"]
    inside = np.isin(rows.run, bars)
    if inside.sum() < LEAST:
        return
    t = np.concatenate([p.at.t_s for p in paths])[inside]
    look = np.concatenate([p.look for p in paths])[inside]
    rest = rows.rest[inside]
    size = int(2 ** np.ceil(np.log2(2.5 * np.ptp(t) + 2.0)))
    f = np.arange(size // 2 + 1) / size
    band = (f > 0.01) & (f < 1.0 / 15.0)
    cell = (t - t.min()).astype(np.intp)
    for a, axis in enumerate(AXES):
        power = np.abs(np.fft.rfft(np.bincount(cell, look[:, a] * rest, size))[band]) ** 2 / max(
            0.5 * float(look[:, a] @ look[:, a]), 1e-12
        )
        k = int(np.argmax(power))
        tried = max(float(np.ptp(t)) * (1.0 / 15.0 - 0.01), 1.0)
        p = float(-np.expm1(tried * np.log1p(-np.exp(-min(0.5 * power[k] / ROOM, 700.0)) * (1 - 1e-12))))
        yield _Group("frequency", f"{axis}, period {1.0 / f[band][k]:.1f} s", float(power[k]), p)
