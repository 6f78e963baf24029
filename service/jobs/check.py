"""The unattended check: measure a recipe, and judge its figures with their uncertainty against the machine file's limits."""

from __future__ import annotations

import asyncio

from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.capture.live import LiveFeed
from abbe.service.clock import Clock, SystemClock
from abbe.service.compensation.recover import recovered_session
from abbe.service.config_schema import MachineFile
from abbe.service.devices.session import lock_machine
from abbe.service.domain.progress import ProgressSink
from abbe.service.domain.verification import CheckResult
from abbe.service.runs.columns import load_run
from abbe.service.sequences.control import Control
from abbe.service.sequences.recipes.campaigns import recipe_plan
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.site import site_of
from abbe.service.storage.store import Store
from abbe.service.verification.verify import judged


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
