"""The unattended check: measure a recipe, and judge its figures with their uncertainty against the machine file's limits."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable
from datetime import UTC, datetime

from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.campaigns.plausibility import BALLBAR, INSTRUMENTS, LASER, ended_certificates
from abbe.service.capture.live import LiveFeed
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.recover import recovered_session
from abbe.service.config_schema import MachineFile
from abbe.service.devices.session import lock_machine
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.run import Run
from abbe.service.domain.verification import CheckResult
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Control
from abbe.service.sequences.recipes.campaigns import recipe_plan
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.verification.verify import COVERAGE, figure_rows, figures, judge, overall

MEASURED_WITH = {"body_diagonal_um": LASER, "helix_rms_um": BALLBAR}
MARK = {"pass": "within limits", "fail": "out of limits", "cannot tell": "too close to a limit to tell"}


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

    ``control`` pauses, resumes, stops or aborts the measurement; ``live`` gets the samples of its paths.

    Raises
    ------
    AbbeError, DriverError
        The check failed; the error names one cause and one remedy. The current run is closed as failed, and the axes are stopped.
    """
    clock = clock or SystemClock()
    started, start_s = clock.utc(), clock.monotonic_s()
    site = site_of(config)
    plan = recipe_plan(recipe, site.machine)
    # With the machine's name: services that share a database may check in the same second, and campaign names are unique.
    plan = CampaignPlan(f"{plan.name} {config.name} {started:%Y-%m-%d %H:%M:%S}", plan.tests)
    with lock_machine(site.urls.cnc):
        async with recovered_session(store, site) as session:
            run_ids = await measure(
                session, store, site, plan, progress=progress, clock=clock, options=MeasureOptions(control=control, live=live)
            )
    runs = await asyncio.to_thread(lambda: [load_run(store, k) for k in run_ids])
    return judged(config, runs, plan.name, started, clock.monotonic_s() - start_s)


def judged(config: MachineFile, runs: list[Run], campaign: str, started: datetime, duration_s: float) -> CheckResult:
    """Judge the measured runs of a check against the limits, with their uncertainty.

    Raises
    ------
    MeasurementFault
        The runs are not a complete check: a body diagonal is missing, or a run was not measured to its end.
    """
    rows = figure_rows(figures(runs))
    limits = {"body_diagonal_um": config.verify.body_diagonal_um, "helix_rms_um": config.verify.helix_rms_um}
    verdict = overall([judge(*rows[k], limits[k]) for k in limits if k in rows])
    text = f"{MARK[verdict]}: " + ", ".join(f"{_name(k)} {rows[k][0]:.1f} µm (limit {limits[k]:g})" for k in limits if k in rows)
    against = [*_air(runs, config.limits.temperature_c), *_ended(config, rows, started)]
    if against:
        verdict = "cannot tell"
        text = f"{' and '.join(against)}, so the figures cannot be judged; {text}"
    return CheckResult(
        verdict,
        {k: v for k, (v, _) in rows.items()},
        {k: COVERAGE * u for k, (_, u) in rows.items()},
        {k: v for k, v in limits.items() if k in rows},
        [r.run_id for r in runs],
        campaign,
        started,
        duration_s,
        text,
        not against,
    )


def _name(key: str) -> str:
    return {"body_diagonal_um": "worst body diagonal", "helix_rms_um": "helix rms"}[key]


def _ended(config: MachineFile, names: Iterable[str], started: datetime) -> list[str]:
    """Return a sentence for each instrument behind these figures whose certificate had ended by ``started``."""
    roles = {MEASURED_WITH[name] for name in names if name in MEASURED_WITH}
    ended = ended_certificates(site_of(config), started.astimezone(UTC).date(), roles)
    return [f"the certificate of the {INSTRUMENTS[role]} ended on {day}" for role, day in ended.items()]


def _air(runs: list[Run], window: tuple[float, float]) -> list[str]:
    outside, (low, high) = _outside(runs, window), window
    return [] if outside is None else [f"air temperature {outside:.1f} C is outside of {low:g}..{high:g} C"]


def _outside(runs: list[Run], window: tuple[float, float]) -> float | None:
    """Return the air temperature farthest outside the window; None if all are inside or none was measured."""
    low, high = window
    temperatures = [float(t) for r in runs for t in r.columns.air_c]
    worst = max(temperatures, key=lambda t: max(low - t, t - high), default=None)
    return worst if worst is not None and not low <= worst <= high else None
