"""Localization of a signal: tests, runs, axes, directions, time and place that hold most of its energy."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from abbe.models.arrays import F1, F2
from abbe.models.discovery.answer import Localization
from abbe.models.effects.path import Path
from abbe.models.machine import AXES

SHARE = 0.9
"""A signal is located at the runs and times that hold this share of its energy."""
PRESENT = 0.2
"""A test, axis or direction counts as affected from this share of the mean square of the strongest one on."""
LOCAL = 0.25
"""A signal is confined in place or time when the part that holds it is at most this share of the campaign."""

K = TypeVar("K", str, int)


@dataclass(frozen=True)
class _Rows:
    """All readings of some runs: energy, its share along each axis, clock, place, direction of the path, test and run by number."""

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
        Contribution of the effect to the readings, in one unit for all (mm, or sigmas).

    Returns
    -------
    Localization
        Tests and runs that see it, axes it lies along (by the square of the look), directions of the path, and, only where it is confined,
        the time and the place that hold 90 % of its energy. Empty for a signal of zeros.
    """
    rows = _rows(paths, signal)
    if not rows.energy.sum() > 0:
        return Localization()
    mean = {p.label: float(np.mean(s**2)) for p, s in zip(paths, signal, strict=True)}
    along = rows.along.T @ rows.energy / (rows.along.sum(axis=0) + 1e-12)
    ways = {d: float(np.mean(rows.energy[rows.direction == d])) for d in (1, -1) if (rows.direction == d).any()}
    time_s, (place, radius) = _time(rows), _place(rows)
    return Localization(
        tests=_strong(_by_test(paths, signal)), axes=_strong(dict(zip(AXES, along.tolist(), strict=True))), directions=_strong(ways),
        runs=_strong(mean), time_s=time_s, position_mm=place, radius_mm=radius,
    )  # fmt: skip


def _rows(paths: tuple[Path, ...], signal: Iterable[F1]) -> _Rows:
    return _Rows(
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


def _time(rows: _Rows) -> tuple[float, float] | None:
    """Shortest interval that holds the share, if it is a small part of the campaign."""
    order = np.argsort(rows.t_s, kind="stable")
    t, held = rows.t_s[order], np.cumsum(rows.energy[order])
    low, high = np.interp([(1 - SHARE) / 2 * held[-1], (1 + SHARE) / 2 * held[-1]], held, t)
    return (float(low), float(high)) if high - low <= LOCAL * np.ptp(t) else None


def _place(rows: _Rows) -> tuple[tuple[float, float, float] | None, float | None]:
    weight = rows.energy / rows.energy.sum()
    centre = weight @ rows.q_mm
    away = np.linalg.norm(rows.q_mm - centre, axis=1)
    order = np.argsort(away)
    radius = float(away[order][min(int(np.searchsorted(np.cumsum(weight[order]), SHARE)), len(away) - 1)])
    if radius > LOCAL * float(np.linalg.norm(np.ptp(rows.q_mm, axis=0))) or np.mean(away <= radius) > LOCAL:
        return None, None
    return (float(centre[0]), float(centre[1]), float(centre[2])), radius
