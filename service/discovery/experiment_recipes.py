"""Turn a proposed measurement into recipes for the sequencer, based on the runs that the campaign already has."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np

from abbe.models.discovery.answer import Localization
from abbe.models.discovery.experiment.additions import REPEAT_LATE_S
from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS
from abbe.service.domain.run import Run
from abbe.service.errors import StrokeError
from abbe.service.sequences.check import dry_run_campaign, paced
from abbe.service.sequences.recipes.approach import as_point
from abbe.service.sequences.recipes.campaigns import verification_helix
from abbe.service.sequences.recipes.recipe import MIN_TURNS, Diagonal, Helix, Linear, Recipe
from abbe.service.sequences.steps import CampaignPlan, TestPlan

Maker = Callable[[Helix, str], list[Recipe]]
"""Makes recipes from a measured helix and the prefix of their labels."""
SHORTER = 0.6
SLOW = 0.4
"""Ratio of the second feed to the first: slower, so that no machine has to exceed a feed that it has already run."""
DENSER = 2.0
"""Factor on the number of turns of a path through a given place."""
EQUATOR = 0.05
"""A place below a sphere's equator by less than this (sine of the angle) still belongs to the upper half."""
NO_HELIX = "the run is not a helix, and the sequencer can repeat only a helix"
NO_PATH = "the stored set-up does not define the path of the helix, or the helix was measured with another tool"
TURNED = "a person has to turn the bar or change its ball in between"


@dataclass(frozen=True)
class NextPlan:
    """Next measurement of the machine, and the tasks of the person.

    ``plan``: None if the sequencer can run none of it. ``by_hand``: additions that a person has to do, with the reason if the sequencer
    knows such a test but cannot run it here. ``after_s``: least age of the last reading at the start of the plan, s, for a late repeat.
    """

    plan: CampaignPlan | None
    by_hand: tuple[str, ...]
    after_s: float = 0.0


def next_plan(
    adds: Sequence[str],
    machine: Machine,
    runs: list[Run],
    *,
    name: tuple[str, str],
    max_feed_mm_min: float,
    about: Localization | None = None,
) -> NextPlan:
    """Plan the additions that a discovery proposes (``next_test.adds``).

    Parameters
    ----------
    runs : list of Run
        The measured runs. A second feed or a late repeat uses the path of their first helix.
    name : tuple of str
        Name of the new campaign, and the prefix of its labels and set-ups, which keeps them distinct from the old ones.
    about : Localization, optional
        Location of an unnamed effect (``where`` of a finding; its ``runs`` is the run to repeat). A helix is repeated several times in one
        set-up, any other run by hand; a second radius passes through the location.
    """
    tests: list[TestPlan] = []
    by_hand, after_s = [], 0.0
    for add in adds:
        made = _tests(add, machine, runs, name[1], max_feed_mm_min, about)
        if isinstance(made, str):
            by_hand.append(made)
            continue
        tests += made
        after_s = REPEAT_LATE_S if add == "longer_session" else after_s
    return NextPlan(CampaignPlan(name[0], tuple(tests)) if tests else None, tuple(by_hand), after_s)


def _tests(
    add: str, machine: Machine, runs: list[Run], name: str, max_feed_mm_min: float, about: Localization | None
) -> tuple[TestPlan, ...] | str:
    """Return the tests of one addition, or the text for the person who has to do it."""
    make = MAKERS.get(add)
    if make is None:
        return add
    place = None if about is None else about.position_mm
    like = _first_helix(machine, [] if add in LASER else runs if about is None else _repeats_first(runs, about))
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
    """Return the tests of recipes if they fit the strokes, else the reason as text; a second radius that does not fit is halved once."""
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


def _is_helix(runs: list[Run], about: Localization) -> bool:
    """Whether the run to repeat is a helix."""
    return "ballbar_helix" in [r.test for r in runs if r.run_id in about.runs]


def _repeats_first(runs: list[Run], about: Localization) -> list[Run]:
    """Return all runs; the runs to repeat come first."""
    return sorted(runs, key=lambda run: run.run_id not in about.runs)


def _shrunk(helix: Helix, scale: float, place: tuple[float, float, float] | None) -> Helix:
    """Return a helix with a shorter bar; with a ``place``, its centre moves so that the sphere passes through the place."""
    if place is None:
        return replace(helix, radius_mm=scale * helix.radius_mm)
    at, centre = np.asarray(place, dtype=np.float64), np.asarray(helix.centre_mm, dtype=np.float64)
    away = float(np.linalg.norm(centre - at))
    radius = scale * helix.radius_mm
    towards = (centre - at) / away if away > 0.0 else -helix.opens * np.eye(3)[helix.axis]
    return replace(helix, radius_mm=radius, centre_mm=as_point(at + radius * towards))


def _through(place: tuple[float, float, float] | None, like: Helix, name: str) -> list[Recipe]:
    """Return a denser helix on another sphere through ``place``; without a place, a helix with the usual second radius."""
    if place is None:
        return _named(like, name, "radius", radius_mm=SHORTER * like.radius_mm)
    near = _shrunk(like, SHORTER, place)
    up = like.opens * (place[near.axis] - near.centre_mm[near.axis]) / near.radius_mm
    opens = like.opens if up >= -EQUATOR else -like.opens
    return _named(near, name, "radius", turns=DENSER * like.turns, opens=opens)


def _repeats(like: Helix, name: str) -> list[Recipe]:
    """Return three runs in alternating direction in one set-up; each starts where the previous one ends."""
    ways: tuple[Literal[1, -1], ...] = (1, -1, 1) if like.direction > 0 else (-1, 1, -1)
    last = len(ways) - 1
    return [
        replace(like, label=f"{name}-late{k + 1}", setup_id=f"{name}-late", direction=way, mount=k == 0, unmount=k == last)
        for k, way in enumerate(ways)
    ]


def _first_helix(machine: Machine, runs: list[Run]) -> Helix | None:
    """Return the first helix as a recipe, None if it cannot be repeated; without any helix, return the helix that verifies tables."""
    for run in runs:
        if run.test == "ballbar_helix":
            return _recipe_of(machine, run)
    return replace(verification_helix(machine), role="identify")


def _recipe_of(machine: Machine, run: Run) -> Helix | None:
    """Turn a stored helix into a recipe; None if its set-up is incomplete or this machine cannot repeat it."""
    bar = run.bar
    if bar.law is None or bar.rate_hz is None or bar.chord_mm is None or bar.opens is None or bar.even is None or not bar.axis:
        return None
    if bar.turns is None or bar.u_length_mm is None or bar.turns < MIN_TURNS:
        return None
    if bar.tool_mm is not None and not np.allclose(bar.tool_mm, machine.tool_mm):
        return None
    columns = run.columns
    return Helix(
        "", "", "identify", as_point(bar.centre_mm), bar.radius_mm,
        turns=bar.turns, law=bar.law, axis=AXES.index(bar.axis), feed_mm_min=float(columns.feed_mm_min[0]),
        direction=1 if columns.direction[0] > 0 else -1, rate_hz=bar.rate_hz, chord_mm=bar.chord_mm,
        opens=bar.opens, length_calibrated=bool(bar.length_calibrated),
        u_length_mm=bar.u_length_mm, even=bar.even,
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
    "judging_run": lambda like, name: _named(like, name, "judge", direction=-1 if like.direction > 0 else 1, role="holdout"),
}
"""Additions that the sequencer can run. Circles in the planes, other tools, angular optics and reference lengths need a person."""
LASER = ("laser_diagonals", "single_axis_laser")
"""Additions that need no measured helix."""
