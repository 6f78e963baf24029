"""The recipes of unattended checks: known also to those who have no way to a device."""

from __future__ import annotations

from collections.abc import Callable

from models.machine import Machine
from service.errors import ConfigError
from service.sequences.campaigns import quick_check, verification
from service.sequences.steps import CampaignPlan

RECIPES: dict[str, Callable[[Machine], CampaignPlan]] = {"quick-check": quick_check, "verification": verification}


def recipe_plan(name: str, machine: Machine) -> CampaignPlan:
    """The plan of a shipped recipe.

    Raises
    ------
    ConfigError
        There is no such recipe; the message lists those there are.
    """
    if name not in RECIPES:
        raise ConfigError(f"there is no recipe {name!r}", f"use one of: {', '.join(sorted(RECIPES))}")
    return RECIPES[name](machine)
