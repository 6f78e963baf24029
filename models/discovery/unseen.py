"""Blind spots of a campaign in which nothing was found."""

from __future__ import annotations

import numpy as np

from abbe.models.arrays import F1
from abbe.models.discovery.answer import Unseen
from abbe.models.discovery.case import Case
from abbe.models.discovery.experiment.candidates import one_feed, one_radius, one_way
from abbe.models.effects.path import Path

LATE_S = 3600.0
"""A repeat counts as late after this time: axes and spindle warm up within 20 minutes to two hours (effects.md, thermal)."""
SAME_MM = 2.0
"""Two paths are the same when their extents agree to this in every direction: at another feed the readings lie elsewhere along it."""
SAME_LOOK = 0.01
"""Beams whose unit vectors differ by less in every direction are parallel."""
GROWS = "what grows with the feed (lag, servo mismatch, vibration of the drives) looks like geometry"
TURNS = "what differs between the way there and the way back over the same points (lost motion, lateral play) looks like geometry"
LENGTH = "what belongs to the bar (its length, its balls, its temperature) looks like an error of the machine"
SLOW = "what comes slowly (axes, spindle and air that warm up) looks like geometry, or like a set-up"
SCALE = "an error of all scales together is told by the bar's own length alone, and the search does not use the bar's certificate"
MOVING = "what shows in motion on a curve only (reversals of two axes, servo mismatch, lag) leaves no trace"


def unseen(case: Case) -> tuple[Unseen, ...]:
    """Blind spots of the fitted runs of a campaign, each with the measurement that would cover it.

    Runs that were not fitted do not count: the search does not use them.
    """
    paths = [r.path for r in case.of("identify")]
    bars, lasers = [p for p in paths if p.kind == "bar"], [p for p in paths if p.kind == "laser"]
    out: list[Unseen] = []
    if not paths:
        return ()
    if not bars:
        out.append(Unseen(MOVING, "no ball-bar run was fitted", "ballbar"))
    else:
        if one_feed(bars):
            out.append(Unseen(GROWS, "all ball-bar runs have one feed", "second_feed"))
        if one_way(bars):
            out.append(Unseen(TURNS, "all ball-bar runs go one way round", "opposite_direction"))
        if one_radius(bars):
            out.append(Unseen(LENGTH, "all ball-bar runs have one radius", "second_radius"))
    if not lasers:
        out.append(Unseen(SCALE, "no laser run was fitted", "laser_diagonals"))
    if not _late(paths):
        out.append(Unseen(SLOW, f"no path was run again {LATE_S / 3600.0:.0f} h later or more", "longer_session"))
    return tuple(out)


def _late(paths: list[Path]) -> bool:
    """Whether some path was repeated, in either direction, `LATE_S` or more after its first run."""
    first: list[tuple[str, F1, float]] = []
    for p in sorted(paths, key=lambda p: float(p.at.t_s[0])):
        place, began = _place(p), float(p.at.t_s[0])
        before = next((t for test, known, t in first if test == p.test and np.all(np.abs(place - known) <= SAME_MM)), None)
        if before is None:
            first.append((p.test, place, began))
        elif began - before >= LATE_S:
            return True
    return False


def _place(path: Path) -> F1:
    """Signature of a path regardless of direction: extent along every axis, a bar's cup and radius, mm; a beam's direction, scaled."""
    reach = [path.at.q_mm.min(axis=0), path.at.q_mm.max(axis=0)]
    if path.kind == "bar":
        return np.concatenate([*reach, path.centre_mm, [path.radius_mm]])
    beam = path.look[0]
    back = beam[np.flatnonzero(np.abs(beam) > 0.1)[0]] < 0.0
    return np.concatenate([*reach, (-beam if back else beam) * SAME_MM / SAME_LOOK])
