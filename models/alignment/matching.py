"""Which standstill of a stream is which place of a plan: both are in order, either may lack some of the other's.

A place is told by how far it is from the one before it and by the side from which it was approached, not by where it lies absolutely: a
thermal drift, the machine's own errors and a wavelength that is a little off move all of them, but neighbours alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from abbe.models.arrays import F1

GAP = 7.0
"""What it costs to leave a place or a standstill without a partner: minus the logarithm of how often that happens (one in a thousand)."""
SURE = 3.0
"""Another explanation that costs less than this much more is as good."""
NEAR, LARGEST_MM = 0.75, 2.0
"""From one place to the next the deviation may change by this share of the distance to the nearest other place that is approached from the
same side (farther, the standstill is another place), at most by so much."""
SAME = 0.25
"""Standstills that differ by less than this share of the same distance are at one place."""
BASE_MM, PER_MM, TURN_MM = 1e-3, 3e-5, 1e-2
"""By so much the deviation usually changes from place to place: anyhow, for each millimetre between them, and where the side changes."""
ZERO_MM, ZERO_PER_MM = 2e-2, 5e-5
"""So far off the first place may lie, for an instrument that was zeroed at target 0."""
INFINITE = np.inf
I1 = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


@dataclass(frozen=True, slots=True)
class Match:
    """``pairs``: number of the place to number of the standstill; ``cost``; ``rival``: a standstill and the two places that it may be, if
    two explanations are as good."""

    cost: float
    pairs: dict[int, int]
    rival: tuple[int, int, int] | None = None


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Pairs that are possible, ordered by standstill: place, standstill, deviation, and by how much it may have changed."""

    place: I1
    stand: I1
    off: F1
    reach: F1


def match(levels: F1, levels_side: F1, targets: F1, *, offset: float, noise: float, zeroed: bool, rivals: bool = True) -> Match:
    """Cheapest assignment in order.

    Parameters
    ----------
    levels, levels_side : array, shape (m,)
        Readings of the standstills, and from which side each was approached: +1 from smaller readings, -1 from larger, 0 nobody knows.
    targets : array, shape (n,)
        Places, mm.
    offset : float
        Of the readings against the places; known (``zeroed``) or tried.
    noise : float
        Standard deviation of a level.
    rivals : bool
        Whether to look for an explanation that is as good.
    """
    n, m = targets.size, levels.size
    sides = np.concatenate([[0.0], np.sign(np.diff(targets))])
    reach = places_reach(targets, sides)
    some = _candidates(levels - offset, levels_side, targets, sides, reach)
    if some.place.size == 0:
        return Match(GAP * (n + m), {})
    start: F1 = np.asarray(GAP * (some.place + some.stand) + (_first_cost(some, targets) if zeroed else 0.0), dtype=np.float64)
    end: F1 = np.asarray(GAP * (n - 1 - some.place + m - 1 - some.stand), dtype=np.float64)
    about = targets, sides, noise
    forward, back = _chain(some, start, about)
    last = int(np.argmin(forward + end))
    cost, pairs = float((forward + end)[last]), dict[int, int]()
    while last >= 0:
        pairs[int(some.place[last])] = int(some.stand[last])
        last = int(back[last])
    pairs = dict(sorted(pairs.items()))
    if not rivals:
        return Match(cost, pairs)
    behind, _ = _chain(_reversed(some), end[::-1], about, mirrored=True)
    return Match(cost, pairs, _rival(some, forward + behind[::-1], cost, pairs, (targets, levels, reach)))


def places_reach(targets: F1, sides: F1) -> F1:
    """How far the deviation of each place may be off that of the one before it, (n,) mm."""
    away = np.abs(targets[:, None] - targets[None, :])
    other = (away > 1e-6) & ((sides[:, None] * sides[None, :]) >= 0.0)
    nearest = np.where(other, away, np.inf).min(axis=1)
    return np.asarray(np.minimum(NEAR * nearest, LARGEST_MM))


def _candidates(levels: F1, levels_side: F1, targets: F1, sides: F1, reach: F1) -> _Candidates:
    off = levels[:, None] - targets[None, :]
    usual = float(np.median(np.abs(np.diff(targets))))
    possible = (np.abs(off) <= np.clip(NEAR * usual, 0.1, LARGEST_MM)) & (levels_side[:, None] * sides[None, :] >= 0.0)
    stand, place = np.nonzero(possible)
    return _Candidates(place, stand, off[stand, place], reach[place])


def _first_cost(some: _Candidates, targets: F1) -> F1:
    scale = np.hypot(ZERO_MM, ZERO_PER_MM * np.abs(targets[some.place]))
    return np.asarray(np.log1p((some.off / scale) ** 2))


def _reversed(some: _Candidates) -> _Candidates:
    return _Candidates(some.place[::-1], some.stand[::-1], some.off[::-1], some.reach[::-1])


def _chain(some: _Candidates, alone: F1, about: tuple[F1, F1, float], *, mirrored: bool = False) -> tuple[F1, I1]:
    """Least cost of a chain that ends at each candidate, and the one before it (-1: none). ``mirrored``: from the end to the beginning."""
    targets, sides, noise = about
    cost, back = alone.copy(), np.full(alone.size, -1, dtype=np.intp)
    sign = -1 if mirrored else 1
    at, side = targets[some.place], sides[some.place]
    for p in range(1, cost.size):
        places, stands = sign * (some.place[p] - some.place[:p]), sign * (some.stand[p] - some.stand[:p])
        change = np.abs(some.off[p] - some.off[:p])
        limit = some.reach[:p] if mirrored else some.reach[p]
        scale = np.sqrt(noise**2 + BASE_MM**2 + (PER_MM * (at[p] - at[:p])) ** 2 + np.where(side[p] * side[:p] < 0.0, TURN_MM, 0.0) ** 2)
        step = cost[:p] + GAP * (places + stands - 2) + np.log1p((change / scale) ** 2)
        step = np.where((places > 0) & (stands > 0) & (change <= limit), step, INFINITE)
        best = int(np.argmin(step))
        # from the end, ``alone`` is what a chain costs that begins here; a longer one may cost less
        if step[best] < cost[p]:
            cost[p], back[p] = step[best], best
    return cost, back


def _rival(some: _Candidates, through: F1, cost: float, pairs: dict[int, int], about: tuple[F1, F1, F1]) -> tuple[int, int, int] | None:
    """A standstill that another explanation, as good as the best, takes for another place; or a place that it sees elsewhere."""
    targets, levels, reach = about
    taken = {s: k for k, s in pairs.items()}
    for p in np.flatnonzero(through < cost + SURE):
        k, s = int(some.place[p]), int(some.stand[p])
        ours = taken.get(s)
        if ours is not None and abs(targets[ours] - targets[k]) > 1e-6:
            return s, ours, k
        if ours is None and k in pairs and abs(levels[s] - levels[pairs[k]]) > SAME * reach[k]:
            return s, k, k
    return None
