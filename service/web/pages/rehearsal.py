"""A dry run for the screen: what a recipe would drive on this machine, from the machine file alone. Nothing here can reach a device."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.models.machine import AXES, Machine
from abbe.service.campaigns.builtin_recipes import IDENTIFICATION, RATES_HZ, RECIPES, named, recipe_plan, split_recipe_name
from abbe.service.channel.messages import MachineSummary, RulesSummary
from abbe.service.errors import AbbeError
from abbe.service.rendering.numbers import MM, Unit
from abbe.service.report.dry_run_page import picture
from abbe.service.sequences.check import DryRun, dry_run_campaign
from abbe.service.sequences.recipes.campaigns import identification
from abbe.service.sequences.steps import CampaignPlan, MountBar, MountLaser, TestPlan
from abbe.service.site import machine_from_doc

CAMPAIGN = IDENTIFICATION
"""The full campaign: its prompts guide a person through the set-ups."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """Something that a person mounts. ``what``: "bar" or "laser"; ``at_mm`` where; ``size`` the bar's length in mm, 0 for a laser."""

    number: int
    what: str
    name: str
    at_mm: tuple[float, ...]
    radius_mm: float


@dataclass(frozen=True, slots=True)
class Rehearsed:
    """A recipe that was run dry. ``trouble``: why it cannot be run on this machine; nothing else is there then but the recipe."""

    recipe: str
    startable: bool
    trouble: str = ""
    remedy: str = ""
    runs: tuple[DryRun, ...] = ()
    set_ups: tuple[SetUp, ...] = ()
    used: tuple[tuple[str, float, float, float, float], ...] = ()
    picture: str = ""

    @property
    def duration_s(self) -> float:
        """Machine time, mounting not counted."""
        return sum(run.duration_s for run in self.runs)

    @property
    def readings(self) -> int:
        """Readings of all tests."""
        return sum(run.readings for run in self.runs)

    @property
    def fastest_mm_min(self) -> float:
        """Largest feed."""
        return max((run.fastest_mm_min for run in self.runs), default=0.0)


@dataclass(frozen=True, slots=True)
class Rehearsals:
    """What can be run dry here: the machine as its file describes it, and the recipes that a person may start."""

    told: MachineSummary | None = None
    recipes: tuple[str, ...] = ()
    rates_hz: tuple[int, ...] = RATES_HZ
    rules: RulesSummary | None = None

    def choices(self) -> tuple[str, ...]:
        """Recipes that can be chosen: those that can be started first, then the full campaign. Rates are chosen apart.

        A campaign of a recipe file can be started by programs only: its dry run is that of the command line.
        """
        named = (split_recipe_name(name)[0] for name in self.recipes if not name.endswith(".toml"))
        return tuple(dict.fromkeys([*named, *((CAMPAIGN,) if self.told is not None else ())]))

    def run(self, recipe: str, rate_hz: int, unit: Unit = MM) -> Rehearsed | None:
        """A recipe, dry, at a rate of the ball-bar, its picture in a unit; None where the machine or the recipe is not known here."""
        told = self.told
        if told is None or recipe not in self.choices() or (recipe not in RECIPES and recipe != CAMPAIGN):
            return None
        startable = recipe in {split_recipe_name(name)[0] for name in self.recipes}
        try:
            machine = machine_from_doc(
                {"chain": told.chain, "stroke_mm": told.stroke_mm, "pivots_mm": told.pivots_mm, "tool_mm": told.tool_mm}
            )
            plan = identification(machine, rate_hz=rate_hz) if recipe == CAMPAIGN else recipe_plan(named(recipe, rate_hz), machine)
            runs = dry_run_campaign(machine, plan, told.max_feed_mm_min)
        except AbbeError as error:
            return Rehearsed(recipe, False, error.detail, error.remedy)
        return Rehearsed(recipe, startable, "", "", runs, set_ups(plan), _used(machine, runs), picture(machine, plan, unit))


def set_ups(plan: CampaignPlan) -> tuple[SetUp, ...]:
    """What a person mounts, in order."""
    found = [one for test in plan.tests if (one := _set_up(test)) is not None]
    return tuple(SetUp(k, *one) for k, one in enumerate(found, start=1))


def _set_up(test: TestPlan) -> tuple[str, str, tuple[float, ...], float] | None:
    for step in test.steps:
        if isinstance(step, MountBar):
            return "bar", test.label, tuple(test.setup["centre_mm"]), step.radius_mm
        if isinstance(step, MountLaser):
            return "laser", test.label, tuple(test.setup["start_mm"]), 0.0
    return None


def _used(machine: Machine, runs: tuple[DryRun, ...]) -> tuple[tuple[str, float, float, float, float], ...]:
    """Of each axis: name, lowest and highest commanded position, and its stroke, mm."""
    return tuple(
        (
            AXES[a],
            min(run.lowest_mm[a] for run in runs),
            max(run.highest_mm[a] for run in runs),
            float(machine.stroke_mm[a, 0]),
            float(machine.stroke_mm[a, 1]),
        )
        for a in range(3)
    )
