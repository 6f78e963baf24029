"""The service in the middle of a push of its own: ``python serve_push.py CONFIG.json``. Run as a process by the tests beside it.

Control, journal, lock, measurement and service are real. Which proposal waits is told, and the probe measures until it is stopped.
"""

from __future__ import annotations

import asyncio
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

from abbe.service.campaigns.measure import MeasureOptions, measure
from abbe.service.compensation.approved import ApprovedProposal, PushOrder
from abbe.service.compensation.pushing import Pushing, Questions, WantedTable
from abbe.service.compensation.recover import recover
from abbe.service.config_schema import Web
from abbe.service.core.push_recovery import recover_at_start
from abbe.service.core.setup import ServiceSetup
from abbe.service.devices.session import DeviceUrls, Session, lock_machine, open_session
from abbe.service.domain.machine import machine_doc, machine_from_doc
from abbe.service.domain.progress import JobOutcome, Progress
from abbe.service.domain.schedule import Schedule
from abbe.service.logs import configure_logs
from abbe.service.mqtt.broker import Topics
from abbe.service.push.operations import VerificationResult
from abbe.service.scheduler import alarm_manager
from abbe.service.sequences.recipes.recipe import Diagonal
from abbe.service.sequences.steps import CampaignPlan
from abbe.service.serve import serve
from abbe.service.site import Site
from abbe.service.storage.store import Store
from abbe.service.tables.nine_tables import read_base
from tests.scenarios.test_push import linear_tables

PROPOSAL = ApprovedProposal(4, 9, 0)


def say(word: str) -> None:
    sys.stdout.write(f"{word}\n")
    sys.stdout.flush()


async def probing(session: Session, store: Store, site: Site, order: PushOrder, last: str) -> VerificationResult:
    """Axes on their way for as long as nobody stops them. ``last``: what the fixture is asked for when that happens."""
    told: list[Progress] = []

    def progress(now: Progress) -> None:
        order.progress(now)
        if now.done > 0.0 and not told:
            told.append(now)
            say("on its way")

    plan = CampaignPlan("probe", (Diagonal("probe", "P", "holdout", "ppp", 200, "").plan(site.machine),))
    try:
        await measure(session, store, site, plan, progress=progress, options=MeasureOptions(control=order.control, part=True))
    except asyncio.CancelledError:
        if last:
            host, port = site.urls.fixture.removeprefix("fixture+tcp://").split(":")
            reader, writer = await asyncio.open_connection(host, int(port))
            writer.write(last.encode() + b"\n")
            await reader.readline()
            writer.close()
        raise
    raise AssertionError("the diagonal ended before it was stopped")


def duties_on(site: Site, last: str) -> Any:
    def duties(store: Store) -> alarm_manager.Duties:
        async def push(order: PushOrder) -> JobOutcome:
            with lock_machine(site.urls.cnc):
                async with open_session(site.urls) as session:
                    await recover(session.controller, store, site)
                    await order.begun()
                    wanted = WantedTable(
                        linear_tables(site, np.full((3, 3), 1e-5)), await read_base(session.controller), 100, None, {"proposal": 4}
                    )

                    async def probe() -> VerificationResult:
                        return await probing(session, store, site, order, last)

                    done = await Pushing(session.controller, store, site, control=order.control).bring(
                        wanted, Questions(list, "a test", probe, probe)
                    )
                    return JobOutcome("kept" if done.kept else "rolled back", done.why)

        async def investigate(*_: object) -> None:
            raise AssertionError

        return alarm_manager.Duties(0.0, "identification", investigate, push)

    return duties


def main() -> int:
    given = json.loads(Path(sys.argv[1]).read_text())
    configure_logs()
    ready = given["ready"]
    machine = machine_from_doc(ready["machine"])
    urls = DeviceUrls(ready["cnc"], ready["ballbar"], ready["laser"], ready["fixture"])
    site = Site("sim", machine, machine_doc("sim", machine), urls)
    alarm_manager.next_approved = lambda store, name, entries, now_s: None if any(e.kind == "pushing" for e in entries) else PROPOSAL  # type: ignore[assignment]
    yearly = Schedule("yearly", "0 0 1 1 *", "UTC", "quick-check")
    return serve(
        ServiceSetup(
            "sim", site.doc, {"cnc": ready["cnc"]}, (yearly,), given["store"], None, Topics("plant/abbe", "sim"), Web(port=0),
            lambda _: None, recover=lambda store: lambda: recover_at_start(store, site), duties=duties_on(site, given["last"]),
        )
    )  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
