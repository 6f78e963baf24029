"""Built-in campaigns, scaled to any machine's strokes, and the sources of a campaign's plan. Nothing here reaches a device.

The identification campaign lets the joint solution determine every error that nine tables can correct: helices about five centres,
each axis on two opposite edges, step diagonals in two step orders. They determine all 67 parameters of the translations and of those
angles that one tool shows.
The verification uses positions that the identification does not use. The campaign of the discovery demonstration separates most candidate
effects in one session.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import Literal, Protocol

import numpy as np

from abbe.models.machine import AXES, Machine
from abbe.models.paths import DIAGONALS
from abbe.service.domain.machine import Point
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.approach import as_point
from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear, Recipe
from abbe.service.sequences.recipes.recipe_file import parse_recipe, recipe_source, recipe_text
from abbe.service.sequences.steps import CampaignPlan


def hemisphere(machine: Machine, rel: tuple[float, float, float], share: float) -> tuple[Point, float]:
    """Return the centre at relative position ``rel`` and ``share`` times the largest radius (whole mm) whose upper hemisphere fits."""
    centre = machine.stroke_mm[:, 0] + np.array(rel) * machine.length_mm
    below = centre - machine.stroke_mm[:, 0]
    above = machine.stroke_mm[:, 1] - centre
    room = min(below[0], above[0], below[1], above[1], above[2]) - 5.0
    return as_point(np.round(centre)), float(max(20.0, np.floor(share * room)))


def identification(machine: Machine, *, rate_hz: int = 100, name: str = "identify") -> CampaignPlan:
    """Return five helices, six lines, eight step diagonals: about 25 minutes of machine time for a 600 x 500 x 450 mm machine.

    Two more runs have the role holdout, for 3 of these minutes: the first helix the other way round, and a third step order of the last
    diagonal. They share a mounting with fitted runs, so that only the model can cause their deviation.
    """
    recipes: list[Recipe] = []
    places = [(0.5, 0.5, 0.3), (0.32, 0.36, 0.2), (0.68, 0.64, 0.2), (0.32, 0.64, 0.25), (0.68, 0.36, 0.25)]
    for k, rel in enumerate(places):
        centre, radius = hemisphere(machine, rel, 0.85 if k == 0 else 0.95)
        helix = Helix(f"helix{k + 1}", f"B{k + 1}", "identify", centre, radius, rate_hz=rate_hz)
        recipes += _with_judge(helix, replace(helix, direction=-1)) if k == 0 else [helix]
    for a in range(3):
        for k, at in enumerate((0.15, 0.85)):
            recipes.append(Linear(f"line{AXES[a]}{k + 1}", f"L{AXES[a]}{k + 1}", "identify", a, at_share=(at, at)))
    for order in ("XYZ", "ZYX"):
        recipes += [Diagonal(f"step-{d}-{order}", f"D{d}{order}", "identify", d, 12, order) for d in DIAGONALS]
    last = recipes.pop()
    assert isinstance(last, Diagonal)
    recipes += _with_judge(last, replace(last, order="YXZ"))
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def _with_judge(fitted: Helix | Diagonal, judge: Helix | Diagonal) -> list[Recipe]:
    """Return a test and a second one in the same mounting, which only judges the solution."""
    return [replace(fitted, unmount=False), replace(judge, label=f"judge-{fitted.label}", role="holdout", mount=False)]


OVERRUN_MM = 2.0
"""Overrun of plain body diagonals: more than any lost motion, so that the machine reaches the far end from both sides."""


def verification(machine: Machine, *, rate_hz: int = 100, name: str = "verify", role: str = "holdout") -> CampaignPlan:
    """Return one helix (with a centre and radius that the identification does not use) and the four plain body diagonals."""
    recipes: list[Recipe] = [verification_helix(machine, rate_hz=rate_hz, role=role)]
    recipes += [Diagonal(f"check-{d}", f"V{d}", role, d, 20, "", overrun_mm=OVERRUN_MM) for d in DIAGONALS]
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def verification_helix(machine: Machine, *, rate_hz: int = 100, role: str = "holdout") -> Helix:
    """Return the helix of the verification."""
    centre, radius = hemisphere(machine, (0.45, 0.55, 0.12), 0.7)
    return Helix("check-helix", "VB", role, centre, radius, turns=4, rate_hz=rate_hz)


def quick_check(machine: Machine, *, rate_hz: int = 100, name: str = "quick-check") -> CampaignPlan:
    """Return the unattended check: the tests of the verification with half the positions, a few minutes of machine time."""
    centre, radius = hemisphere(machine, (0.45, 0.55, 0.12), 0.7)
    recipes: list[Recipe] = [Helix("check-helix", "VB", "holdout", centre, radius, turns=3, rate_hz=rate_hz)]
    recipes += [Diagonal(f"check-{d}", f"V{d}", "holdout", d, 10, "", overrun_mm=OVERRUN_MM) for d in DIAGONALS]
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


SLOW, MIDDLE, FAST = 1000.0, 2000.0, 3000.0
STEPS, LINE_N = 12, 13
JUDGED = "pnp"
BACK = "check-back"
CHORD_MM = 0.5
"""Chord of the helices in a discovery, even along the path: it runs at most 0.24 um inside the sphere at a radius of 120 mm. The usual
chords run up to 10 um inside. The place of a sample is known only to half a sampling period (0.3 mm at 50 Hz and 2000 mm/min), so
readings on the usual chords would scatter, and a clean machine would seem disturbed."""
ROUND: tuple[Literal[1, -1], ...] = (1, -1)


def discovery_campaign(machine: Machine, *, rate_hz: int = 100, name: str = "discover") -> CampaignPlan:
    """Return the campaign of the discovery demonstration: about 20 minutes of machine time for a 600 x 500 x 450 mm machine.

    A line along each axis; helices in both directions, at two feeds about one origin and at one feed about another; step diagonals; late
    repeats of helices about the first origin and of the lines. A late helix of another feed and the second step order of a diagonal
    have the role holdout: they share a mounting with fitted runs, so that only the model can cause their deviation.
    """
    first = _helix(machine, "A", (0.5, 0.5, 0.3), 0.6, rate_hz)
    second = _helix(machine, "B", (0.34, 0.38, 0.2), 0.65, rate_hz)
    recipes: list[Recipe] = _lines(machine, "early")
    recipes += [*_series(first, "a", [(f, d, "identify") for f in (SLOW, FAST) for d in ROUND])]
    recipes += _series(second, "b", [(MIDDLE, d, "identify") for d in ROUND])
    for diagonal in DIAGONALS:
        judged = diagonal == JUDGED
        recipes.append(Diagonal(f"step-{diagonal}", f"D{diagonal}", "identify", diagonal, STEPS, "XYZ", unmount=not judged))
        if judged:
            recipes.append(Diagonal(f"judge-{diagonal}", f"D{diagonal}", "holdout", diagonal, STEPS, "ZYX", mount=False))
    late = replace(first, setup_id="L")
    recipes += _series(late, "late", [(MIDDLE, 1, "identify"), (SLOW, -1, "identify"), (0.5 * (MIDDLE + FAST), 1, "holdout")])
    recipes += _lines(machine, "late")
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))


def new_measurement(machine: Machine, *, rate_hz: int = 100, name: str = "anew") -> CampaignPlan:
    """Return the verification with a second helix: the same path slowly back, with the bar left in, to show effects of feed and direction.

    One helix alone cannot distinguish a constantly warm bar from a longer one.
    """
    plan = verification(machine, rate_hz=rate_hz, name=name)
    check = replace(verification_helix(machine, rate_hz=rate_hz), chord_mm=CHORD_MM, even=True)
    there = replace(check, unmount=False)
    back = replace(check, label=BACK, feed_mm_min=SLOW, direction=-1, mount=False)
    return CampaignPlan(name, (there.plan(machine), back.plan(machine), *plan.tests[1:]))


def _lines(machine: Machine, when: str) -> list[Recipe]:
    """Return one laser line along each axis: its length shows growth during the session, whatever the squareness is."""
    return [
        Linear(f"{when}-line{AXES[a]}", f"{when}{AXES[a]}", "identify", a, at_share=(0.5, 0.5), positions=LINE_N)
        for a in range(len(machine.stroke_mm))
    ]


def _helix(machine: Machine, setup: str, rel: tuple[float, float, float], share: float, rate_hz: int) -> Helix:
    centre, radius = hemisphere(machine, rel, share)
    return Helix("", setup, "identify", centre, radius, turns=4, rate_hz=rate_hz, chord_mm=CHORD_MM, even=True)


def _series(like: Helix, name: str, ways: list[tuple[float, Literal[1, -1], str]]) -> list[Recipe]:
    """Return consecutive helices with one mounting of the bar."""
    last = len(ways) - 1
    return [
        replace(like, label=_label(name, feed, way), role=role, feed_mm_min=feed, direction=way, mount=k == 0, unmount=k == last)
        for k, (feed, way, role) in enumerate(ways)
    ]


def _label(name: str, feed: float, way: int) -> str:
    return f"{name}-{feed:.0f}-{'out' if way > 0 else 'back'}"


IDENTIFICATION = "identification"
"""Name of the built-in full campaign: it is no check, and it needs a person who mounts its set-ups."""
USUAL_HZ = 100
RATES_HZ = (50, 100, 200, 250, 500, 1000)
"""Offered rates of the ball-bar; any other divisor of 1000 works, too."""
_RATE = re.compile(r"(?P<name>.+) at (?P<rate>[1-9][0-9]{0,3}) Hz")


class BuiltinRecipe(Protocol):
    """A recipe that scales to a machine."""

    def __call__(self, machine: Machine, *, rate_hz: int = ...) -> CampaignPlan:
        """Return the plan with this ball-bar rate."""
        ...


RECIPES: dict[str, BuiltinRecipe] = {"quick-check": quick_check, "verification": verification}
"""Recipes that end with a verdict, as a schedule needs it."""
CAMPAIGNS: dict[str, BuiltinRecipe] = {IDENTIFICATION: identification, "verification": verification, "quick-check": quick_check}


def named(recipe: str, rate_hz: int) -> str:
    """Return the recipe name with its rate, as jobs and campaigns show it: ``quick-check at 1000 Hz``; omits the usual rate."""
    return recipe if rate_hz == USUAL_HZ else f"{recipe} at {rate_hz} Hz"


def split_recipe_name(name: str) -> tuple[str, int]:
    """Split a name made by `named` into recipe and rate; a rate that does not divide 1000 stays part of the name."""
    found = _RATE.fullmatch(name)
    if found is None or 1000 % int(found["rate"]):
        return name, USUAL_HZ
    return found["name"], int(found["rate"])


def is_full(recipe: str, names: tuple[str, ...]) -> bool:
    """Return whether a recipe is one of the full campaigns ``names``. Only the built-in one takes a ball-bar rate; files state theirs."""
    name, rate_hz = split_recipe_name(recipe)
    return name in names and (name == IDENTIFICATION or rate_hz == USUAL_HZ)


def recipe_plan(name: str, machine: Machine) -> CampaignPlan:
    """Return the plan of a built-in recipe; ``NAME at 500 Hz`` sets the ball-bar rate. Raises ConfigError for an unknown recipe."""
    recipe, rate_hz = split_recipe_name(name)
    if recipe not in RECIPES:
        close = get_close_matches(recipe, RECIPES, n=1)
        meant = f"did you mean {close[0]!r}? " if close else ""
        raise ConfigError(f"there is no recipe {name!r}", f"{meant}use one of: {', '.join(sorted(RECIPES))}")
    return RECIPES[recipe](machine, rate_hz=rate_hz)


@dataclass(frozen=True, slots=True, kw_only=True)
class RecipeSource:
    """Source of a campaign's plan. The journal keeps it, so that a resumed campaign needs no file.

    ``helix``: ``X,Y,Z,RADIUS`` in mm instead of a recipe. ``text``: content of the recipe file that ``recipe`` names.
    """

    recipe: str
    helix: str = ""
    rate_hz: int = USUAL_HZ
    text: str | None = None

    def plan(self, machine: Machine) -> CampaignPlan:
        """Return the campaign, named after its recipe.

        Raises
        ------
        ConfigError
            The recipe is unknown, the rate does not divide 1000, or helix or file is not valid.
        """
        if self.rate_hz < 1 or 1000 % self.rate_hz:
            raise ConfigError(f"rate {self.rate_hz} Hz does not divide 1000", "use 1000, 500, 250, 200, 125, 100, 50 ...")
        if self.helix:
            return self._helix(machine)
        if self.text is not None:
            name, recipes = parse_recipe(self.text, self.recipe)
            return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))
        if self.recipe not in CAMPAIGNS:
            raise ConfigError(f"there is no recipe {self.recipe!r}", f"use one of: {', '.join(CAMPAIGNS)}, or a FILE.toml")
        return CAMPAIGNS[self.recipe](machine, rate_hz=self.rate_hz)

    def _helix(self, machine: Machine) -> CampaignPlan:
        try:
            x, y, z, radius = numbers = tuple(float(v) for v in self.helix.split(","))
            if not all(map(math.isfinite, numbers)):
                raise ValueError(self.helix)
        except ValueError:
            raise ConfigError(f"--helix {self.helix!r} is not X,Y,Z,RADIUS", "for example --helix 300,250,100,150") from None
        wanted = Helix("helix", "B1", "identify", (x, y, z), radius, rate_hz=self.rate_hz)
        recipe_text("helix", (wanted,))  # applies the limits of recipe files
        return CampaignPlan("helix", (wanted.plan(machine),))


def campaign_source(name: str, folder: Path) -> RecipeSource:
    """Return the source of a full campaign: ``identification``, optionally with its rate, or a recipe file in the folder.

    Raises
    ------
    ConfigError
        The file cannot be read.
    """
    recipe, rate_hz = split_recipe_name(name)
    if recipe == IDENTIFICATION:
        return RecipeSource(recipe=recipe, rate_hz=rate_hz)
    return RecipeSource(recipe=name, text=recipe_source(folder / name))
