"""Built-in recipes, and the sources of a campaign's plan. Nothing here reaches a device."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Protocol

from abbe.models.machine import Machine
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.campaigns import identification, quick_check, verification
from abbe.service.sequences.recipes.recipe import Helix
from abbe.service.sequences.recipes.recipe_file import parse_recipe, recipe_source, recipe_text
from abbe.service.sequences.steps import CampaignPlan

IDENTIFICATION = "identification"
"""The full campaign: not a check, and only with a person who mounts its set-ups."""
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
    """Recipe name with its rate, as jobs and campaigns show it: ``quick-check at 1000 Hz``; omits the usual rate."""
    return recipe if rate_hz == USUAL_HZ else f"{recipe} at {rate_hz} Hz"


def split_recipe_name(name: str) -> tuple[str, int]:
    """Split a name made by `named` into recipe and rate; a rate that does not divide 1000 stays part of the name."""
    found = _RATE.fullmatch(name)
    if found is None or 1000 % int(found["rate"]):
        return name, USUAL_HZ
    return found["name"], int(found["rate"])


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

    ``helix``: ``X,Y,Z,RADIUS`` in mm instead of a recipe. ``text``: of a recipe file, which ``recipe`` names.
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
