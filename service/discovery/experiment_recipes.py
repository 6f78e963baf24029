"""From a proposed measurement to recipes that the sequencer can run, laid beside what the campaign has measured already."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from abbe.models.discovery.answer import Localization
from abbe.models.discovery.unseen import LATE_S
from abbe.models.machine import AXES, Machine
from abbe.models.paths.lines import DIAGONALS
from abbe.service.errors import StrokeError
from abbe.service.sequences.check import dry_run_campaign, paced
from abbe.service.sequences.recipes.campaigns import verification_helix
from abbe.service.sequences.recipes.recipe import MIN_TURNS, Diagonal, Helix, Linear, Recipe, as_point
from abbe.service.sequences.steps import CampaignPlan, TestPlan

Maker = Callable[[Helix, str], list[Recipe]]
"""From a helix that was measured, and what labels begin with, to recipes."""
SHORTER = 0.6
SLOW = 0.4
"""The second feed is slower: no machine is asked for more than it was asked before."""
DENSER = 2.0
"""A path through a place has this many times the turns."""
EQUATOR = 0.05
"""A place that is seen lower than the equator by less than this (sine of the angle) is still on the same half."""
KNOWN = (
    "centre_mm", "radius_mm", "turns", "axis", "opens", "law", "even", "chord_mm", "rate_hz", "length_calibrated", "u_length_mm",
)  # fmt: skip
"""What a stored set-up says of its helix: without one of these nobody knows what path it was, or with what bar."""
NO_HELIX = "the run is no helix: the sequencer repeats nothing else"
NO_PATH = "what is stored of the helix does not say what path it was, or it was of another tool"
TURNED = "somebody has to turn the bar or change its ball in between"


@dataclass(frozen=True)
class NextPlan:
    """What the machine measures next, and what a person has to do.

    ``plan``: None if nothing of it can be run. ``by_hand``: additions that a person has to see to, with the reason where it is not that the
    sequencer has no such test. ``after_s``: the last reading is to be so old when the plan begins: what comes late has to come late.
    """

    plan: CampaignPlan | None
    by_hand: tuple[str, ...]
    after_s: float = 0.0


def next_plan(
    adds: Sequence[str],
    machine: Machine,
    runs: list[dict[str, Any]],
    *,
    name: tuple[str, str],
    max_feed_mm_min: float,
    about: Localization | None = None,
) -> NextPlan:
    """Recipes for what a discovery wants to have added (``next_test.adds``).

    Parameters
    ----------
    runs : list of dict
        What was measured so far: second feeds and late repeats are of the first helix of it, exactly as it was.
    name : tuple of str
        Of the new campaign, and what its labels and set-ups begin with, so that they can stand beside the old ones.
    about : Where, optional
        Where something without a name lives (``where`` of a finding, ``runs`` the one that is to be measured again): a helix is repeated
        several times in one set-up, any other run by hand; another radius passes through its place.
    """
    tests: list[TestPlan] = []
    by_hand, after_s = [], 0.0
    for add in adds:
        made = _tests(add, machine, runs, name[1], max_feed_mm_min, about)
        if isinstance(made, str):
            by_hand.append(made)
            continue
        tests += made
        after_s = LATE_S if add == "longer_session" else after_s
    return NextPlan(CampaignPlan(name[0], tuple(tests)) if tests else None, tuple(by_hand), after_s)


def _tests(
    add: str, machine: Machine, runs: list[dict[str, Any]], name: str, max_feed_mm_min: float, about: Localization | None
) -> tuple[TestPlan, ...] | str:
    """The tests of one addition, or what a person reads who has to see to it."""
    make = MAKERS.get(add)
    if make is None:
        return add
    place = None if about is None else about.position_mm
    like = _first_helix(machine, [] if add in LASER else runs if about is None else _showing(runs, about))
    if about is not None:
        if add == "ballbar":
            return f"{add} ({TURNED})"
        if add == "longer_session" and not _is_helix(runs, about):
            return f"{add} ({NO_HELIX})"
        special: dict[str, Maker] = {"longer_session": _repeats, "second_radius": partial(_through, place)}
        make = special.get(add, make)
    if like is None:
        return f"{add} ({NO_PATH})"
    return _within(add, machine, make(like, name), max_feed_mm_min, place)


def _within(
    add: str, machine: Machine, recipes: list[Recipe], max_feed_mm_min: float, place: tuple[float, float, float] | None
) -> tuple[TestPlan, ...] | str:
    """The tests of recipes inside the strokes; a sphere of another radius that has no room may be smaller still."""
    tries = [recipes]
    if add == "second_radius":
        tries.append([_shrunk(r, 0.5, place) if isinstance(r, Helix) else r for r in recipes])
    why = ""
    for one in tries:
        plan = paced(CampaignPlan(add, tuple(r.plan(machine) for r in one)), max_feed_mm_min)
        try:
            dry_run_campaign(machine, plan, max_feed_mm_min)
        except StrokeError as error:
            why = why or error.detail
        else:
            return plan.tests
    return f"{add} ({why})"


def _is_helix(runs: list[dict[str, Any]], about: Localization) -> bool:
    """Whether the run that is to be measured again is a helix."""
    return "ballbar_helix" in [r["test"] for r in runs if r.get("run_id") in about.runs]


def _showing(runs: list[dict[str, Any]], about: Localization) -> list[dict[str, Any]]:
    """Runs, first those that are to be measured again."""
    return sorted(runs, key=lambda run: run.get("run_id") not in about.runs)


def _shrunk(helix: Helix, scale: float, place: tuple[float, float, float] | None) -> Helix:
    """A helix with a shorter bar about the same centre; about one nearer to a place, so that its sphere still passes there."""
    if place is None:
        return replace(helix, radius_mm=scale * helix.radius_mm)
    at, centre = np.asarray(place, dtype=np.float64), np.asarray(helix.centre_mm, dtype=np.float64)
    away = float(np.linalg.norm(centre - at))
    radius = scale * helix.radius_mm
    towards = (centre - at) / away if away > 0.0 else -helix.opens * np.eye(3)[helix.axis]
    return replace(helix, radius_mm=radius, centre_mm=as_point(at + radius * towards))


def _through(place: tuple[float, float, float] | None, like: Helix, name: str) -> list[Recipe]:
    """Twice the turns on another sphere through a place; without one, another radius as usual."""
    if place is None:
        return _named(like, name, "radius", radius_mm=SHORTER * like.radius_mm)
    near = _shrunk(like, SHORTER, place)
    up = like.opens * (place[near.axis] - near.centre_mm[near.axis]) / near.radius_mm
    opens = like.opens if up >= -EQUATOR else -like.opens
    return _named(near, name, "radius", turns=DENSER * like.turns, opens=opens)


def _repeats(like: Helix, name: str) -> list[Recipe]:
    """There, back and there again in one set-up: each starts where the one before ends."""
    ways: tuple[Literal[1, -1], ...] = (1, -1, 1) if like.direction > 0 else (-1, 1, -1)
    last = len(ways) - 1
    return [
        replace(like, label=f"{name}-late{k + 1}", setup_id=f"{name}-late", direction=way, mount=k == 0, unmount=k == last)
        for k, way in enumerate(ways)
    ]


def _first_helix(machine: Machine, runs: list[dict[str, Any]]) -> Helix | None:
    """The first helix of the campaign as a recipe; None: nobody can tell what it was. Without any, the one that verifies tables."""
    for run in runs:
        if run["test"] == "ballbar_helix":
            return _again(machine, run)
    return replace(verification_helix(machine), role="identify")


def _again(machine: Machine, run: dict[str, Any]) -> Helix | None:
    """A stored helix as a recipe; None where its set-up does not say all of it, or says what this machine cannot repeat."""
    setup, columns = run["setup"], run["columns"]
    if any(setup.get(key) is None for key in KNOWN) or setup["turns"] < MIN_TURNS:
        return None
    if setup.get("tool_mm") is not None and not np.allclose(setup["tool_mm"], machine.tool_mm):
        return None
    x, y, z = (float(v) for v in setup["centre_mm"])
    return Helix(
        "", "", "identify", (x, y, z), float(setup["radius_mm"]),
        turns=float(setup["turns"]), law=setup["law"], axis=AXES.index(setup["axis"]), feed_mm_min=float(columns["feed_mm_min"][0]),
        direction=1 if columns["direction"][0] > 0 else -1, rate_hz=int(setup["rate_hz"]), chord_mm=float(setup["chord_mm"]),
        opens=1 if setup["opens"] > 0 else -1, length_calibrated=bool(setup["length_calibrated"]),
        u_length_mm=float(setup["u_length_mm"]), even=bool(setup["even"]),
    )  # fmt: skip


def _named(helix: Helix, name: str, what: str, **changes: Any) -> list[Recipe]:
    return [replace(helix, label=f"{name}-{what}", setup_id=f"{name}-{what}", **changes)]


def _diagonals(like: Helix, name: str) -> list[Recipe]:
    return [Diagonal(f"{name}-{d}", f"{name}-{d}", "identify", d, 12, "XYZ") for d in DIAGONALS]


def _lines(like: Helix, name: str) -> list[Recipe]:
    return [Linear(f"{name}-line{AXES[a]}", f"{name}-line{AXES[a]}", "identify", a, at_share=(0.15, 0.15)) for a in range(3)]


MAKERS: dict[str, Maker] = {
    "second_feed": lambda like, name: _named(like, name, "feed", feed_mm_min=SLOW * like.feed_mm_min),
    "opposite_direction": lambda like, name: _named(like, name, "back", direction=-1 if like.direction > 0 else 1),
    "second_radius": lambda like, name: _named(like, name, "radius", radius_mm=SHORTER * like.radius_mm),
    "ballbar": lambda like, name: _named(like, name, "helix"),
    "longer_session": lambda like, name: _named(like, name, "late"),
    "laser_diagonals": _diagonals,
    "single_axis_laser": _lines,
}
"""What the sequencer can run. Circles in the planes, other tools, angular optics and references are a person's work."""
LASER = ("laser_diagonals", "single_axis_laser")
"""What needs no helix to be like."""
