"""Plans a campaign for a machine. The result is a recipe for the sequencer, checked by a dry run, and a document.

The instruments file of `abbe plan --instruments FILE.toml` gives the available bars, noise of the instruments, and duration of set-ups.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from abbe.models.arrays import F1, F2
from abbe.models.machine import AXES
from abbe.models.planning.measurements import BAR_LENGTHS_MM, DiagonalTest, HelixTest, Instruments, Measurement, SetupMinutes, feed_mm_min
from abbe.models.planning.plan import INNER_SHARE, PLAN_ORDER, MeasuringPlan, PlanStep, plan_campaign
from abbe.models.planning.search import COVERAGE
from abbe.service.config import read_toml
from abbe.service.domain.progress import Progress, ProgressSink, ignore_progress
from abbe.service.errors import ConfigError, location_text, mistakes, nearest
from abbe.service.rendering.document import Document, Lines, PictureBlock, Section, TextTable
from abbe.service.rendering.plots.views import DrawnTest, setups_picture
from abbe.service.sequences.check import DryRun, dry_run_campaign, paced
from abbe.service.sequences.recipes.recipe import Diagonal, Helix, Linear, Recipe
from abbe.service.sequences.recipes.recipe_file import recipe_text, shared_setups
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import Site

USUAL = SetupMinutes()
Micrometres = Annotated[float, Field(gt=0.0, le=1000.0)]
Minutes = Annotated[float, Field(ge=0.0, le=1440.0)]
Length = Annotated[float, Field(ge=10.0, le=2000.0)]


class _TomlTable(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True, defer_build=True)


class SetupTable(_TomlTable):
    """``[setup]``: minutes that a person needs."""

    cup_min: Minutes = USUAL.cup
    bar_min: Minutes = USUAL.bar
    line_min: Minutes = USUAL.line
    diagonal_min: Minutes = USUAL.diagonal


class InstrumentsFile(_TomlTable):
    """Available instruments; an omitted key keeps its default."""

    bar_lengths_mm: tuple[Length, ...] = BAR_LENGTHS_MM
    laser: bool = True
    bar_noise_um: Micrometres = 0.5
    laser_noise_um: Micrometres = 0.3
    bar_length_u_um: Micrometres = 2.0
    setup: SetupTable = SetupTable()


def read_instruments(path: Path | None) -> Instruments:
    """Read instruments from a file, or return the planner's defaults. Raises ConfigError with file, key and expected value."""
    if path is None:
        return Instruments()
    if not path.exists():
        raise ConfigError(f"instruments file {path} does not exist", "docs/how-to/plan.md shows one")
    content = read_toml(path, "instruments file")
    try:
        found = InstrumentsFile.model_validate_json(json.dumps(content, default=str), strict=True)
        times = SetupMinutes(found.setup.cup_min, found.setup.bar_min, found.setup.line_min, found.setup.diagonal_min)
        return Instruments(
            tuple(sorted(set(found.bar_lengths_mm))),
            found.laser,
            found.bar_noise_um * 1e-3,
            found.laser_noise_um * 1e-3,
            u_bar_length_mm=found.bar_length_u_um * 1e-3,
            setup=times,
        )
    except ValidationError as error:
        first = mistakes(error.errors())[0]
        place = first.place
        if first.unknown_key:
            table = SetupTable if place[0] == "setup" and len(place) > 1 else InstrumentsFile
            raise ConfigError(f"{path}: unknown key {location_text(place)!r}", nearest(str(place[-1]), table.model_fields)) from None
        raise ConfigError(f"{path}: {location_text(place)}: {first.expected}", "correct it; docs/how-to/plan.md shows a file") from None
    except ValueError as error:
        raise ConfigError(f"{path}: {error}", "give bar_lengths_mm or laser = true") from None


def at_this_machine(tools: Instruments, site: Site) -> tuple[Instruments, tuple[str, ...]]:
    """Return the instruments that a machine can use, and messages about those left out.

    A machine file with a ball-bar or a laser under ``[devices]`` can use only these; with neither, all instruments are planned.

    Raises
    ------
    ConfigError
        No instrument is left.
    """
    tools = replace(tools, max_feed_mm_min=site.max_feed_mm_min)
    has_bar, has_laser = site.urls.ballbar is not None, site.urls.laser is not None
    if not has_bar and not has_laser:
        return tools, ()
    messages = []
    if tools.laser and not has_laser:
        messages.append("planned without a laser: the machine file names none under [devices]")
    if tools.bar_lengths_mm and not has_bar:
        messages.append("planned without a ball-bar: the machine file names none under [devices]")
    try:
        return replace(tools, laser=tools.laser and has_laser, bar_lengths_mm=tools.bar_lengths_mm if has_bar else ()), tuple(messages)
    except ValueError:
        remedy = "correct the instruments file, or add its instruments to [devices] of the machine file"
        raise ConfigError(f"nothing to measure with: {'; '.join(messages)}", remedy) from None


BOUND_NOTE = (
    "U is the smallest that these readings allow (Bayesian Cramer-Rao bound), over the inner 80 % of the volume, rigid motion removed, "
    "temperature of the scales included. `abbe solve` may state a larger U: it also includes error motions of higher orders, and the "
    "uncertainty of the estimated noise and typical sizes. On a machine better than a typical one, `abbe solve` states a smaller U"
)


@dataclass(frozen=True)
class PlannedCampaign:
    """A plan with its recipes, campaign, dry run of every test, and recipe file text; ``notes``: remarks for the person."""

    plan: MeasuringPlan
    recipes: tuple[Recipe, ...]
    campaign: CampaignPlan
    dry: tuple[DryRun, ...]
    text: str
    notes: tuple[str, ...]


def plan_for(
    site: Site,
    *,
    minutes: float,
    goal_um: float | None = None,
    tools: Instruments | None = None,
    progress: ProgressSink = ignore_progress,
) -> PlannedCampaign:
    """Plan a campaign for a machine.

    Raises
    ------
    ConfigError
        No plan is possible: too few minutes, too small strokes, or invalid numbers.
    StrokeError
        The dry run refuses the plan.
    """

    def tick(share: float) -> None:
        progress(Progress("plan", share, 1.0, None, "selecting the most informative measurements"))

    vertical = AXES.index(str(site.doc.get("vertical_axis", "Z")))
    goal_mm = None if goal_um is None else goal_um * 1e-3
    tools, notes = at_this_machine(tools or Instruments(), site)
    try:
        plan = plan_campaign(site.machine, minutes=minutes, goal_mm=goal_mm, tools=tools, vertical=vertical, progress=tick)
    except ValueError as error:
        raise ConfigError(
            str(error), "give more --minutes, shorter bar_lengths_mm (--instruments), or check stroke_mm in the machine file"
        ) from None
    name = f"plan {plan.minutes:.0f} min"
    recipes = shared_setups(tuple(recipe_of(s, tools) for s in plan.steps), name)
    campaign = paced(CampaignPlan(name, tuple(r.plan(site.machine) for r in recipes)), site.max_feed_mm_min)
    dry = dry_run_campaign(site.machine, campaign, site.max_feed_mm_min)
    note = f"for {site.name}, {plan.minutes:.0f} minutes with set-ups; expected worst U {_um(COVERAGE * plan.u_worst_mm)} um"
    notes = (*notes, *plan.warnings, judge_note(plan))
    return PlannedCampaign(plan, recipes, campaign, dry, recipe_text(name, recipes, note), notes)


def recipe_of(step: PlanStep, tools: Instruments) -> Recipe:
    """Return the sequencer's recipe for a planned measurement with these instruments."""
    test: Measurement = step.test
    feed = feed_mm_min(tools, test)
    if isinstance(test, HelixTest):
        return Helix(
            step.label,
            step.setup_id,
            step.role,
            test.centre_mm,
            test.radius_mm,
            turns=test.turns,
            axis=test.axis,
            feed_mm_min=feed,
            direction=1 if test.direction > 0 else -1,
            opens=1 if test.opens > 0 else -1,
            u_length_mm=tools.u_bar_length_mm,
        )
    if isinstance(test, DiagonalTest):
        return Diagonal(step.label, step.setup_id, step.role, test.diagonal, test.steps, test.order, feed_mm_min=feed)
    return Linear(step.label, step.setup_id, step.role, test.axis, at_share=test.at, positions=test.n, feed_mm_min=feed)


def describe(test: Measurement) -> str:
    """Describe a measurement for an operator."""
    if isinstance(test, HelixTest):
        at = ", ".join(f"{v:g}" for v in test.centre_mm)
        opens = "" if (test.axis, test.opens) == (2, 1) else f", opening along {'+' if test.opens > 0 else '-'}{AXES[test.axis]}"
        return f"ball-bar {test.radius_mm:g} mm about ({at}){opens}{'' if test.direction > 0 else ', equator to pole'}"
    if isinstance(test, DiagonalTest):
        return f"laser, body diagonal {test.diagonal}, {f'steps {test.order}' if test.order else 'straight'}"
    others = [a for a in range(3) if a != test.axis]
    at = ", ".join(f"{AXES[a]} at {100 * s:.0f} %" for a, s in zip(others, test.at, strict=True))
    return f"laser along {AXES[test.axis]}, {at} of the stroke"


def temperature_note(plan: MeasuringPlan) -> str:
    """Describe the part of U that no measurement can reduce."""
    inputs = plan.tools.inputs
    return (
        f"every U includes the temperature of the scales (standard uncertainty {inputs.u_scale_temperature_k:g} K, "
        f"{inputs.scale_expansion_per_k * 1e6:g} µm/m/K); this alone makes U = {_um(COVERAGE * plan.u_temperature_mm)} µm"
    )


def judge_note(plan: MeasuringPlan) -> str:
    """Describe the holdout run and its cost."""
    if plan.judge is None:
        return "every run is fitted: there are too few minutes for a run that only judges, so `abbe discover` can prove no effect"
    return f"{plan.judge.label} is not fitted: it judges what is found, and takes {plan.judge.minutes:.1f} minutes"


def goal_lines(plan: MeasuringPlan) -> list[str]:
    """Say in sentences whether the plan reaches its goal; an empty list if it has no goal."""
    goal = plan.goal
    if goal is None:
        return []
    wanted, limit = _um(goal.wanted_mm), _um(goal.limit_mm)
    bound = f"limit of these instruments: U = {limit} µm ({goal.limit_by})"
    if goal.reached:
        return [f"goal {wanted} µm is reached after {plan.minutes:.0f} minutes: worst U = {_um(COVERAGE * plan.u_worst_mm)} µm", bound]
    here = f"goal {wanted} µm is not reached in {plan.minutes:.0f} minutes (worst U = {_um(COVERAGE * plan.u_worst_mm)} µm)"
    if goal.minutes_needed is not None:
        return [f"{here}; about {goal.minutes_needed:.0f} minutes would do", bound]
    if goal.limit_mm >= goal.wanted_mm:
        return [f"{here} and cannot be reached with these instruments", bound]
    return [f"{here}; a working day is too short, too", bound]


def step_rows(plan: MeasuringPlan) -> list[tuple[str, ...]]:
    """Return the rows of a plan: set-up, label, measurement, minutes, minutes so far, worst and mean U (k = 2) afterwards, µm."""
    before = tuple(_um(COVERAGE * u) for u in plan.u_before_mm)
    rows: list[tuple[str, ...]] = [("", "", "from the priors alone", "", "0", *before)]
    for s in plan.steps:
        u = (_um(COVERAGE * s.u_worst_mm), _um(COVERAGE * s.u_mean_mm))
        rows.append((s.setup_id.removeprefix("S"), s.label, describe(s.test), f"{s.minutes:.1f}", f"{s.until_min:.1f}", *u))
    return rows


def plan_picture(site: Site, planned: PlannedCampaign) -> str:
    """Draw the set-ups of a plan in the volume, as ``<svg>``."""
    plan = planned.plan
    paths = [
        DrawnTest(int(s.setup_id.removeprefix("S")), _kind(s.test), describe(s.test), run.axes_mm, _mount_mm(s.test, run.axes_mm))
        for s, run in zip(plan.steps, plan.runs, strict=True)
    ]
    return setups_picture(site.machine.stroke_mm, paths)


def plan_report(site: Site, planned: PlannedCampaign) -> Document:
    """Return a report with a picture of the set-ups and the gain of each measurement."""
    plan = planned.plan
    lead = [f"{site.name}: {plan.minutes:.0f} minutes, set-ups included.", *goal_lines(plan), *planned.notes]
    headings = ("No", "Label", "Measurement", "min", "until min", "worst U µm", "mean U µm")
    picture = PictureBlock(
        "Numbers: set-ups in the order of measuring. Rest the pointer on a dot to read what is set up there.",
        [plan_picture(site, planned)],
        "wide",
    )
    table = TextTable(headings, step_rows(plan))
    note = f"{BOUND_NOTE}. {temperature_note(plan)}."
    sections = (
        Section("Set-ups", [*lead, picture]),
        Section("Measurements in order", [table, note]),
        Section("What stays open", [Lines(plan.open_questions)]),
    )
    return Document(kind="plan", title="Planned measurements", sections=sections, signatures=())


def _kind(test: Measurement) -> str:
    return "bar" if isinstance(test, HelixTest) else "diagonal" if isinstance(test, DiagonalTest) else "line"


def _mount_mm(test: Measurement, path_mm: F2) -> F1:
    return np.array(test.centre_mm) if isinstance(test, HelixTest) else path_mm[0]


def plan_doc(planned: PlannedCampaign) -> dict[str, Any]:
    """Return a plan as JSON object, in micrometres and minutes."""
    plan, goal = planned.plan, planned.plan.goal
    steps = [
        {
            "label": s.label,
            "setup": s.setup_id,
            "role": s.role,
            "what": describe(s.test),
            "minutes": s.minutes,
            "until_min": s.until_min,
            "machine_s": d.duration_s,
            "u_worst_um": s.u_worst_mm * 1e3,
            "u_mean_um": s.u_mean_mm * 1e3,
        }
        for s, d in zip(plan.steps, planned.dry, strict=True)
    ]
    return {
        "minutes": plan.minutes,
        "model": f"rigid21/legendre{PLAN_ORDER}",
        "inner_share": INNER_SHARE,
        "bound": BOUND_NOTE,
        "u_scale_temperature_um": plan.u_temperature_mm * 1e3,
        "notes": list(planned.notes),
        "before": {"u_worst_um": plan.u_before_mm[0] * 1e3, "u_mean_um": plan.u_before_mm[1] * 1e3},
        "steps": steps,
        "u_worst_um": plan.u_worst_mm * 1e3,
        "goal": None
        if goal is None
        else {
            "wanted_U_um": goal.wanted_mm * 1e3,
            "reached": goal.reached,
            "minutes_needed": goal.minutes_needed,
            "limit_U_um": goal.limit_mm * 1e3,
            "limit_by": goal.limit_by,
        },
        "not_observable": list(plan.open_questions),
    }


def _um(mm: float) -> str:
    return f"{mm * 1e3:.3g}"
