"""What a campaign could not have shown, whether it is there or not: asked where nothing was found."""

from __future__ import annotations

import numpy as np

from models.discovery.answer import Unseen
from models.discovery.case import Case
from models.effects.path import Path

LATE_S = 3600.0
"""A repeat this long after the first time is a late one: axes and spindle warm up within 20 minutes to two hours (effects.md, thermal)."""
OTHER_FEED = 1.3
"""Feeds that differ by less are one feed."""
GROWS = "what grows with the feed (lag, servo mismatch, vibration of the drives) looks like geometry"
TURNS = "what differs between the way there and the way back over the same points (lost motion, lateral play) looks like geometry"
LENGTH = "what belongs to the bar (its length, its balls, its temperature) looks like an error of the machine"
SLOW = "what comes slowly (axes, spindle and air that warm up) looks like geometry, or like a set-up"
SCALE = "an error of all scales together is told by the bar's own length alone, and the bar's length by nothing"
MOVING = "what shows in motion on a curve only (reversals of two axes, servo mismatch, lag) leaves no trace"


def unseen(case: Case) -> tuple[Unseen, ...]:
    """What the fitted runs of a campaign cannot show, with the measurement that would; empty where nothing of the kind is known.

    A run that was never fitted does not count: nothing is looked for in it.
    """
    paths = [r.path for r in case.of("identify")]
    bars, lasers = [p for p in paths if p.kind == "bar"], [p for p in paths if p.kind == "laser"]
    out: list[Unseen] = []
    if not paths:
        return ()
    if not bars:
        out.append(Unseen(MOVING, "no ball-bar run was fitted", "ballbar"))
    else:
        feeds = [float(np.median(p.feed_mm_min)) for p in bars]
        if max(feeds) < OTHER_FEED * min(feeds):
            out.append(Unseen(GROWS, "all ball-bar runs have one feed", "second_feed"))
        if len({float(np.sign(p.direction[0])) for p in bars}) < 2:
            out.append(Unseen(TURNS, "all ball-bar runs go one way round", "opposite_direction"))
        if len({round(p.radius_mm) for p in bars}) < 2:
            out.append(Unseen(LENGTH, "all ball-bar runs have one radius", "second_radius"))
    if not lasers:
        out.append(Unseen(SCALE, "no laser run was fitted", "laser_diagonals"))
    if not _late(paths):
        out.append(Unseen(SLOW, f"no path was run again {LATE_S / 3600.0:.0f} h later or more", "longer_session"))
    return tuple(out)


def _late(paths: list[Path]) -> bool:
    """Whether some path was run again long after its first time."""
    first: dict[tuple[object, ...], float] = {}
    for p in sorted(paths, key=lambda p: float(p.at.t_s[0])):
        place = tuple(np.round(p.centre_mm)) if p.kind == "bar" else tuple(np.round(np.abs(p.look[0]), 2))
        began = first.setdefault((p.test, round(p.radius_mm), place), float(p.at.t_s[0]))
        if float(p.at.t_s[0]) - began >= LATE_S:
            return True
    return False
