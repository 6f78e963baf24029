"""From a proposed measurement to recipes that the sequencer can run, laid beside what the campaign has measured already."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from models.machine import AXES, Machine
from models.paths.lines import DIAGONALS
from service.errors import StrokeError
from service.sequences.campaigns import verification
from service.sequences.check import dry_run_campaign
from service.sequences.recipes import Diagonal, Helix, Linear, Recipe, as_point
from service.sequences.steps import CampaignPlan

SHORTER = 0.6
SLOW = 0.4
"""The second feed is slower: no machine is asked for more than it was asked before."""
DENSER = 2.0
"""A path through a place has this many times the turns."""
EQUATOR = 0.05
"""A place that is lower than the cup by less than this share of the radius is still on the upper half."""


@dataclass(frozen=True)
class NextPlan:
    """``plan``: what the machine measures next; None if nothing of it can be run. ``by_hand``: what a person has to do elsewhere."""

    plan: CampaignPlan | None
    by_hand: tuple[str, ...]


def next_plan(
    adds: list[str],
    machine: Machine,
    runs: list[dict[str, Any]],
    *,
    name: tuple[str, str],
    max_feed_mm_min: float,
    about: dict[str, Any] | None = None,
) -> NextPlan:
    """Recipes for what a discovery wants to have added (``next_test.adds``).

    Parameters
    ----------
    runs : list of dict
        What was measured so far: second feeds and late repeats are of the first helix of it.
    name : tuple of str
        Of the new campaign, and what its labels and set-ups begin with, so that they can stand beside the old ones.
    about : dict, optional
        Where something without a name lives (``where`` of a finding, ``runs`` the one that is to be measured again): a helix is repeated
        several times in one set-up, any other run by hand; another radius passes through its place.
    """
    recipes: list[Recipe] = []
    by_hand = []
    like = _first_helix(machine, runs if about is None else _showing(runs, about))
    place = (about or {}).get("position_mm")
    makers = MAKERS if about is None else _makers_about(runs, about)
    for add in adds:
        make = makers.get(add)
        if make is None:
            by_hand.append(add)
        else:
            recipes += make(like, name[1])
    plans = [r.plan(machine) for r in recipes]
    if not plans:
        return NextPlan(None, tuple(by_hand))
    plan = CampaignPlan(name[0], tuple(plans))
    try:
        dry_run_campaign(machine, plan, max_feed_mm_min)
    except StrokeError:  # the old centre has no room for a whole hemisphere
        smaller = [_shrunk(r, 0.5, place) if isinstance(r, Helix) else r for r in recipes]
        plan = CampaignPlan(name[0], tuple(r.plan(machine) for r in smaller))
        dry_run_campaign(machine, plan, max_feed_mm_min)
    return NextPlan(plan, tuple(by_hand))


def _makers_about(runs: list[dict[str, Any]], about: dict[str, Any]) -> dict[str, Callable[[Helix, str], list[Recipe]]]:
    """What the sequencer can run to see again what has no name; a repeat only if it is a helix that is to be repeated."""
    makers = MAKERS | {"longer_session": _repeats, "second_radius": partial(_through, about.get("position_mm"))}
    again = [r["test"] for r in runs if r.get("run_id") in about.get("runs", [])]
    return makers if "ballbar_helix" in again else {k: v for k, v in makers.items() if k not in ("longer_session", "ballbar")}


def _showing(runs: list[dict[str, Any]], about: dict[str, Any]) -> list[dict[str, Any]]:
    """Runs, first those that are to be measured again."""
    return sorted(runs, key=lambda run: run.get("run_id") not in about.get("runs", []))


def _shrunk(helix: Helix, scale: float, place: list[float] | None) -> Helix:
    """A helix with a shorter bar about the same centre; about one nearer to a place, so that its sphere still passes there."""
    if place is None:
        return replace(helix, radius_mm=scale * helix.radius_mm)
    at, centre = np.asarray(place, dtype=np.float64), np.asarray(helix.centre_mm, dtype=np.float64)
    away = float(np.linalg.norm(centre - at))
    radius = scale * helix.radius_mm
    towards = (centre - at) / away if away > 0.0 else np.array([0.0, 0.0, -1.0])
    return replace(helix, radius_mm=radius, centre_mm=as_point(at + radius * towards))


def _through(place: list[float] | None, like: Helix, name: str) -> list[Recipe]:
    """Twice the turns on another sphere through a place; without one, another radius as usual."""
    if place is None:
        return _named(like, name, "radius", radius_mm=SHORTER * like.radius_mm)
    opens: Literal[1, -1] = 1 if place[2] >= like.centre_mm[2] - EQUATOR * like.radius_mm else -1
    return _named(_shrunk(like, SHORTER, place), name, "radius", turns=DENSER * like.turns, opens=opens)


def _repeats(like: Helix, name: str) -> list[Recipe]:
    """There, back and there again in one set-up: each starts where the one before ends."""
    ways: tuple[Literal[1, -1], ...] = (1, -1, 1) if like.direction > 0 else (-1, 1, -1)
    last = len(ways) - 1
    return [
        replace(like, label=f"{name}-late{k + 1}", setup_id=f"{name}-late", direction=way, mount=k == 0, unmount=k == last)
        for k, way in enumerate(ways)
    ]


def _first_helix(machine: Machine, runs: list[dict[str, Any]]) -> Helix:
    """The first helix of the campaign as a recipe; where there is none, the one that verifies corrections."""
    for run in runs:
        if run["test"] == "ballbar_helix":
            setup, columns = run["setup"], run["columns"]
            x, y, z = (float(v) for v in setup["centre_mm"])
            way: Literal[1, -1] = 1 if columns["direction"][0] > 0 else -1
            feed, turns = float(columns["feed_mm_min"][0]), max(float(setup.get("turns") or 5.0), 3.0)
            return Helix("", "", "identify", (x, y, z), float(setup["radius_mm"]), turns=turns, feed_mm_min=feed, direction=way)
    setup = verification(machine).tests[0].setup
    return Helix("", "", "identify", as_point(setup["centre_mm"]), float(setup["radius_mm"]))


def _named(helix: Helix, name: str, what: str, **changes: Any) -> list[Recipe]:
    return [replace(helix, label=f"{name}-{what}", setup_id=f"{name}-{what}", **changes)]


def _diagonals(like: Helix, name: str) -> list[Recipe]:
    return [Diagonal(f"{name}-{d}", f"{name}-{d}", "identify", d, 12, "XYZ") for d in DIAGONALS]


def _lines(like: Helix, name: str) -> list[Recipe]:
    return [Linear(f"{name}-line{AXES[a]}", f"{name}-line{AXES[a]}", "identify", a, n=25) for a in range(3)]


MAKERS: dict[str, Callable[[Helix, str], list[Recipe]]] = {
    "second_feed": lambda like, name: _named(like, name, "feed", feed_mm_min=SLOW * like.feed_mm_min),
    "opposite_direction": lambda like, name: _named(like, name, "back", direction=-1 if like.direction > 0 else 1),
    "second_radius": lambda like, name: _named(like, name, "radius", radius_mm=SHORTER * like.radius_mm),
    "ballbar": lambda like, name: _named(like, name, "helix"),
    "longer_session": lambda like, name: _named(like, name, "late"),
    "laser_diagonals": _diagonals,
    "single_axis_laser": _lines,
}
"""What the sequencer can run. Circles in the planes, other tools, angular optics and references are a person's work."""
