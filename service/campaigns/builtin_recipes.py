"""The recipes of unattended checks: known also to those who have no way to a device."""

from __future__ import annotations

import re
from difflib import get_close_matches
from pathlib import Path
from typing import Protocol

from abbe.models.machine import Machine
from abbe.service.errors import ConfigError
from abbe.service.sequences.recipes.campaigns import identification, quick_check, verification
from abbe.service.sequences.recipes.recipe_file import read_recipe
from abbe.service.sequences.steps import CampaignPlan

IDENTIFICATION = "identification"
"""The full campaign: no check, and only with somebody who mounts its set-ups."""
USUAL_HZ = 100
RATES_HZ = (50, 100, 200, 250, 500, 1000)
"""Rates of the ball-bar that a person is offered; any other that divides 1000 can be named as well."""
_RATE = re.compile(r"(?P<name>.+) at (?P<rate>[1-9][0-9]{0,3}) Hz")


class BuiltinRecipe(Protocol):
    """A recipe that fits itself into a machine."""

    def __call__(self, machine: Machine, *, rate_hz: int = ...) -> CampaignPlan:
        """The plan, with so many ball-bar samples per second."""
        ...


RECIPES: dict[str, BuiltinRecipe] = {"quick-check": quick_check, "verification": verification}


def named(recipe: str, rate_hz: int) -> str:
    """A recipe's name together with its rate, as jobs and campaigns tell it: ``quick-check at 1000 Hz``; the usual rate is not said."""
    return recipe if rate_hz == USUAL_HZ else f"{recipe} at {rate_hz} Hz"


def parted(name: str) -> tuple[str, int]:
    """Recipe and rate of such a name; a rate that does not divide 1000 is none, and stays part of the name."""
    found = _RATE.fullmatch(name)
    if found is None or 1000 % int(found["rate"]):
        return name, USUAL_HZ
    return found["name"], int(found["rate"])


def recipe_plan(name: str, machine: Machine) -> CampaignPlan:
    """The plan of a shipped recipe; ``NAME at 500 Hz`` is the recipe with that rate of the ball-bar.

    Raises
    ------
    ConfigError
        There is no such recipe; the message lists those there are.
    """
    recipe, rate_hz = parted(name)
    if recipe not in RECIPES:
        close = get_close_matches(recipe, RECIPES, n=1)
        meant = f"did you mean {close[0]!r}? " if close else ""
        raise ConfigError(f"there is no recipe {name!r}", f"{meant}use one of: {', '.join(sorted(RECIPES))}")
    return RECIPES[recipe](machine, rate_hz=rate_hz)


def campaign_plan(recipe: str, machine: Machine, folder: Path) -> CampaignPlan:
    """The campaign that the machine file names for investigations: ``identification``, or a recipe file beside it.

    Raises
    ------
    ConfigError
        The file cannot be read, or is no recipe.
    """
    if recipe == IDENTIFICATION:
        return identification(machine)
    name, recipes = read_recipe(folder / recipe)
    return CampaignPlan(name, tuple(r.plan(machine) for r in recipes))
