"""Find the standstills in the readings of a program that Abbe did not start, and assign them to the planned ones.

A "place" is a planned standstill, given by its target, mm, along the measured direction. A deviation is a reading minus target and offset.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from abbe.models.arrays import F1

GAP = 7.0
"""Cost of a place without a standstill, or a standstill without a place: minus the logarithm of its probability, one in a thousand."""
SURE = 3.0
"""An assignment that costs at most this much more than the best one counts as equally good."""
NEAR, LARGEST_MM = 0.75, 2.0
"""Largest change of the deviation from one place to the next: the share `NEAR` of the distance to the nearest other place that may be
approached from the same side, but at most `LARGEST_MM`."""
SAME = 0.25
"""Two standstills are at one place if they differ by less than this share of the largest change (`NEAR`, `LARGEST_MM`)."""
BASE_MM, PER_MM, TURN_MM = 1e-3, 3e-5, 1e-2
"""Usual change of the deviation from place to place: a constant, a part per mm of distance, and a part if the side of approach changes."""
ZERO_MM, ZERO_PER_MM = 2e-2, 5e-5
"""Usual deviation of the first place if the instrument was zeroed at target 0: a constant, and a part per mm of the target."""
INFINITE = np.inf
I1 = np.ndarray[tuple[int, ...], np.dtype[np.intp]]


@dataclass(frozen=True, slots=True)
class Match:
    """An assignment: ``pairs`` maps the index of a place to the index of its standstill; ``cost``: minus the logarithm of its probability.

    ``rival``: a standstill and two places to which it may belong, if another assignment is equally good; else None.
    """

    cost: float
    pairs: dict[int, int]
    rival: tuple[int, int, int] | None = None


@dataclass(frozen=True, slots=True)
class _Candidates:
    """Possible pairs of place and standstill, ordered by standstill. ``off``: deviation; ``reach``: `places_reach` of the place."""

    place: I1
    stand: I1
    off: F1
    reach: F1


def match(levels: F1, levels_side: F1, targets: F1, *, offset: float, noise: float, zeroed: bool, rivals: bool = True) -> Match:
    """Find the assignment of standstills to places that keeps their order at the lowest cost.

    Parameters
    ----------
    levels, levels_side : array, shape (m,)
        Readings of the standstills, and the side of approach: +1 from smaller readings, -1 from larger, 0 unknown.
    targets : array, shape (n,)
        Places, mm.
    offset : float
        Reading at target 0, mm.
    noise : float
        Standard deviation of a level, mm.
    zeroed : bool
        Whether the instrument was zeroed at target 0, so that the deviation of the first place must be small.
    rivals : bool
        Whether to look for an equally good assignment.
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
    """Return the largest allowed change of the deviation from the previous place to each place, mm, shape (n,)."""
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


def _chain(some: _Candidates, single_cost: F1, about: tuple[F1, F1, float], *, mirrored: bool = False) -> tuple[F1, I1]:
    """Return the least cost of a chain of pairs that ends at each pair, and the pair before it (-1: none); ``mirrored``: from the end."""
    targets, sides, noise = about
    cost, back = single_cost.copy(), np.full(single_cost.size, -1, dtype=np.intp)
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
        if step[best] < cost[p]:  # cheaper than a chain of this candidate alone
            cost[p], back[p] = step[best], best
    return cost, back


def _rival(some: _Candidates, through: F1, cost: float, pairs: dict[int, int], about: tuple[F1, F1, F1]) -> tuple[int, int, int] | None:
    """Find an equally good assignment that differs from ``pairs``; return a standstill and the two places to which it may belong, or None.

    If ``pairs`` leaves this standstill out and assigns another one to its place, this place is returned twice.
    """
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


# Standstills of a stream of readings, and their sides of approach.


CLEAR = 6.0
"""Two samples that differ by more than this many standard deviations show motion."""
RESOLVED = 1e-6
FLICKER = 2.5
"""Two samples of an instrument at rest differ by less than this many of its steps."""
LEAST_SAMPLES = 4
OVERSHOOT, OVERSHOOT_MM = 0.3, 0.1
"""Largest overshoot of a controller: as a share of the move, and absolute, mm."""


@dataclass(frozen=True, slots=True)
class Standstill:
    """A standstill: indices and times of its first and last sample, and the median of its readings."""

    first: int
    last: int
    start_s: float
    end_s: float
    level: float


def noise_of(y: F1) -> float:
    """Return the standard deviation of one sample from the median of second differences, which steady motion does not change."""
    second = y[2:] - 2.0 * y[1:-1] + y[:-2]
    return float(np.median(np.abs(second)) * 1.4826 / np.sqrt(6.0))


def stands(t_s: F1, y: F1, *, smallest_move: float, least_s: float, step: float = 0.0) -> tuple[Standstill, ...]:
    """Return all standstills of a stream, in order.

    Two neighbouring samples belong to one standstill if noise explains their difference. A single outlier does not end a standstill.

    Parameters
    ----------
    t_s, y : array, shape (n,)
        Sample times and readings.
    smallest_move : float
        Smallest planned move between standstills, in the unit of ``y``.
    least_s : float
        Shortest standstill that is reported.
    step : float
        Smallest step of the readings: a coarse instrument at rest flickers by one or two.
    """
    limit = max(CLEAR * np.sqrt(2.0) * noise_of(y), RESOLVED * smallest_move, FLICKER * step)
    still = np.abs(np.diff(y)) <= limit
    out: list[Standstill] = []
    for first, last in _runs(still):
        found = _stand(t_s, y, first, last)
        if out and _goes_on(out[-1], found, limit):
            found = _stand(t_s, y, out.pop().first, last)
        out.append(found)
    return tuple(s for s in out if s.last - s.first + 1 >= LEAST_SAMPLES and s.end_s - s.start_s >= least_s)


def _goes_on(before: Standstill, after: Standstill, limit: float) -> bool:
    return after.first - before.last <= 3 and abs(after.level - before.level) <= limit


def _stand(t_s: F1, y: F1, first: int, last: int) -> Standstill:
    return Standstill(first, last, float(t_s[first]), float(t_s[last]), float(np.median(y[first : last + 1])))


def _runs(still: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> list[tuple[int, int]]:
    """Return the first and last sample of each unbroken sequence of small differences."""
    edge = np.diff(np.concatenate([[0], still.astype(int), [0]]))
    return [(int(a), int(b)) for a, b in zip(np.flatnonzero(edge == 1), np.flatnonzero(edge == -1), strict=True)]


def sides(t_s: F1, y: F1, found: tuple[Standstill, ...], smallest: float) -> F1:
    """Return the side of approach of each standstill: +1 from smaller readings, -1 from larger, 0 unknown.

    The last sample before the standstill that is farther away than an overshoot shows the side. ``smallest``: smallest planned move, in the
    unit of ``y``.
    """
    out, least = np.zeros(len(found)), CLEAR * noise_of(y)
    for s in range(1, len(found)):
        one, before = found[s], found[s - 1]
        far = max(least, min(OVERSHOOT * max(abs(one.level - before.level), smallest), OVERSHOOT_MM))
        away = y[before.first : one.first] - one.level
        off = np.flatnonzero(np.abs(away) > far)
        if off.size:
            out[s] = -np.sign(away[off[-1]])
    return out


TOLERANCE = 0.3
"""A change of the reading between two standstills without motion is a jump if it is below this share of the smallest planned move."""
LONG, SHORT = 1.8, 0.4
"""A standstill is reported if it is more than LONG times or less than SHORT times as long as planned."""
JUMP_SAMPLES = 2
MATCHED = 0.5
"""Share of the planned standstills that must be found; with fewer, the stream belongs to another program."""


@dataclass(frozen=True, slots=True)
class PlannedDwell:
    """A planned standstill: target (mm along the measured direction), duration, and number of readings to take there."""

    target: float
    seconds: float
    readings: int = 1


@dataclass(frozen=True, slots=True)
class DwellReading:
    """A reading for a planned standstill: mean, standard uncertainty, time window and number of samples."""

    value: float
    u: float
    start_s: float
    end_s: float
    samples: int


@dataclass(frozen=True, slots=True)
class Dwells:
    """Result of `detect`. ``readings``: one per planned standstill, in the order of the plan; None if the standstill is missing.

    ``missing``: indices of the planned standstills not found. ``extra``: unplanned standstills, each with the index of the planned one
    before it (-1: none). ``odd``: indices of standstills much longer or shorter than planned. ``noise``: standard deviation of one sample.
    """

    readings: tuple[DwellReading | None, ...]
    missing: tuple[int, ...]
    extra: tuple[tuple[int, Standstill], ...]
    odd: tuple[int, ...]
    noise: float


def detect(t_s: F1, y: F1, planned: tuple[PlannedDwell, ...], *, settle_s: float, zero: float | None = None, step: float = 0.0) -> Dwells:
    """Match the standstills of a stream to the planned ones, in order, and take the planned readings from them.

    A missing or unplanned standstill is reported and does not shift the others.

    Parameters
    ----------
    t_s, y : array, shape (n,)
        Sample times, and readings in the unit of the targets.
    planned : tuple of PlannedDwell
        In order; neighbours must have different targets (`merged`).
    settle_s : float
        First part of each standstill, in which the axes settle and no readings are taken.
    zero : float, optional
        Reading of the instrument at target 0, if it was zeroed there. None: the match determines the offset between plan and stream, and
        is refused if two offsets explain the stream equally well.
    step : float
        Smallest step of the readings; the uncertainty of a mean contains it (GUM F.2.2.1), because samples at rest share their rounding.

    Raises
    ------
    ValueError
        The stream or the plan is too short; neighbours have the same target; the reading jumped while nothing moved; less than half of the
        plan was found; or two matches are equally good.
    """
    if t_s.size < 10 or len(planned) < 2:
        raise ValueError(f"dwells: {t_s.size} samples and {len(planned)} planned standstills given, at least 10 and 2 needed")
    targets = np.array([p.target for p in planned])
    smallest = float(np.abs(np.diff(targets)).min())
    if not smallest > 0.0:
        raise ValueError("dwells: two planned standstills in a row have the same target; plan them as one standstill with two readings")
    found = stands(t_s, y, smallest_move=smallest, least_s=SHORT * settle_s, step=step)
    tolerance = min(TOLERANCE * smallest, LARGEST_MM)
    _check_jumps(found, tolerance)
    noise = noise_of(y)
    pairs = _matched(found, sides(t_s, y, found, smallest), targets, zero, noise)
    if len(pairs) < MATCHED * len(planned):
        raise ValueError(
            f"dwells: only {len(pairs)} of {len(planned)} planned standstills were found: the stream comes from another program; "
            "start the planned one"
        )
    _check_moves(found, pairs, targets)
    lasted = {k: (found[s].end_s - found[s].start_s) / planned[k].seconds for k, s in pairs.items()}
    pairs = {k: s for k, s in pairs.items() if lasted[k] > LONG or not _either_side(k, pairs, targets)}
    readings: list[DwellReading | None] = []
    for k, plan in enumerate(planned):
        stand = found[pairs[k]] if k in pairs else None
        if stand is not None and k == 0:  # the axes have long settled: use the last seconds before the program moves
            stand = replace(stand, start_s=max(stand.start_s, stand.end_s - plan.seconds))
        elif stand is not None and (k == len(planned) - 1 or lasted[k] > LONG):  # the axis may have left later and come back
            stand = replace(stand, end_s=min(stand.end_s, stand.start_s + plan.seconds))
        readings += [None] * plan.readings if stand is None else _readings(t_s, y, stand, plan, (settle_s, noise, step))
    ends = (0, len(planned) - 1)  # the program may stand longer at its start and its end
    odd = tuple(k for k in pairs if lasted[k] < SHORT or (lasted[k] > LONG and k not in ends))
    missing = tuple(k for k in range(len(planned)) if k not in pairs)
    return Dwells(tuple(readings), missing, _extra(found, pairs), odd, noise)


def _check_jumps(found: tuple[Standstill, ...], tolerance: float) -> None:
    """Raise ValueError if the reading jumps without motion: the instrument lost counts, and all later readings are wrong."""
    for before, after in pairwise(found):
        by = after.level - before.level
        if after.first - before.last <= JUMP_SAMPLES and abs(by) < tolerance:
            at_s = after.start_s - found[0].start_s
            raise ValueError(
                f"dwells: the reading jumped by {by:.4f} mm while nothing moved, {at_s:.1f} s after the first standstill began; "
                "zero the instrument and measure again"
            )


def _either_side(k: int, pairs: dict[int, int], targets: F1) -> bool:
    """Return whether the standstill of place ``k`` may belong to the previous or next pass over the same target instead.

    This is possible if a single place, a turning point, lies between both passes, and neither this place nor the other pass has a
    standstill.
    """
    if k in (0, targets.size - 1):
        return False
    for far in (k - 2, k + 2):
        if 0 <= far < targets.size and abs(targets[far] - targets[k]) < 1e-6 and far not in pairs and (k + far) // 2 not in pairs:
            return True
    return False


def _check_moves(found: tuple[Standstill, ...], pairs: dict[int, int], targets: F1) -> None:
    """Raise ValueError if the reading steps between two standstills without samples in between, unless such a move was planned."""
    taken = {s: k for k, s in pairs.items()}
    for s, (before, after) in enumerate(pairwise(found)):
        by = after.level - before.level
        if after.first - before.last > JUMP_SAMPLES or (s in taken and s + 1 in taken):
            continue
        near = [k for k in (taken.get(s), taken.get(s + 1)) if k is not None]
        moves = [
            targets[j] - targets[i]
            for k in near
            for i, j in ((k - 1, k), (k, k + 1), (k - 2, k), (k, k + 2))
            if i >= 0 and j < targets.size
        ]
        if not any(abs(by - move) <= 0.5 * abs(move) for move in moves):
            at_s = after.start_s - found[0].start_s
            raise ValueError(
                f"dwells: the reading jumped by {by:.4f} mm {at_s:.1f} s after the first standstill began, and the plan has no such move; "
                "zero the instrument and measure again"
            )


def _extra(found: tuple[Standstill, ...], pairs: dict[int, int]) -> tuple[tuple[int, Standstill], ...]:
    """Return the unplanned standstills, each with the index of the planned one before it (-1: none)."""
    used = {s: k for k, s in pairs.items()}
    out, last = [], -1
    for s, stand in enumerate(found):
        last = used.get(s, last)
        if s not in used:
            out.append((last, stand))
    return tuple(out)


def _matched(found: tuple[Standstill, ...], side: F1, targets: F1, zero: float | None, noise: float) -> dict[int, int]:
    """Map the index of each place to that of its standstill; ValueError if two assignments are equally good.

    Without ``zero``, try all offsets that pair one of the first standstills with one of the first targets, or one of the last with one of
    the last.
    """
    levels = np.array([s.level for s in found])
    if levels.size == 0:
        return {}
    u_level = noise / np.sqrt(LEAST_SAMPLES)
    if zero is not None:
        return _unambiguous(match(levels, side, targets, offset=zero, noise=u_level, zeroed=True), found)
    few = min(6, levels.size), min(6, targets.size)
    tries = [levels[i] - targets[k] for i in range(few[0]) for k in range(few[1])]
    tries += [levels[-1 - i] - targets[-1 - k] for i in range(few[0]) for k in range(few[1])]
    reach = 0.5 * float(places_reach(targets, np.zeros(targets.size)).min())
    rising = np.sort(tries)
    groups = np.split(rising, np.flatnonzero(np.diff(rising) > reach) + 1)
    offsets = [float(np.median(group)) for group in groups]
    matches = [match(levels, side, targets, offset=offset, noise=u_level, zeroed=False, rivals=False) for offset in offsets]
    first = int(np.argmin([one.cost for one in matches]))
    best = match(levels, side, targets, offset=offsets[first], noise=u_level, zeroed=False)
    whole = len(best.pairs) >= MATCHED * targets.size
    if whole and any(one.cost < best.cost + SURE and _shifted(one.pairs, best.pairs) for one in matches):
        raise ValueError("dwells: the stream fits the plan in two ways; zero the instrument at the first target and measure again")
    return _unambiguous(best, found) if whole else best.pairs


def _unambiguous(best: Match, found: tuple[Standstill, ...]) -> dict[int, int]:
    """Return the pairs of a match; ValueError if another assignment is equally good."""
    if best.rival is None:
        return best.pairs
    stand, ours, other = best.rival
    at_s = found[stand].start_s - found[0].start_s
    which = f"planned standstill {ours + 1}" + (f" or {other + 1}" if ours != other else ", but so may another standstill")
    raise ValueError(f"dwells: the standstill that began {at_s:.1f} s after the first may be {which}; nothing is guessed, measure again")


def _shifted(one: dict[int, int], other: dict[int, int]) -> bool:
    """Return whether two matches assign most of their common standstills to different places."""
    first, second = ({s: k for k, s in pairs.items()} for pairs in (one, other))
    both = first.keys() & second.keys()
    return 2 * sum(first[s] != second[s] for s in both) > len(both)


def _readings(t_s: F1, y: F1, stand: Standstill, plan: PlannedDwell, how: tuple[float, float, float]) -> list[DwellReading | None]:
    """Split the settled part of a standstill into as many equal parts as it has planned readings, and average each."""
    settle_s, noise, step = how
    at = np.arange(stand.first, stand.last + 1)
    at = at[(t_s[at] >= stand.start_s) & (t_s[at] <= stand.end_s)]
    settled = at[t_s[at] >= min(stand.start_s + settle_s, stand.end_s - 0.4 * (stand.end_s - stand.start_s))]
    settled = settled[:-1] if settled.size > LEAST_SAMPLES else settled  # the axes may have moved at the last sample
    out: list[DwellReading | None] = []
    for part in np.array_split(settled, plan.readings):
        out.append(_mean(t_s[part], y[part], noise, step) if part.size else None)
    return out


def _mean(t_s: F1, y: F1, noise: float, step: float) -> DwellReading:
    """Return the mean without outliers, and its uncertainty from rounding and the local scatter or, if larger, the noise of the stream."""
    keep = np.abs(y - np.median(y)) <= CLEAR * max(noise, step, 1.4826 * float(np.median(np.abs(y - np.median(y)))))
    kept = y[keep]
    scatter = max(noise, float(np.std(kept, ddof=1)) if kept.size > 1 else 0.0)
    related = 1.0
    if kept.size > 5:
        rest = kept - kept.mean()
        power = float(rest @ rest)
        rho = float(rest[1:] @ rest[:-1]) / power if power > 0.0 else 0.0
        related = (1.0 + max(rho, 0.0)) / (1.0 - min(max(rho, 0.0), 0.9))
    u = float(np.hypot(scatter * np.sqrt(related / kept.size), step / np.sqrt(12.0)))
    return DwellReading(float(kept.mean()), u, float(t_s[0]), float(t_s[-1]), int(kept.size))


def named(found: Dwells, planned: tuple[PlannedDwell, ...]) -> tuple[str, ...]:
    """Return one line of text per difference from the plan; the text numbers standstills from 1."""
    lines = [f"standstill {k + 1} of {len(planned)} (at {planned[k].target:.3f} mm) is missing" for k in found.missing]
    for after, stand in found.extra:
        place = "before the first" if after < 0 else f"after standstill {after + 1}"
        lines.append(f"an unplanned standstill {place}: reading {stand.level:.3f} mm, {stand.end_s - stand.start_s:.1f} s long")
    lines += [f"standstill {k + 1} was much longer or shorter than the planned {planned[k].seconds:.1f} s" for k in found.odd]
    return tuple(lines)


def merged(planned: list[PlannedDwell]) -> tuple[PlannedDwell, ...]:
    """Merge neighbours with the same target into one standstill with all their readings and their total time."""
    out: list[PlannedDwell] = []
    for one in planned:
        if out and abs(out[-1].target - one.target) < 1e-6:
            out[-1] = replace(out[-1], seconds=out[-1].seconds + one.seconds, readings=out[-1].readings + one.readings)
        else:
            out.append(one)
    return tuple(out)
