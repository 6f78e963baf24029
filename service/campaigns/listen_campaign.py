"""Records a campaign that the operator's NC program drives: every laser test of a recipe becomes a run in the store."""

from __future__ import annotations

from typing import Any

from abbe.drivers.errors import DriverError
from abbe.drivers.links.shielded import run_to_end
from abbe.service.campaigns.listen import Report, listen_to, planned_readings
from abbe.service.campaigns.measure import OpenCampaign, start_campaign, start_document
from abbe.service.capture.recorder import CaptureRecorder, close_run, recording
from abbe.service.clock import Clock, SystemClock
from abbe.service.devices.session import Session
from abbe.service.errors import AbbeError
from abbe.service.sequences.check import dry_run_campaign
from abbe.service.sequences.needed import check_devices
from abbe.service.sequences.steps import CampaignPlan, Unmount
from abbe.service.site import Site
from abbe.service.storage.store import Store


async def listen(session: Session, store: Store, site: Site, plan: CampaignPlan, report: Report, clock: Clock | None = None) -> list[int]:
    """Listen to the program of a plan, test by test; return the numbers of the runs.

    Raises
    ------
    StrokeError, MeasurementFault
        Before any prompt: the plan does not fit the machine, or a test is not suited for listening.
    MeasurementFault, DriverError
        The current run is closed as failed, with the reason; earlier runs stay.
    """
    clock = clock or SystemClock()
    dry_run_campaign(site.machine, plan, site.max_feed_mm_min)
    for test in plan.tests:
        planned_readings(test)
    await check_devices(session, plan)
    under_way = OpenCampaign(*await start_campaign(session, store, site, plan.name, {"listened": True}))
    run_ids = []
    for test in plan.tests:
        doc = await start_document(session, site, under_way, test, clock)
        run_id = await store.write(store.runs.start, under_way.id, test.label, test.test, test.role, doc)
        status, reason, end = "aborted", "stopped", dict[str, Any]()
        about = {"label": test.label, "test": test.test, "machine": site.name}
        recorder: CaptureRecorder | None = None
        try:
            async with recording(store, run_id, site.capture, clock, about) as recorder:
                end = await listen_to(session, recorder, test, report)
            under_way.mounted_us[test.setup["setup_id"]] = end["mounted_us"]
            status, reason = "complete", ""
            if any(isinstance(step, Unmount) for step in test.steps):
                await session.need_fixture().unmount()
        except (AbbeError, DriverError) as error:
            status, reason = "failed", f"{error.code}: {error}"
            raise
        finally:
            end |= {"ended_utc": clock.utc().isoformat()} | ({} if recorder is None else recorder.doc())
            await run_to_end(close_run(store, run_id, recorder, status, reason, end))
        run_ids.append(run_id)
    return run_ids
