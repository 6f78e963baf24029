"""Dry run of a recipe for the screen, from the machine file alone; this module cannot reach a device."""

from __future__ import annotations

from dataclasses import dataclass

from abbe.models.machine import AXES, Machine
from abbe.service.channel.messages import MachineSummary
from abbe.service.domain.machine import Rules, machine_from_doc
from abbe.service.errors import AbbeError
from abbe.service.rendering.numbers import MM, Unit
from abbe.service.report.dry_run_page import picture
from abbe.service.sequences.check import DryRun, dry_run_campaign
from abbe.service.sequences.recipes.campaigns import (
    IDENTIFICATION,
    RATES_HZ,
    RECIPES,
    identification,
    named,
    recipe_plan,
    split_recipe_name,
)
from abbe.service.sequences.steps import CampaignPlan, MountBar, MountLaser, TestPlan

CAMPAIGN = IDENTIFICATION
"""The full campaign, whose prompts guide a person through the set-ups."""


@dataclass(frozen=True, slots=True)
class SetUp:
    """An instrument that a person mounts. ``what``: "bar" or "laser"; ``radius_mm``: length of the bar, 0 for a laser."""

    number: int
    what: str
    name: str
    at_mm: tuple[float, ...]
    radius_mm: float


@dataclass(frozen=True, slots=True)
class Rehearsed:
    """Result of a dry run. ``trouble``: why the recipe cannot run on this machine; then the other fields are empty."""

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
        """Machine time without mounting."""
        return sum(run.duration_s for run in self.runs)

    @property
    def readings(self) -> int:
        """Number of readings in all tests."""
        return sum(run.readings for run in self.runs)

    @property
    def fastest_mm_min(self) -> float:
        """Largest feed of all runs."""
        return max((run.fastest_mm_min for run in self.runs), default=0.0)


@dataclass(frozen=True, slots=True)
class Rehearsals:
    """Possible dry runs: the machine as its file describes it, and the recipes that a person may start."""

    machine: MachineSummary | None = None
    recipes: tuple[str, ...] = ()
    rates_hz: tuple[int, ...] = RATES_HZ
    rules: Rules | None = None

    def choices(self) -> tuple[str, ...]:
        """Names that can be rehearsed, without sampling rates: startable recipes first, then the full campaign.

        Campaigns of recipe files are left out: only programs can start them, and the command line shows their dry runs.
        """
        named = (split_recipe_name(name)[0] for name in self.recipes if not name.endswith(".toml"))
        return tuple(dict.fromkeys([*named, *((CAMPAIGN,) if self.machine is not None else ())]))

    def run(self, recipe: str, rate_hz: int, unit: Unit = MM) -> Rehearsed | None:
        """Dry run of a recipe at a sampling rate of the ball-bar, with a picture in ``unit``; None for an unknown machine or recipe."""
        given = self.machine
        if given is None or recipe not in self.choices() or (recipe not in RECIPES and recipe != CAMPAIGN):
            return None
        startable = recipe in {split_recipe_name(name)[0] for name in self.recipes}
        try:
            machine = machine_from_doc(given.machine.model_dump())
            plan = identification(machine, rate_hz=rate_hz) if recipe == CAMPAIGN else recipe_plan(named(recipe, rate_hz), machine)
            runs = dry_run_campaign(machine, plan, given.max_feed_mm_min)
        except AbbeError as error:
            return Rehearsed(recipe, False, error.detail, error.remedy)
        return Rehearsed(recipe, startable, "", "", runs, set_ups(plan), _used(machine, runs), picture(machine, plan, unit))


def set_ups(plan: CampaignPlan) -> tuple[SetUp, ...]:
    """The set-ups that a person mounts, in order."""
    found = [one for test in plan.tests if (one := _set_up(test)) is not None]
    return tuple(SetUp(k, *one) for k, one in enumerate(found, start=1))


def _set_up(test: TestPlan) -> tuple[str, str, tuple[float, ...], float] | None:
    for step in test.steps:
        if isinstance(step, MountBar):
            return "bar", test.label, tuple(test.setup.place_mm.tolist()), step.radius_mm
        if isinstance(step, MountLaser):
            return "laser", test.label, tuple(test.setup.place_mm.tolist()), 0.0
    return None


def _used(machine: Machine, runs: tuple[DryRun, ...]) -> tuple[tuple[str, float, float, float, float], ...]:
    """Name, lowest and highest commanded position, and stroke of each axis, mm."""
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
