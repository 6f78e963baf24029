"""The unattended check: measure a recipe, judge its figures against the machine file's limits with their uncertainty."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from service.capture.live import LiveFeed
from service.clock import Clock, SystemClock
from service.config_schema import MachineFile
from service.devices.alone import alone
from service.devices.session import open_session
from service.events import ProgressSink
from service.runs.columns import load_run
from service.sequences.control import Control
from service.sequences.steps import CampaignPlan
from service.site import site_of
from service.storage.store import Store
from service.workflows.measure import Manner, measure
from service.workflows.recover import recover
from service.workflows.shipped import recipe_plan
from service.workflows.verify import COVERAGE, Verdict, figure_rows, figures, judge, overall

MARK = {"pass": "within limits", "fail": "out of limits", "cannot tell": "too close to a limit to tell"}


@dataclass(frozen=True, slots=True)
class CheckResult:
    """What a check found. ``uncertainties`` are expanded (k = 2); figures in µm by name."""

    verdict: Verdict
    values: dict[str, float]
    uncertainties: dict[str, float]
    limits: dict[str, float]
    run_labels: list[str]
    campaign: str
    started_utc: datetime
    duration_s: float
    text: str
    comparable: bool = True
    """Whether the figures can be put beside those of other checks: measured in the air in which they can be judged."""


async def run_check(
    config: MachineFile,
    store: Store,
    recipe: str,
    progress: ProgressSink,
    clock: Clock | None = None,
    *,
    control: Control | None = None,
    live: LiveFeed | None = None,
) -> CheckResult:
    """Open the devices, measure the recipe, close them, judge.

    ``control`` pauses, resumes, stops or aborts the measurement; ``live`` is shown what its paths read.

    Raises
    ------
    AbbeError, DriverError
        One cause, one remedy; the run in hand is closed as failed and the axes are stopped.
    """
    clock = clock or SystemClock()
    started, start_s = clock.utc(), clock.monotonic_s()
    site = site_of(config)
    plan = recipe_plan(recipe, site.machine)
    # With the machine: services that share a database check at the same second, and a campaign's name is there once.
    plan = CampaignPlan(f"{plan.name} {config.name} {started:%Y-%m-%d %H:%M:%S}", plan.tests)
    with alone(site.urls.cnc):
        async with open_session(site.urls) as session:
            await recover(session.controller, store, site)
            run_ids = await measure(session, store, site, plan, progress=progress, clock=clock, manner=Manner(control=control, live=live))
    runs = await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])
    rows = figure_rows(figures(runs))
    limits = {"body_diagonal_um": config.verify.body_diagonal_um, "helix_rms_um": config.verify.helix_rms_um}
    verdict = overall([judge(*rows[k], limits[k]) for k in limits if k in rows])
    text = f"{MARK[verdict]}: " + ", ".join(f"{_name(k)} {rows[k][0]:.1f} µm (limit {limits[k]:g})" for k in limits if k in rows)
    outside = _outside(runs, config.limits.temperature_c)
    if outside is not None:
        verdict = "cannot tell"
        low, high = config.limits.temperature_c
        text = f"air temperature {outside:.1f} C is outside of {low:g}..{high:g} C, so the figures cannot be judged; {text}"
    return CheckResult(
        verdict,
        {k: v for k, (v, _) in rows.items()},
        {k: COVERAGE * u for k, (_, u) in rows.items()},
        {k: v for k, v in limits.items() if k in rows},
        [r["run_id"] for r in runs],
        plan.name,
        started,
        clock.monotonic_s() - start_s,
        text,
        outside is None,
    )


def _name(key: str) -> str:
    return {"body_diagonal_um": "worst body diagonal", "helix_rms_um": "helix rms"}[key]


def _outside(runs: list[dict[str, Any]], window: tuple[float, float]) -> float | None:
    """The air temperature farthest outside of the window, None if all are inside or none was measured."""
    low, high = window
    seen = [float(t) for r in runs for t in r["columns"].get("temp_air_C", [])]
    worst = max(seen, key=lambda t: max(low - t, t - high), default=None)
    return worst if worst is not None and not low <= worst <= high else None
