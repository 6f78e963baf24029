"""Plans the poses of an artefact for the minutes at hand: each pose adds the most information, and all touches stay inside the strokes.

Holes lie flat, and the plan is judged in their plane. Balls may be tilted, too, and the plan is judged in the space that they can reach.
The artefact file is TOML with one table ``[artefact.NAME]``, as at the end of a recipe.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from abbe.models.arrays import F2
from abbe.models.planning.measurements import Instruments
from abbe.models.planning.problem import PlanningProblem, pose_fields, pose_uncertainty_mm, problem
from abbe.models.solvers.engine import DEFAULT_SIGMA_MM
from abbe.models.solvers.observability.poses import SHIFT, PoseRank, pose_rank
from abbe.models.solvers.observations import RunData
from abbe.service.config import read_toml
from abbe.service.domain.artefact import ARTEFACT_TEST, ArtefactObject
from abbe.service.domain.progress import Progress, ProgressSink, ignore_progress
from abbe.service.domain.run import ArtefactSetup, Columns, Run
from abbe.service.errors import ConfigError, StrokeError
from abbe.service.runs.artefact_points import artefact_data, calibrated_lengths
from abbe.service.sequences.check import DryRun, dry_run
from abbe.service.sequences.recipes.artefact import BALL, ArtefactTest
from abbe.service.sequences.recipes.recipe_file import recipe_text
from abbe.service.sequences.steps import TestPlan, TouchFeature
from abbe.service.site import Site

ORDER = 4
"""Highest Legendre order of the planned map, as `pose_rank` counts its fields."""
MOUNT_MIN = 8.0
U_MM = 4e-4
"""Assumed repeatability of a measured centre."""
MARGIN_MM = 1.0
NODES, LEVELS = 7, 4
"""Points across and upwards at which a plan is judged."""
TILT_DEG = 30.0
"""Tilt of the tilted poses: a plate of 250 mm then reaches over 125 mm of Z, and its balls stay free for the stylus."""
COVERAGE = 2.0


@dataclass(frozen=True, slots=True)
class PlannedPose:
    """A chosen pose: its recipe and dry run, minutes with mounting, and the uncertainty after it."""

    recipe: ArtefactTest
    dry: DryRun
    minutes: float
    until_min: float
    rank: PoseRank | None
    u_worst_mm: float
    u_mean_mm: float


@dataclass(frozen=True)
class PosePlan:
    """The poses in order, and the recipe file's text."""

    poses: tuple[PlannedPose, ...]
    text: str


def read_artefact(path: Path) -> tuple[str, ArtefactObject]:
    """Return name and description of the artefact in a file. Raises ConfigError with the first mistake."""
    found = read_toml(path, "artefact file").get("artefact")
    if not isinstance(found, dict) or len(found) != 1:
        raise ConfigError(f"{path}: expected one table [artefact.NAME]", "docs/reference/recipe-file.md has an example")
    ((name, doc),) = found.items()
    try:
        return str(name), ArtefactObject.read(doc)
    except ValueError as error:
        raise ConfigError(f"{path}: artefact.{name}: {' '.join(str(error).split())[:200]}", "correct it") from None


def plan_poses(site: Site, name: str, plate: ArtefactObject, minutes: float, progress: ProgressSink = ignore_progress) -> PosePlan:
    """Choose poses one after the other until the minutes are used up.

    In a plane the pose that shows the most fields of the map wins, then the one with the smallest mean U; in space only the mean U counts.

    Raises
    ------
    ConfigError
        The artefact fits nowhere, a feature cannot be touched, or the minutes do not suffice for one pose.
    """
    offered = list(_offered(site, name, plate))
    if not offered:
        raise ConfigError(f"artefact {name}: no pose has all its touches inside the strokes", "use a smaller artefact")
    what = problem(site.machine, Instruments(), ORDER)
    points = _points([plan for _, plan, _ in offered], LEVELS if _may_tilt(plate) else 1)
    n_axes = 3 if np.ptp(points[:, 2]) else 2
    fields = pose_fields(what, points, n_axes)
    chosen, runs, used = list[PlannedPose](), list[Run](), 0.0
    while True:
        progress(Progress("plan", used, minutes, None, f"pose {len(chosen) + 1}"))
        rest = [(r, plan, dry) for r, plan, dry in offered if used + MOUNT_MIN + dry.duration_s / 60.0 <= minutes]
        if not rest:
            break
        tried = [(*_known(what, (*runs, _expected(site, plan)), fields, n_axes), r, plan, dry) for r, plan, dry in rest]
        rank, worst, mean, recipe, _, dry = min(tried, key=lambda one: (0 if n_axes == 3 or one[0] is None else -one[0].rank, one[2]))
        if chosen and mean > 0.98 * chosen[-1].u_mean_mm and (rank is None or chosen[-1].rank is None or rank.rank == chosen[-1].rank.rank):
            break
        label, cost = f"{name}-{len(chosen) + 1}", MOUNT_MIN + dry.duration_s / 60.0
        used += cost
        recipe = replace(recipe, label=label, setup_id=label)
        runs.append(_expected(site, recipe.plan(site.machine)))
        chosen.append(PlannedPose(recipe, dry, cost, used, rank, worst, mean))
    if not chosen:
        raise ConfigError(f"{minutes:g} minutes do not suffice for one pose of {name}", "give more --minutes")
    note = f"for {site.name}, {used:.0f} minutes with mounting"
    return PosePlan(tuple(chosen), recipe_text(f"{name} {used:.0f} min", tuple(p.recipe for p in chosen), note))


def _offered(site: Site, name: str, plate: ArtefactObject) -> Iterator[tuple[ArtefactTest, TestPlan, DryRun]]:
    """Yield the poses inside the strokes: at quarter turns, at the ends and in the middle of X and Y, and shifted by a part of a pitch.

    Balls are also tilted, unless the stylus would meet another ball.
    """
    nominal = np.array([f.nominal_mm for f in plate.features])
    pitch = float(np.median(np.sort(np.linalg.norm(nominal[:, None] - nominal[None], axis=2), axis=1)[:, 1])) if len(nominal) > 1 else 0.0
    for tilt, turn in product((0.0, TILT_DEG) if _may_tilt(plate) else (0.0,), (0.0, 90.0, 180.0, 270.0)):
        one = ArtefactTest("pose", "pose", "identify", name, (0.0, 0.0, 0.0), rotation_deg=(tilt, 0.0, turn), plate=plate)
        height = round(float(site.machine.stroke_mm[2].mean() - one.matrix()[2] @ nominal.mean(axis=0)), 2)
        try:
            reach = np.array([p for s in one.plan(site.machine).steps if isinstance(s, TouchFeature) for p in s.places_mm()])
        except ConfigError:
            if tilt:
                continue
            raise
        low = site.machine.stroke_mm[:2, 0] - reach[:, :2].min(axis=0) + MARGIN_MM
        high = site.machine.stroke_mm[:2, 1] - reach[:, :2].max(axis=0) - MARGIN_MM
        steps = [sorted({a, 0.5 * (a + b), b, min(b, a + SHIFT * pitch)}) for a, b in zip(low, high, strict=True) if a <= b]
        for x, y in ((x, y) for x in steps[0] for y in steps[1]) if len(steps) == 2 else ():
            at = replace(one, origin_mm=(round(x, 2), round(y, 2), height))
            try:
                plan = at.plan(site.machine)
                yield at, plan, dry_run(site.machine, plan)
            except StrokeError:
                continue


def _may_tilt(plate: ArtefactObject) -> bool:
    return all(f.sensed == BALL for f in plate.features)


def _points(plans: list[TestPlan], levels: int) -> F2:
    """Return a grid of points over the places that the artefact can reach: on one level for a plane, on several for space."""
    reach = np.array([s.centre_mm for plan in plans for s in plan.steps if isinstance(s, TouchFeature)])
    low, high = reach.min(axis=0), reach.max(axis=0)
    z = np.array([reach[:, 2].mean()]) if levels == 1 else np.linspace(low[2], high[2], levels)
    nodes = np.meshgrid(np.linspace(low[0], high[0], NODES), np.linspace(low[1], high[1], NODES), z, indexing="ij")
    return np.stack([n.ravel() for n in nodes], axis=1)


def _expected(site: Site, plan: TestPlan) -> Run:
    """Return the run of a pose as a machine without errors would read it."""
    touches = [s for s in plan.steps if isinstance(s, TouchFeature)]
    doc: dict[str, Any] = {"t_s": [6.0 * k for k in range(len(touches))], "feature": [s.feature for s in touches]}
    doc |= {f"{a}_mm": [s.centre_mm[k] for s in touches] for k, a in enumerate("xyz")}
    doc |= {f"deviation_{a}_mm": [None if k == 2 and s.inside else 0.0 for s in touches] for k, a in enumerate("xyz")}
    doc |= {"u_mm": [U_MM] * len(touches), "touch_start_deg": [s.start_deg for s in touches]}
    setup = plan.setup.mounted(0.0)
    run = Run(
        campaign="plan", run_id=plan.label, test=ARTEFACT_TEST, role="identify", machine=site.doc, setup=setup,
        columns=Columns.from_document(doc),
    )  # fmt: skip
    return run.with_artefact({"artefacts": plan.artefact})


def _known(what: PlanningProblem, runs: tuple[Run, ...], fields: F2, n_axes: int) -> tuple[PoseRank | None, float, float]:
    named = [_data(f"p{k}", run) for k, run in enumerate(runs)]
    data = (*named, *calibrated_lengths(list(runs)))
    return pose_rank(data, cures=False), *pose_uncertainty_mm(what, data, fields, DEFAULT_SIGMA_MM["artefact"], n_axes)


def _data(name: str, run: Run) -> RunData:
    assert isinstance(run.setup, ArtefactSetup)
    return replace(artefact_data(run, run.setup), label=name, setup=name)


HEADINGS = ("no", "pose", "min", "until min", "fields", "worst U µm", "mean U µm")


def pose_rows(plan: PosePlan) -> list[tuple[str, ...]]:
    """Return a row for each pose: where, minutes, fields shown, U = 2 u afterwards, µm."""
    rows: list[tuple[str, ...]] = []
    for k, p in enumerate(plan.poses, start=1):
        (x, y, z), (tilt, _, turn) = p.recipe.origin_mm, p.recipe.rotation_deg
        where = f"zero at X {x:g} Y {y:g} Z {z:g}, turned by {turn:g}°" + (f", tilted by {tilt:g}°" if tilt else "")
        fields = "" if p.rank is None else f"{p.rank.rank} of {p.rank.of}"
        u = (f"{COVERAGE * p.u_worst_mm * 1e3:.3g}", f"{COVERAGE * p.u_mean_mm * 1e3:.3g}")
        rows.append((str(k), where, f"{p.minutes:.1f}", f"{p.until_min:.1f}", fields, *u))
    return rows


def pose_doc(plan: PosePlan) -> dict[str, Any]:
    """Return a plan as JSON object, in micrometres and minutes."""
    return {
        "poses": [
            {
                "label": p.recipe.label,
                "origin_mm": list(p.recipe.origin_mm),
                "rotation_deg": list(p.recipe.rotation_deg),
                "minutes": p.minutes,
                "until_min": p.until_min,
                "machine_s": p.dry.duration_s,
                "fields": None if p.rank is None else p.rank.rank,
                "hidden": [] if p.rank is None else list(p.rank.hidden),
                "u_worst_um": p.u_worst_mm * 1e3,
                "u_mean_um": p.u_mean_mm * 1e3,
            }
            for p in plan.poses
        ]
    }
